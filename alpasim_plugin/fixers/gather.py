"""The operations of the generator in pixels for processors: each is one compiled pass over memory,
where torch makes one for every addition.

Equal to `network.pixel_generator.TORCH` to rounding, on float32 tensors without gradients.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import cv2
import numpy as np
import torch
from numba import njit
from torch import Tensor

from alpasim_plugin.core.kernels import inlined_kernel, kernel
from alpasim_plugin.fixers.network.pixel_generator import sparse_source
from alpasim_plugin.fixers.network.reference_blend import (
    CELL,
    CHANNELS,
    DETAIL,
    HALF,
    NOWHERE,
    BlendHeads,
    Operations,
    ReferenceCells,
)

LARGEST = np.float32(60.0)  # logarithm of a weight: larger ones would overflow, and change nothing


def _array(x: Tensor) -> np.ndarray:
    """Return a tensor's values as a contiguous array; float32 where they are floats."""
    return np.ascontiguousarray((x.float() if x.is_floating_point() else x).numpy())


def gather_references(references: Tensor, render: Tensor, scale: int = 1) -> ReferenceCells:
    """Return the same as `network.reference_blend.gather_references`, of references as bytes."""
    (b, k), (_, h, w, _) = references.shape[:2], render.shape
    sizes = [
        (n, h // side, w // side, side * side * CHANNELS)
        for n, side in ((b, CELL), (b, DETAIL), (b * k, CELL), (b * k, DETAIL))
    ]
    made = ReferenceCells(*(torch.empty(size) for size in sizes))
    lines = _array(references).reshape(b, k, scale * h, -1)
    _gather_references(lines, _array(render), scale, *(part.numpy() for part in made))
    return made


@kernel
def _gather_references(references, render, scale, mean4, mean2, each4, each2):
    batch = references.shape[0]
    count = references.shape[1]
    height = render.shape[1]
    width = render.shape[2]
    share, level = (
        np.float32(1.0) / np.float32(count),
        np.float32(1.0) / np.float32(HALF * scale * scale),
    )
    size = CHANNELS * width
    row = np.empty(size, np.float32)
    mean = np.empty(size, np.float32)
    for b in range(batch):
        for y in range(height):
            i4 = y // CELL
            i2 = y // DETAIL
            at4 = (y % CELL) * CELL * CHANNELS
            at2 = (y % DETAIL) * DETAIL * CHANNELS
            own = render[b, y]
            mean[:] = np.float32(0.0)
            for k in range(count):
                row[:] = np.float32(0.0)
                for line in references[b, k, scale * y : scale * (y + 1)]:
                    if scale == 1:
                        for i in range(len(row)):
                            row[i] = np.float32(line[i])
                    else:
                        for x in range(width):
                            for i in range(scale * x, scale * (x + 1)):
                                for c in range(CHANNELS):
                                    row[CHANNELS * x + c] += np.float32(line[CHANNELS * i + c])
                for x in range(width):
                    holds = row[CHANNELS * x + 3] * level * np.float32(0.5)
                    for c in range(3):
                        row[CHANNELS * x + c] = (
                            row[CHANNELS * x + c] * level - np.float32(1.0) - own[x, c]
                        ) * holds
                    row[CHANNELS * x + 3] = holds
                for i in range(len(row)):
                    mean[i] += row[i] * share
                _put_runs(row, each4[b * count + k, i4], at4, CELL * CHANNELS)
                _put_runs(row, each2[b * count + k, i2], at2, DETAIL * CHANNELS)
            _put_runs(mean, mean4[b, i4], at4, CELL * CHANNELS)
            _put_runs(mean, mean2[b, i2], at2, DETAIL * CHANNELS)


@inlined_kernel
def _put_runs(row, cells, at, run):
    """Write a row of pixels into the row of cells that it crosses, ``run`` values into each, from
    ``at`` on.

    It is inlined, so that ``run`` is a constant where it is called, and a run is a vector.
    """
    for j in range(cells.shape[0]):
        cell = cells[j]
        for i in range(run):
            cell[at + i] = row[run * j + i]


def blend(
    repaired: Tensor, references: Tensor, heads: BlendHeads, scale: int = 1
) -> tuple[Tensor, Tensor]:
    """Return the same as `network.reference_blend.blend`, of references as bytes."""
    out, recorded = torch.empty_like(repaired), torch.empty_like(repaired[..., :1])
    pixels = _array(references).view(np.uint32)[..., 0]
    parts = (_array(part) for part in heads)
    _blend(_array(repaired), pixels, *parts, scale, out.numpy(), recorded.numpy())
    return out, recorded


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _blend(repaired, references, weight, offset_px, correction, scale, out, recorded):
    """Blend a row at a time: where each pixel is looked up, what is found there, its share; channel
    by channel, so that rows are vectors.

    What the heads say is ``scale`` times coarser than the image, offsets twice that, and is
    interpolated between the middles. A pixel of a reference is one number, its first channel the
    lowest byte.
    """
    batch, count, height, width = references.shape
    one = np.float32(1.0)
    zero = np.float32(0.0)
    largest = np.float32(LARGEST)
    nowhere = np.float32(NOWHERE)
    level, half = np.float32(1.0 / HALF), np.float32(0.5 / HALF)
    y0, y1, fy = _between(height, scale)
    x0, x1, fx = _between(width, scale)
    v0, v1, fv = _between(height, scale * DETAIL)
    u0, u1, fu = _between(width, scale * DETAIL)
    coarse_offset = np.empty((2, width // (scale * DETAIL)), np.float32)
    coarse_correction = np.empty((CHANNELS, width // scale), np.float32)
    # The two coarser rows around a row of pixels, by whether their number is odd; the next row of
    # pixels most often lies between the same two.
    offset_rows = np.empty((count, 2, 2, width), np.float32)
    correction_rows = np.empty((count, 2, CHANNELS, width), np.float32)
    row_of = np.empty((count, 4), np.int64)
    place = np.empty((4, width), np.uint32)
    corners = np.empty((4, width), np.uint32)
    shares = np.empty((4, width), np.float32)
    looked_up = np.empty((CHANNELS, width), np.float32)
    blended = np.empty((3, width), np.float32)
    total = np.empty(width, np.float32)
    share = np.empty(width, np.float32)
    for b in range(batch):
        row_of[:] = -1
        for y in range(height):
            total[:] = one
            for x in range(width):
                for c in range(3):
                    blended[c, x] = repaired[b, y, x, c]
            for k in range(count):
                for row in (v0[y], v1[y]):
                    if row_of[k, row % 2] != row:
                        row_of[k, row % 2] = row
                        for j in range(coarse_offset.shape[1]):
                            for c in range(2):
                                coarse_offset[c, j] = np.float32(scale) * offset_px[b, k, row, j, c]
                        _stretched(coarse_offset, u0, u1, fu, offset_rows[k, row % 2])
                upper, lower = offset_rows[k, v0[y] % 2], offset_rows[k, v1[y] % 2]
                for x in range(width):
                    px = np.float32(x) + upper[0, x] + fv[y] * (lower[0, x] - upper[0, x])
                    py = np.float32(y) + upper[1, x] + fv[y] * (lower[1, x] - upper[1, x])
                    px = min(max(px, zero), np.float32(width - 1))
                    py = min(max(py, zero), np.float32(height - 1))
                    left = np.int32(px)
                    top = np.int32(py)
                    a = px - np.float32(left)
                    g = py - np.float32(top)
                    shares[3, x] = g * a
                    shares[1, x] = a - shares[3, x]
                    shares[2, x] = g - shares[3, x]
                    shares[0, x] = one - a - shares[2, x]
                    to_right = min(left + 1, width - 1) - left
                    to_below = (min(top + 1, height - 1) - top) * width
                    first = top * width + left
                    place[0, x] = first
                    place[1, x] = first + to_right
                    place[2, x] = first + to_below
                    place[3, x] = first + to_right + to_below
                image = references[b, k].reshape(-1)
                for corner in range(4):
                    for x in range(width):
                        corners[corner, x] = image[place[corner, x]]
                for c in range(CHANNELS):
                    shift = np.uint32(8 * c)
                    for x in range(width):
                        value = zero
                        for corner in range(4):
                            value += shares[corner, x] * np.float32(
                                np.int32((corners[corner, x] >> shift) & np.uint32(255))
                            )
                        looked_up[c, x] = value
                for row in (y0[y], y1[y]):
                    if row_of[k, 2 + row % 2] != row:
                        row_of[k, 2 + row % 2] = row
                        if scale == 1:
                            _correction_row(
                                weight[b, k], correction[b, k], row, correction_rows[k, row % 2]
                            )
                        else:
                            _correction_row(weight[b, k], correction[b, k], row, coarse_correction)
                            _stretched(coarse_correction, x0, x1, fx, correction_rows[k, row % 2])
                upper, lower = correction_rows[k, y0[y] % 2], correction_rows[k, y1[y] % 2]
                for x in range(width):
                    logarithm = min(upper[3, x] + fy[y] * (lower[3, x] - upper[3, x]), largest)
                    share[x] = np.exp(logarithm) * min(max(looked_up[3, x] * half, nowhere), one)
                    total[x] += share[x]
                for c in range(3):
                    for x in range(width):
                        correction_here = upper[c, x] + fy[y] * (lower[c, x] - upper[c, x])
                        blended[c, x] += share[x] * (
                            looked_up[c, x] * level - one + correction_here
                        )
            for x in range(width):
                over = one / total[x]
                for c in range(3):
                    out[b, y, x, c] = blended[c, x] * over
                recorded[b, y, x, 0] = max(one - over, zero)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _stretched(coarse, before, after, share, out):
    """Write rows of pixels between coarser ones; see `_between`."""
    for c in range(len(out)):
        line = coarse[c]
        for x in range(out.shape[1]):
            first = line[before[x]]
            out[c, x] = first + share[x] * (line[after[x]] - first)


@kernel
def _between(length, scale):
    """Return for each pixel of a row or column the values before and after it, ``scale`` pixels
    wide, and the share of the second.
    """
    before = np.empty(length, np.uint32)
    after = np.empty(length, np.uint32)
    share = np.empty(length, np.float32)
    last = length // scale - 1
    for x in range(length):
        place = max((x + 0.5) / scale - 0.5, 0.0)
        before[x] = min(int(place), last)
        after[x] = min(before[x] + 1, last)
        share[x] = place - before[x]
    return before, after, share


@kernel
def _correction_row(weight, correction, row, out):
    """Write a row of pixels of what a head says of cells: three corrections, then the logarithm of
    the weight.
    """
    i, into = row // DETAIL, row % DETAIL * DETAIL
    for j in range(weight.shape[1]):
        for half in range(DETAIL):
            for c in range(3):
                out[c, DETAIL * j + half] = correction[i, j, 3 * (into + half) + c]
            out[3, DETAIL * j + half] = weight[i, j, into + half]


def smaller(x: Tensor, scale: int) -> Tensor:
    """Average images ``(B, H, W, C)`` of at most four channels over squares of ``scale`` pixels."""
    return _resize(x, 1 / scale, cv2.INTER_AREA)


def larger(x: Tensor, scale: int) -> Tensor:
    """Enlarge images ``(B, H, W, C)`` of at most four channels bilinearly."""
    return _resize(x, scale, cv2.INTER_LINEAR)


def _resize(x: Tensor, factor: float, method: int) -> Tensor:
    if factor == 1:
        return x
    out = torch.empty(
        x.shape[0], round(x.shape[1] * factor), round(x.shape[2] * factor), x.shape[3]
    )
    for image, resized in zip(_array(x), out.numpy(), strict=True):
        cv2.resize(image, resized.shape[1::-1], dst=resized, interpolation=method)
    return out


CPU = Operations(gather_references, blend, smaller, larger, sparse_source)
