"""What a generator in pixels reads and writes, for processors: one pass over the images instead of one for each operation.

`gather_cells_cpu` is `nets.pixel_generator.gather_cells`; `gather_beside_cpu` and `mix_cpu` are those of `nets.reference_blend`.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.nets.pixel_generator import DETAIL_IMAGES, IMAGES, GatheredCells, PixelState
from alpasim_plugin.nets.reference_blend import CELL, CHANNELS, DETAIL, NOWHERE, BesideCells, BlendHeads
from alpasim_plugin.plugins.kernels import njit

LARGEST = np.float32(60.0)  # logarithm of a weight: larger ones would overflow, and change nothing


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


def gather_beside_cpu(references: Tensor, render: Tensor) -> BesideCells:
    """Return the same as `nets.reference_blend.gather_beside`, of float32 tensors on the CPU, to rounding."""
    b, k, h, w, _ = references.shape
    sizes = [(n, h // side, w // side, side * side * CHANNELS) for n, side in ((b, CELL), (b, DETAIL), (b * k, CELL), (b * k, DETAIL))]
    made = BesideCells(*(torch.empty(size) for size in sizes))
    _gather_beside(np.ascontiguousarray(references.numpy()), np.ascontiguousarray(render.numpy()), *(part.numpy() for part in made))
    return made


@njit(cache=True, nogil=True)
def _gather_beside(references, render, mean4, mean2, each4, each2):
    batch, count, height, width, _ = references.shape
    share = np.float32(1.0) / np.float32(count)
    for b in range(batch):
        for y in range(height):
            i4, i2, r4, r2 = y // CELL, y // DETAIL, (y % CELL) * CELL, (y % DETAIL) * DETAIL
            for x in range(width):
                j4, j2 = x // CELL, x // DETAIL
                at4, at2 = CHANNELS * (r4 + x % CELL), CHANNELS * (r2 + x % DETAIL)
                for c in range(CHANNELS):
                    total = np.float32(0.0)
                    for k in range(count):
                        value = references[b, k, y, x, 3]
                        if c < 3:
                            value *= references[b, k, y, x, c] - render[b, y, x, c]
                        each4[b * count + k, i4, j4, at4 + c] = value
                        each2[b * count + k, i2, j2, at2 + c] = value
                        total += value
                    mean4[b, i4, j4, at4 + c] = total * share
                    mean2[b, i2, j2, at2 + c] = total * share


def mix_cpu(repaired: Tensor, references: Tensor, heads: BlendHeads) -> tuple[Tensor, Tensor]:
    """Return the same as `nets.reference_blend.mix`, of float32 tensors on the CPU, to rounding."""
    out, recorded = torch.empty_like(repaired), torch.empty_like(repaired[..., :1])
    images = (np.ascontiguousarray(x.numpy()) for x in (repaired, references, *heads))
    _mix(*images, np.float32(NOWHERE), out.numpy(), recorded.numpy())
    return out, recorded


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _mix(repaired, references, weight, offset_px, correction, nowhere, out, recorded):
    batch, count, height, width, _ = references.shape
    side, half = DETAIL, np.float32(0.5)
    cell_rows, cell_columns = height // side, width // side
    for b in range(batch):
        for y in range(height):
            # Offsets are interpolated between the middles of cells.
            v = min(max((y + half) / side - half, np.float32(0.0)), np.float32(cell_rows - 1))
            v0 = int(v)
            v1, fv = min(v0 + 1, cell_rows - 1), np.float32(v - v0)
            for x in range(width):
                u = min(max((x + half) / side - half, np.float32(0.0)), np.float32(cell_columns - 1))
                u0 = int(u)
                u1, fu = min(u0 + 1, cell_columns - 1), np.float32(u - u0)
                i, j = y // side, x // side
                inside = (y % side) * side + x % side
                total = np.float32(1.0)
                r, g, blue = repaired[b, y, x, 0], repaired[b, y, x, 1], repaired[b, y, x, 2]
                for k in range(count):
                    field = offset_px[b, k]
                    w00, w01, w10, w11 = (1 - fv) * (1 - fu), (1 - fv) * fu, fv * (1 - fu), fv * fu
                    dx = w00 * field[v0, u0, 0] + w01 * field[v0, u1, 0] + w10 * field[v1, u0, 0] + w11 * field[v1, u1, 0]
                    dy = w00 * field[v0, u0, 1] + w01 * field[v0, u1, 1] + w10 * field[v1, u0, 1] + w11 * field[v1, u1, 1]
                    px = min(max(x + dx, np.float32(0.0)), np.float32(width - 1))
                    py = min(max(y + dy, np.float32(0.0)), np.float32(height - 1))
                    x0, y0 = int(px), int(py)
                    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
                    fx, fy = np.float32(px - x0), np.float32(py - y0)
                    a00, a01, a10, a11 = (1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx
                    image = references[b, k]
                    holds = a00 * image[y0, x0, 3] + a01 * image[y0, x1, 3] + a10 * image[y1, x0, 3] + a11 * image[y1, x1, 3]
                    share = np.exp(min(weight[b, k, i, j, inside], LARGEST)) * min(max(holds, nowhere), np.float32(1.0))
                    total += share
                    extra = correction[b, k, i, j]
                    at = 3 * inside
                    r += share * (
                        a00 * image[y0, x0, 0] + a01 * image[y0, x1, 0] + a10 * image[y1, x0, 0] + a11 * image[y1, x1, 0] + extra[at]
                    )
                    g += share * (
                        a00 * image[y0, x0, 1] + a01 * image[y0, x1, 1] + a10 * image[y1, x0, 1] + a11 * image[y1, x1, 1] + extra[at + 1]
                    )
                    blue += share * (
                        a00 * image[y0, x0, 2] + a01 * image[y0, x1, 2] + a10 * image[y1, x0, 2] + a11 * image[y1, x1, 2] + extra[at + 2]
                    )
                out[b, y, x, 0], out[b, y, x, 1], out[b, y, x, 2] = r / total, g / total, blue / total
                recorded[b, y, x, 0] = 1 - 1 / total


def draw_and_gather() -> None:
    """Draw a line and a car, carry a picture into another view and gather its cells: tiny cases of all kernels of what a fixer reads."""
    from alpasim_plugin.core.geometry import se2
    from alpasim_plugin.core.types import Box, CameraSpec, LaneMap
    from alpasim_plugin.fixers.warp import Picture, WarpTarget, on_boxes, warp
    from alpasim_plugin.semantic_map.draw import draw_map
    from alpasim_plugin.semantic_map.prepare import ActorBox, prepare_map

    side_px = 16
    ahead = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # camera axes in a rig that looks along x
    edge = np.array([[2.0, -1.0, 0.0], [9.0, 1.0, 0.0]])
    K = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]])
    T_world_car, box = se2(5.0, 0.0, 0.0, 0.8), Box(4.5, 1.9, 1.6)
    camera = CameraSpec("front", side_px, side_px, K, ahead)
    draw_map(prepare_map(LaneMap({}, road_edges=(edge,))), camera, ahead, [ActorBox(T_world_car, box, "car")], threads=1)

    depth = np.ones((side_px, side_px), np.float32)
    picture = Picture(K, ahead, np.zeros((side_px, side_px, 3), np.uint8), depth, {"car": T_world_car})
    warp(picture, WarpTarget(K, ahead, depth, {"car": T_world_car}), {"car": box})
    for focal_px in (8.0, 80.0):  # the car fills a part of the picture's rows, and all of them
        on_boxes(depth.shape, np.array([[focal_px, 0, 8], [0, focal_px, 8], [0, 0, 1]]), ahead, {"car": T_world_car}, {"car": box})

    image = torch.zeros(1, side_px, side_px, 3)
    state = PixelState(image, image, image[:, ::CELL, ::CELL], image, image, image[..., :1])
    gather_cells_cpu(image, image[..., :1], image, state, image + 1)
    references = torch.zeros(1, 1, side_px, side_px, CHANNELS)
    gather_beside_cpu(references, image)
    half = side_px // DETAIL
    mix_cpu(image, references, BlendHeads(*(torch.zeros(1, 1, half, half, values) for values in (DETAIL * DETAIL, 2, 3 * DETAIL * DETAIL))))
