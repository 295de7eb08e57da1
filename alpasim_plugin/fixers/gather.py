"""`gather_cells` for processors: one pass over the images instead of a copy per image and another to join them."""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from torch import Tensor

from alpasim_plugin.nets.pixel_generator import CELL, DETAIL, DETAIL_IMAGES, IMAGES, GatheredCells, PixelState


def gather_cells_cpu(render: Tensor, opacity: Tensor, sdmap: Tensor, state: PixelState, source: Tensor) -> GatheredCells:
    """Return the same as `nets.pixel_generator.gather_cells`, of float32 tensors on the CPU, bit for bit."""
    b, h, w, _ = render.shape
    noise = 0 if source is render else 1
    images = [np.ascontiguousarray(x.numpy()) for x in (render, opacity, sdmap, state.output, state.render, source, state.hidden)]
    coarse = torch.empty(b, h // CELL, w // CELL, CELL * CELL * IMAGES + state.hidden.shape[-1])
    fine = torch.empty(b, h // DETAIL, w // DETAIL, DETAIL * DETAIL * DETAIL_IMAGES)
    _gather_coarse(*images, noise, coarse.numpy())
    _gather_fine(images[0], images[1], images[3], fine.numpy())
    return GatheredCells(coarse, fine)


@njit(cache=True, nogil=True)
def _gather_coarse(render, opacity, sdmap, output, last_render, source, hidden, noise, coarse):
    """Write the cells of 4 x 4 pixels; without ``noise`` the source is the render."""
    batch, rows, columns, _ = coarse.shape
    side, run = CELL, 3 * CELL  # pixels and values of a cell's row
    one, three = side * side, side * run  # values of a cell of one and of three channels
    for b in range(batch):
        for i in range(rows):
            for j in range(columns):
                cell = coarse[b, i, j]
                for r in range(side):
                    y, x, at = side * i + r, side * j, run * r
                    for k in range(side):
                        cell[three + side * r + k] = np.float32(2.0) * opacity[b, y, x + k, 0] - np.float32(1.0)
                        for c in range(3):
                            value = render[b, y, x + k, c]
                            to = at + 3 * k + c
                            cell[to] = value
                            cell[three + one + to] = sdmap[b, y, x + k, c]
                            cell[2 * three + one + to] = output[b, y, x + k, c]
                            cell[3 * three + one + to] = last_render[b, y, x + k, c]
                            cell[4 * three + one + to] = source[b, y, x + k, c] - value if noise else np.float32(0.0)
                for c in range(hidden.shape[3]):
                    cell[5 * three + one + c] = hidden[b, i, j, c]


@njit(cache=True, nogil=True)
def _gather_fine(render, opacity, output, fine):
    """Write the cells of 2 x 2 pixels."""
    batch, rows, columns, _ = fine.shape
    side, run = DETAIL, 3 * DETAIL
    one, three = side * side, side * run
    for b in range(batch):
        for i in range(rows):
            for j in range(columns):
                cell = fine[b, i, j]
                for r in range(side):
                    for k in range(side):
                        y, x = side * i + r, side * j + k
                        cell[three + side * r + k] = np.float32(2.0) * opacity[b, y, x, 0] - np.float32(1.0)
                        for c in range(3):
                            cell[run * r + 3 * k + c] = render[b, y, x, c]
                            cell[three + one + run * r + 3 * k + c] = output[b, y, x, c]


def draw_and_gather() -> None:
    """Draw a line and a car, and gather a picture's cells: a tiny case that makes numba compile the kernels of what a fixer reads."""
    from alpasim_plugin.core.geometry import se2
    from alpasim_plugin.core.types import Box, CameraSpec, LaneMap
    from alpasim_plugin.semantic_map.draw import draw_map
    from alpasim_plugin.semantic_map.prepare import ActorBox, prepare_map

    side_px = 16
    ahead = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # camera axes in a rig that looks along x
    edge = np.array([[2.0, -1.0, 0.0], [9.0, 1.0, 0.0]])
    camera = CameraSpec("front", side_px, side_px, np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), ahead)
    car = ActorBox(se2(5.0, 0.0, 0.0, 0.8), Box(4.5, 1.9, 1.6), "car")
    draw_map(prepare_map(LaneMap({}, road_edges=(edge,))), camera, ahead, [car], threads=1)
    image = torch.zeros(1, side_px, side_px, 3)
    state = PixelState(image, image, image[:, ::CELL, ::CELL], image, image, image[..., :1])
    gather_cells_cpu(image, image[..., :1], image, state, image + 1)
