"""Draw the semantic map on a GPU: a scene is uploaded once, a frame sends its pose and road users,
and its image stays there.

A primitive is a stroke or a shape, for which see `kernels`, in `COLUMNS` columns:

- 0 to 3: its box, least x and y and greatest x and y, pixels
- 4 and 5: its largest and smallest 1/depth; 6 to 8: 1/depth as a plane over the image, (a, b, c) of
  ``a x + b y + c``
- 9: bias; 10 to 15: front and back colour
- 16: half the width of a stroke, pixels; 0: a shape
- 17 to 25: of a shape three planes, each 0 on an edge and positive inside; of a stroke the place
  along it as a plane, 0 to 1, where it begins, and how far it goes
- 26 to 28: shade/depth of a shape, a plane as well
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.types import F64
from alpasim_plugin.fixers.semantic_map import kernels, tile_kernel
from alpasim_plugin.fixers.semantic_map.prepare import PreparedMap, Segments, Triangles
from alpasim_plugin.fixers.semantic_map.raster import SAMPLES
from alpasim_plugin.fixers.semantic_map.style import DEPTH_MAX_M, NEAR_M

COLUMNS = 29
TILE = 16  # pixels of a tile's side
SHORTEST = 1e-300  # in place of a squared length of 0


def draw_tiles(
    scene: PreparedMap,
    view: F64,
    pose: F64,
    faces: Triangles,
    edges: Segments,
    rows: slice,
    device: torch.device,
) -> Tensor:
    """Return rows of the map of an image ``(h, W, 3)`` uint8; see `draw.draw_map`.

    Args:
        scene: Its static part is sent once.
        view, pose: See `draw.seen_from`.
        faces, edges: Of road users.
        rows: Of the image.
        device: Where to draw.
    """
    width, height = view[kernels.WIDTH : kernels.SCALE].astype(int).tolist()
    segments, triangles, samples = _uploaded(scene, device)
    camera = upload(np.concatenate([pose.ravel(), view, [1.0, width / height]]), device)
    strokes = _strokes(torch.cat([segments, _rows(edges, device)]), camera)
    shapes = _shapes(torch.cat([triangles, _rows(faces, device)]), camera)
    primitives = torch.cat([strokes[: len(segments)], shapes, strokes[len(segments) :]])
    hidden = primitives[:, 4] == 0
    levels = torch.empty((rows.stop - rows.start, width, 3), dtype=torch.uint8, device=device)
    tiles_x, tiles_y = -(-width // TILE), -(-len(levels) // TILE)
    tile_kernel.draw_tiles[(tiles_x * tiles_y,)](
        primitives[torch.sort(hidden, stable=True).indices],
        samples,
        levels,
        (~hidden).sum(),
        rows.start,
        len(levels),
        width,
        height,
        tiles_x,
        COLUMNS=COLUMNS,
        TILE=TILE,
    )
    return levels


@lru_cache(maxsize=8)
def _uploaded(scene: PreparedMap, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return a scene's segments and triangles, and the samples of a pixel, on a device."""
    parts = _rows(scene.segments, device), _rows(scene.triangles, device)
    return *parts, upload(SAMPLES, device)


def _rows(part: Segments | Triangles, device: torch.device) -> Tensor:
    """Send segments ``(S, 11)`` or triangles ``(T, 20)``, all their arrays side by side."""
    flat = [array.reshape(len(array), math.prod(array.shape[1:])) for array in vars(part).values()]
    return upload(np.hstack(flat), device)


def _seen_at(points: Tensor, camera: Tensor) -> Tensor:
    """Return points of the scene ``(..., 3)`` as pixels times depth, and depth."""
    pose, (fx, skew, fy, cx, cy) = camera[:12].view(3, 4), camera[12:17]
    x, y, z = (points @ pose[:, :3].T + pose[:, 3]).unbind(-1)
    return torch.stack([fx * x + skew * y + cx * z, fy * y + cy * z, z], dim=-1)


def _strokes(rows: Tensor, camera: Tensor) -> Tensor:
    """Return the primitives of segments ``(S, COLUMNS)``, 0 where nothing is seen.

    Args:
        rows: See `_rows`.
        camera: A pose, a view as of `kernels`, and by what x and y are multiplied so that a stroke
            is as wide as it is high.
    """
    size, pixels, scale = torch.split(camera[17:], [2, 1, 2])
    ends, style = _seen_at(rows[:, :6].reshape(-1, 2, 3), camera), rows[:, 6:]
    begin, end, depth = ends[:, :1], ends[:, 1:], ends[..., 2:]
    # Where a segment meets the near plane; beyond the far one the kernel draws nothing of it.
    met = begin + (NEAR_M - begin[..., 2:]) / (end - begin)[..., 2:] * (end - begin)
    cut = torch.where(depth >= NEAR_M, ends, met)
    inverse = 1 / cut[..., 2:]
    places = cut[..., :2] * inverse
    half = 0.5 * pixels * style[:, :1]
    on_image = (places.amax(1) >= -half) & (places.amin(1) <= size + half)
    seen = (depth >= NEAR_M).any(1) & (depth < DEPTH_MAX_M).any(1) & on_image.all(1, keepdim=True)
    start, way = places[:, 0] * scale, (places[:, 1] - places[:, 0]) * scale
    share = way / way.square().sum(1, keepdim=True).clamp(min=SHORTEST)
    along = torch.cat([share * scale, -(share * start).sum(1, keepdim=True)], dim=1)
    plane = along * (inverse[:, 1] - inverse[:, 0])
    plane[:, 2:] += inverse[:, 0]
    columns = [
        places.amin(1) - half / scale,
        places.amax(1) + half / scale,
        inverse.amax(1),
        inverse.amin(1),
        plane,
        style[:, 1:],
        style[:, 2:],
        half,
        along,
        start,
        way,
        half.new_zeros(len(half), 5),
    ]
    return torch.where(seen, torch.cat(columns, dim=1), 0.0)


def _shapes(rows: Tensor, camera: Tensor) -> Tensor:
    """Return the primitives of triangles ``(T, COLUMNS)``, 0 where nothing is seen; see `_strokes`.
    Of a triangle that crosses the near plane the kernel draws what lies beyond.
    """
    corners, closed, shade, style = torch.split(rows, [9, 1, 3, 7], dim=1)
    seen_at = _seen_at(corners.reshape(-1, 3, 3), camera)
    planes = torch.linalg.cross(seen_at.roll(-1, 1), seen_at.roll(-2, 1))
    volume = (planes * seen_at)[:, :1].sum(2)  # negative where the front is seen
    planes = planes / volume[..., None]  # each 1/depth in a corner, and 0 on the opposite edge
    depth = seen_at[..., 2]
    near, far = depth.amin(1, keepdim=True), depth.amax(1, keepdim=True)
    places = seen_at[..., :2] / depth[..., None]
    low = torch.where(near < NEAR_M, -torch.inf, places.amin(1))
    high = torch.where(near < NEAR_M, torch.inf, places.amax(1))
    seen = (volume != 0) & ((volume < 0) | (closed == 0)) & (near < DEPTH_MAX_M) & (far >= NEAR_M)
    seen &= ((high >= 0) & (low <= camera[17:19])).all(1, keepdim=True)
    columns = [
        low,
        high,
        1 / near.clamp(min=NEAR_M),
        1 / far,
        planes.sum(1),
        style,
        torch.zeros_like(near),
        planes.flatten(1),
        (planes * shade[..., None]).sum(1),
    ]
    return torch.where(seen, torch.cat(columns, dim=1), 0.0)
