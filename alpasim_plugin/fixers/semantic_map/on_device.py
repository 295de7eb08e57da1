"""Draw the semantic map on a GPU: what is in view is sent, and its image stays there.

A primitive is a stroke or a shape, as `kernels` gives them, in `COLUMNS` columns:

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

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.types import F64
from alpasim_plugin.fixers.semantic_map import kernels, tile_kernel
from alpasim_plugin.fixers.semantic_map.raster import SAMPLES

COLUMNS = 29
TILE = 16  # pixels of a tile's side
SHORTEST = 1e-300  # in place of a squared length of 0


def draw_tiles(
    lines: F64, shapes: F64, edges: F64, size: tuple[int, int], rows: slice, device: torch.device
) -> Tensor:
    """Return rows of the map of an image ``(h, W, 3)`` uint8; see `raster.draw_bands`.

    Args:
        lines, shapes, edges: Strokes, shapes, and strokes again, as `kernels` gives them.
        size: Height and width of the image.
        rows: Of the image.
        device: Where to draw.
    """
    height, width = size
    stretch = width / height
    parts = _of_strokes(lines, stretch), _of_shapes(shapes), _of_strokes(edges, stretch)
    primitives = np.concatenate(parts)
    levels = torch.empty((rows.stop - rows.start, width, 3), dtype=torch.uint8, device=device)
    tiles_x, tiles_y = -(-width // TILE), -(-len(levels) // TILE)
    tile_kernel.draw_tiles[(tiles_x * tiles_y,)](
        torch.from_numpy(primitives).to(device),
        torch.from_numpy(SAMPLES).to(device),
        levels,
        len(primitives),
        rows.start,
        len(levels),
        width,
        height,
        tiles_x,
        COLUMNS=COLUMNS,
        TILE=TILE,
    )
    return levels


def _of_strokes(strokes: F64, stretch: float) -> F64:
    """Return the primitives of strokes; ``stretch`` is the image's width over its height."""
    ends = strokes[:, : kernels.HALF].reshape(-1, 2, 3)
    places, inverse = ends[..., :2], ends[..., 2]
    half, style = strokes[:, kernels.HALF : kernels.BIAS], strokes[:, kernels.BIAS :]
    scale = np.array([1.0, stretch])  # to where a stroke is as wide as it is high
    begin, end = (places * scale).swapaxes(0, 1)
    step = end - begin
    share = step / np.maximum(np.sum(step**2, axis=1, keepdims=True), SHORTEST)
    along = np.hstack([share * scale, -np.sum(share * begin, axis=1, keepdims=True)])
    columns = [
        places.min(axis=1) - half / scale,
        places.max(axis=1) + half / scale,
        inverse.max(axis=1, keepdims=True),
        inverse.min(axis=1, keepdims=True),
        along * np.diff(inverse) + inverse[:, :1] * [0, 0, 1],
        style,
        style[:, 1:],
        half,
        along,
        begin,
        step,
        np.zeros((len(ends), 5)),
    ]
    return np.hstack(columns)


def _of_shapes(shapes: F64) -> F64:
    """Return the primitives of shapes that have an area."""
    corners = shapes[:, : kernels.NEAREST].reshape(-1, 3, 4).swapaxes(1, 2)
    matrix = np.insert(corners[:, :2], 2, 1.0, axis=1)
    seen = np.linalg.det(matrix) != 0.0
    corners = corners[seen]
    planes = np.linalg.inv(matrix[seen])  # each 1 in a corner, and 0 on the opposite edge
    inverse, shade = ((corners[:, k : k + 1] @ planes)[:, 0] for k in (2, 3))
    rest = shapes[seen, kernels.NEAREST :]
    box = corners[:, :2].min(axis=2), corners[:, :2].max(axis=2)
    flat = planes.reshape(-1, 9)
    return np.hstack([*box, rest[:, :2], inverse, rest[:, 2:], 0 * flat[:, :1], flat, shade])
