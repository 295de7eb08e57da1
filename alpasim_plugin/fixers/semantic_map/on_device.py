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

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.devices import upload, upload_together
from alpasim_plugin.core.types import F64
from alpasim_plugin.fixers.semantic_map import kernels, tile_kernel
from alpasim_plugin.fixers.semantic_map.prepare import PreparedMap, Segments, Triangles
from alpasim_plugin.fixers.semantic_map.raster import SAMPLES
from alpasim_plugin.fixers.semantic_map.style import DEPTH_MAX_M, NEAR_M

COLUMNS = 29
TILE = 16  # pixels of a tile's side
SHORTEST = 1e-300  # in place of a squared length of 0
MapView = tuple[F64, F64, Triangles, Segments, slice]


def size_of(view: MapView) -> tuple[int, int, int]:
    """Return an image's width and height, and how many rows of it are drawn."""
    width, height = view[0][kernels.WIDTH : kernels.SCALE].astype(int).tolist()
    return width, height, view[4].stop - view[4].start


def draw_tiles(scene: PreparedMap, device: torch.device | str, views: Sequence[MapView]) -> Tensor:
    """Return maps of images of one size, or as many rows of each, ``(V, h, W, 3)`` uint8; see
    `draw.draw_map`.

    Args:
        scene: Its static part is sent once.
        device: Where to draw.
        views: Of each see `draw.seen_from`, and its rows.
    """
    width, height, rows = size_of(views[0])
    numbers = [
        [*pose.ravel(), *view, 1.0, width / height, band.start] for view, pose, *_, band in views
    ]
    moving_faces = _padded([_rows(view[2]) for view in views])
    moving_edges = _padded([_rows(view[3]) for view in views])
    sent = upload_together([np.array(numbers), moving_faces, moving_edges], device)
    cameras, faces, edges = sent
    segments, triangles, samples = _uploaded(scene, device)
    strokes = _strokes(_beside(segments, edges), cameras)
    shapes = _shapes(_beside(triangles, faces), cameras)
    lines, users = torch.split(strokes, [len(segments), edges.shape[1]], dim=1)
    primitives = torch.cat([lines, shapes, users], dim=1)
    hidden = primitives[..., 4] == 0
    order = torch.sort(hidden, dim=1, stable=True).indices
    levels = torch.empty((len(views), rows, width, 3), dtype=torch.uint8, device=device)
    tiles_x = -(-width // TILE)
    tiles_y = -(-rows // TILE)
    tile_kernel.draw_tiles[(len(views) * tiles_x * tiles_y,)](
        torch.take_along_dim(primitives, order[..., None], dim=1),
        samples,
        levels,
        (~hidden).sum(dim=1, dtype=torch.int32),
        cameras,
        primitives.shape[1],
        rows,
        width,
        height,
        tiles_x,
        tiles_y,
        COLUMNS=COLUMNS,
        TILE=TILE,
    )
    return levels


def _beside(static: Tensor, moving: Tensor) -> Tensor:
    """Return the rows of a scene ``(S, C)`` and those of each view ``(V, N, C)``."""
    return torch.cat([static.expand(len(moving), *static.shape), moving], dim=1)


def _padded(parts: Sequence[F64]) -> F64:
    """Return the rows of each view ``(V, N, C)``; what is missing is not a number and not seen."""
    out = np.full((len(parts), max(map(len, parts)), parts[0].shape[1]), np.nan)
    for whole, part in zip(out, parts, strict=True):
        whole[: len(part)] = part
    return out


@lru_cache(maxsize=8)
def _uploaded(scene: PreparedMap, device: torch.device | str) -> tuple[Tensor, Tensor, Tensor]:
    """Return a scene's segments and triangles, and the samples of a pixel, on a device."""
    parts = _rows(scene.segments), _rows(scene.triangles), SAMPLES
    segments, triangles, samples = (upload(part, device) for part in parts)
    return segments, triangles, samples


def _rows(part: Segments | Triangles) -> F64:
    """Return segments ``(S, 11)`` or triangles ``(T, 20)``, all their arrays side by side."""
    return np.hstack(
        [array.reshape(len(array), math.prod(array.shape[1:])) for array in vars(part).values()]
    )


def _seen_at(points: Tensor, cameras: Tensor) -> Tensor:
    """Return points of the scene ``(V, N, K, 3)`` as pixels times depth, and depth."""
    pose = cameras[:, None, :12].reshape(-1, 1, 3, 4)
    fx, skew, fy, cx, cy = cameras[:, 12:17, None, None].unbind(1)
    x, y, z = (points @ pose[..., :3].mT + pose[..., None, :, 3]).unbind(-1)
    return torch.stack([fx * x + skew * y + cx * z, fy * y + cy * z, z], dim=-1)


def _strokes(rows: Tensor, cameras: Tensor) -> Tensor:
    """Return the primitives of segments ``(V, S, COLUMNS)``, 0 where nothing is seen.

    Args:
        rows: ``(V, S, 11)``, see `_rows`.
        cameras: Of each view a pose, a view as of `kernels`, by what x and y are multiplied so that
            a stroke is as wide as it is high, and the first row.
    """
    size, pixels, scale = torch.split(cameras[:, None, 17:22], [2, 1, 2], dim=2)
    ends = _seen_at(rows[..., :6].reshape(*rows.shape[:2], 2, 3), cameras)
    style = rows[..., 6:]
    begin, end = torch.split(ends, 1, dim=2)
    depth = ends[..., 2:]
    # Where a segment meets the near plane; beyond the far one the kernel draws nothing of it.
    met = begin + (NEAR_M - begin[..., 2:]) / (end - begin)[..., 2:] * (end - begin)
    cut = torch.where(depth >= NEAR_M, ends, met)
    inverse = 1 / cut[..., 2:]
    places = cut[..., :2] * inverse
    half = 0.5 * pixels * style[..., :1]
    on_image = (places.amax(2) >= -half) & (places.amin(2) <= size + half)
    is_visible = (
        (depth >= NEAR_M).any(2) & (depth < DEPTH_MAX_M).any(2) & on_image.all(2, keepdim=True)
    )
    start, goal = (places * scale[:, :, None]).unbind(2)
    way = goal - start
    share = way / way.square().sum(2, keepdim=True).clamp(min=SHORTEST)
    along = torch.cat([share * scale, -(share * start).sum(2, keepdim=True)], dim=2)
    plane = along * (inverse[:, :, 1] - inverse[:, :, 0])
    plane[..., 2:] += inverse[:, :, 0]
    columns = [
        places.amin(2) - half / scale,
        places.amax(2) + half / scale,
        inverse.amax(2),
        inverse.amin(2),
        plane,
        style[..., 1:],
        style[..., 2:],
        half,
        along,
        start,
        way,
        half.new_zeros(*half.shape[:2], 5),
    ]
    return torch.where(is_visible, torch.cat(columns, dim=2), 0.0)


def _shapes(rows: Tensor, cameras: Tensor) -> Tensor:
    """Return the primitives of triangles ``(V, T, COLUMNS)``, 0 where nothing is seen; see
    `_strokes`. Of a triangle that crosses the near plane the kernel draws what lies beyond.
    """
    corners, closed, shade, style = torch.split(rows, [9, 1, 3, 7], dim=2)
    seen_at = _seen_at(corners.reshape(*rows.shape[:2], 3, 3), cameras)
    planes = torch.linalg.cross(seen_at.roll(-1, 2), seen_at.roll(-2, 2))
    volume = (planes * seen_at)[:, :, :1].sum(3)  # negative where the front is seen
    planes = planes / volume[..., None]  # each 1/depth in a corner, and 0 on the opposite edge
    depth = seen_at[..., 2]
    near = depth.amin(2, keepdim=True)
    far = depth.amax(2, keepdim=True)
    places = seen_at[..., :2] / depth[..., None]
    low = torch.where(near < NEAR_M, -torch.inf, places.amin(2))
    high = torch.where(near < NEAR_M, torch.inf, places.amax(2))
    is_visible = (
        (volume != 0) & ((volume < 0) | (closed == 0)) & (near < DEPTH_MAX_M) & (far >= NEAR_M)
    )
    is_visible &= ((high >= 0) & (low <= cameras[:, None, 17:19])).all(2, keepdim=True)
    columns = [
        low,
        high,
        1 / near.clamp(min=NEAR_M),
        1 / far,
        planes.sum(2),
        style,
        torch.zeros_like(near),
        planes.flatten(2),
        (planes * shade[..., None]).sum(2),
    ]
    return torch.where(is_visible, torch.cat(columns, dim=2), 0.0)
