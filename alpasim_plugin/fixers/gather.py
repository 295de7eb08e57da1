"""What a generator in pixels reads and writes, and how it compares references, for processors: one
pass instead of one for each operation.

`gather_cells_cpu` is that of `nets.pixel_generator`, the others are those of
`nets.reference_blend`.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.kernels import njit
from alpasim_plugin.fixers.network.pixel_generator import (
    DETAIL_IMAGES,
    IMAGES,
    GatheredCells,
    PixelState,
)
from alpasim_plugin.fixers.network.pixel_layers import cpu_operator
from alpasim_plugin.fixers.network.reference_blend import (
    CELL,
    CHANNELS,
    DETAIL,
    MATCH_CELLS,
    NOWHERE,
    OFFSET_PX,
    BesideCells,
    BlendHeads,
)
from alpasim_plugin.fixers.views import HALF

LARGEST = np.float32(60.0)  # logarithm of a weight: larger ones would overflow, and change nothing


def gather_cells_cpu(
    render: Tensor,
    opacity: Tensor,
    sdmap: Tensor,
    state: PixelState,
    source: Tensor,
    dtype: torch.dtype,
) -> GatheredCells:
    """Return the same as `nets.pixel_generator.gather_cells`, of float32 tensors on the CPU, bit
    for bit, rounded to ``dtype``.
    """
    b, h, w, _ = render.shape
    images = render, opacity, sdmap, state.output, state.render, source, state.hidden
    rows = [np.ascontiguousarray(x.numpy()).reshape(*x.shape[:2], -1) for x in images]
    coarse = torch.empty(
        b, h // CELL, w // CELL, CELL * CELL * IMAGES + state.hidden.shape[-1], dtype=dtype
    )
    fine = torch.empty(b, h // DETAIL, w // DETAIL, DETAIL * DETAIL * DETAIL_IMAGES, dtype=dtype)
    _gather_coarse(*rows, source is not render, _array(coarse))
    _gather_fine(rows[0], rows[1], rows[3], _array(fine))
    return GatheredCells(coarse, fine)


def _array(x: Tensor) -> np.ndarray:
    """Return a tensor's values without copying; those of bfloat16, which NumPy does not know, as
    their bits in uint16.
    """
    array: np.ndarray = (x.view(torch.uint16) if x.dtype == torch.bfloat16 else x).numpy()
    return array


@njit(cache=True, nogil=True, inline="always")
def _float(x):
    """Return a float32 of one, or of the bits of a bfloat16."""
    return (
        np.uint32(np.uint32(x) << np.uint32(16)).view(np.float32) if isinstance(x, np.uint16) else x
    )


@njit(cache=True, nogil=True, inline="always")
def _write(values, out):
    """Write a line of float32, as the bits of bfloat16 where ``out`` is of uint16: the nearest, of
    two as near the even one.
    """
    if out.itemsize == 4:
        for i in range(len(values)):
            out[i] = values[i]
        return
    bits = values.view(np.uint32)
    for i in range(len(values)):
        rounded = (
            bits[i] + np.uint32(0x7FFF) + ((bits[i] >> np.uint32(16)) & np.uint32(1))
        ) >> np.uint32(16)
        out[i] = (
            rounded
            if bits[i] & np.uint32(0x7FFFFFFF) <= np.uint32(0x7F800000)
            else np.uint32(0x7FC0)
        )  # or not a number


@njit(cache=True, nogil=True)
def _gather_coarse(render, opacity, sdmap, output, last_render, source, hidden, noise, coarse):
    """Write the cells of 4 x 4 pixels of rows ``(B, H, W C)``; without ``noise`` the source is the
    render.
    """
    batch, rows, columns, size = coarse.shape
    side, run = CELL, 3 * CELL  # pixels and values of a cell's row
    one, three = side * side, side * run  # values of a cell of one and of three channels
    cell = np.zeros(size, np.float32)
    for b in range(batch):
        for i in range(rows):
            for j in range(columns):
                for r in range(side):
                    y = side * i + r
                    x = run * j
                    at = run * r
                    for k in range(side):
                        cell[three + side * r + k] = np.float32(2.0) * opacity[
                            b, y, side * j + k
                        ] - np.float32(1.0)
                    for k in range(run):
                        cell[at + k] = render[b, y, x + k]
                        cell[three + one + at + k] = sdmap[b, y, x + k]
                        cell[2 * three + one + at + k] = output[b, y, x + k]
                        cell[3 * three + one + at + k] = last_render[b, y, x + k]
                        if noise:
                            cell[4 * three + one + at + k] = (
                                source[b, y, x + k] - render[b, y, x + k]
                            )
                channels = size - 5 * three - one
                for c in range(channels):
                    cell[5 * three + one + c] = hidden[b, i, channels * j + c]
                _write(cell, coarse[b, i, j])


@njit(cache=True, nogil=True)
def _gather_fine(render, opacity, output, fine):
    """Write the cells of 2 x 2 pixels of rows ``(B, H, W C)``."""
    batch, rows, columns, size = fine.shape
    side, run = DETAIL, 3 * DETAIL
    one, three = side * side, side * run
    cells = np.empty((columns, size), np.float32)
    for b in range(batch):
        for i in range(rows):
            for j in range(columns):
                cell = cells[j]
                for r in range(side):
                    y = side * i + r
                    x = run * j
                    at = run * r
                    for k in range(side):
                        cell[three + side * r + k] = np.float32(2.0) * opacity[
                            b, y, side * j + k
                        ] - np.float32(1.0)
                    for k in range(run):
                        cell[at + k] = render[b, y, x + k]
                        cell[three + one + at + k] = output[b, y, x + k]
            _write(cells.reshape(-1), fine[b, i].reshape(-1))


def gather_beside_cpu(
    references: Tensor, render: Tensor, scale: int = 1, dtype: torch.dtype = torch.float32
) -> BesideCells:
    """Return the same as `nets.reference_blend.gather_beside`, to rounding, of references of bytes
    ``scale`` times larger than the render.

    They are ``(B, K, scale H, scale W, 4)`` uint8, and averaged over squares of pixels.
    """
    (b, k), (_, h, w, _) = references.shape[:2], render.shape
    sizes = [
        (n, h // side, w // side, side * side * CHANNELS)
        for n, side in ((b, CELL), (b, DETAIL), (b * k, CELL), (b * k, DETAIL))
    ]
    made = BesideCells(*(torch.empty(size, dtype=dtype) for size in sizes))
    lines = np.ascontiguousarray(references.numpy()).reshape(b, k, scale * h, -1)
    _gather_beside(
        lines, np.ascontiguousarray(render.numpy()), scale, *(_array(part) for part in made)
    )
    return made


@njit(cache=True, nogil=True)
def _gather_beside(references, render, scale, mean4, mean2, each4, each2):
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
    said = np.empty(size, mean4.dtype)
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
                _write(row, said)
                _put_runs(said, each4[b * count + k, i4], at4, CELL * CHANNELS)
                _put_runs(said, each2[b * count + k, i2], at2, DETAIL * CHANNELS)
            _write(mean, said)
            _put_runs(said, mean4[b, i4], at4, CELL * CHANNELS)
            _put_runs(said, mean2[b, i2], at2, DETAIL * CHANNELS)


@njit(cache=True, nogil=True, inline="always")
def _put_runs(row, cells, at, run):
    """Write a row of pixels into the row of cells that it crosses, ``run`` values into each, from
    ``at`` on.

    It is inlined, so that ``run`` is a constant where it is called, and a run is a vector.
    """
    for j in range(cells.shape[0]):
        cell = cells[j]
        for i in range(run):
            cell[at + i] = row[run * j + i]


@cpu_operator("likeness(Tensor sought, Tensor shown) -> Tensor")
def likeness_cpu(sought: Tensor, shown: Tensor) -> Tensor:
    """Return the same as `nets.reference_blend.likeness`, of float32 or bfloat16 tensors on the
    CPU, to rounding; it has no gradient.
    """
    reach = 2 * MATCH_CELLS + 1
    out = torch.empty(*shown.shape[:3], reach * reach, dtype=sought.dtype)
    _likeness(*(np.ascontiguousarray(_array(x)) for x in (sought, shown)), _array(out))
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _likeness(sought, shown, out):
    """Multiply and add with a row's cells as the lanes of vectors: channels are few, cells are
    many.
    """
    images, height, width, channels = shown.shape
    reach, border = 2 * MATCH_CELLS + 1, MATCH_CELLS
    count = images // sought.shape[0]
    around = np.zeros((height + 2 * border, channels, width + 2 * border), np.float32)
    own = np.empty((channels, width), np.float32)
    alike, row = (
        np.empty((reach * reach, width), np.float32),
        np.empty((width, reach * reach), np.float32),
    )
    share = np.float32(1.0) / np.float32(channels)
    for n in range(images):
        for i in range(height):
            for j in range(width):
                for c in range(channels):
                    around[i + border, c, j + border] = _float(shown[n, i, j, c])
        for i in range(height):
            for j in range(width):
                for c in range(channels):
                    own[c, j] = _float(sought[n // count, i, j, c]) * share
            alike[:] = np.float32(0.0)
            for di in range(reach):
                for c in range(channels):
                    line, mine = around[i + di, c], own[c]
                    for dj in range(reach):
                        sums = alike[reach * di + dj]
                        for j in range(width):
                            sums[j] += mine[j] * line[j + dj]
            for j in range(width):
                for place in range(reach * reach):
                    row[j, place] = alike[place, j]
            _write(row.reshape(-1), out[n, i].reshape(-1))


@cpu_operator("offsets(Tensor at2, Tensor at4) -> Tensor")
def offsets_cpu(at2: Tensor, at4: Tensor) -> Tensor:
    """Return the same as `nets.reference_blend.offsets`, of float32 or bfloat16 tensors on the CPU,
    to rounding; it has no gradient.
    """
    out = torch.empty(at2.shape)
    _offsets(
        _array(at2), np.ascontiguousarray(_array(at4)), out.flatten(2).numpy()
    )  # the first: part of what the head says, in place
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _offsets(at2, at4, out):
    images, height, width, axes = at2.shape
    own = np.float32(0.75)
    next_to = np.float32(0.25)
    one = np.float32(1.0)
    two = np.float32(2.0)
    most = np.float32(OFFSET_PX)
    columns = at4.shape[2]
    rows = np.empty((columns, axes), np.float32)
    row = np.empty(width * axes, np.float32)
    fallen = np.empty(width * axes, np.float32)
    for n in range(images):
        for y in range(height):
            i = y // 2
            other = max(i - 1, 0) if y % 2 == 0 else min(i + 1, at4.shape[1] - 1)
            for j in range(columns):
                for c in range(axes):
                    rows[j, c] = own * _float(at4[n, i, j, c]) + next_to * _float(
                        at4[n, other, j, c]
                    )
            for j in range(columns):
                before, after = max(j - 1, 0), min(j + 1, columns - 1)
                for c in range(axes):
                    half = own * rows[j, c]
                    row[2 * axes * j + c] = (
                        half + next_to * rows[before, c] + _float(at2[n, y, 2 * j, c])
                    )
                    row[2 * axes * j + axes + c] = (
                        half + next_to * rows[after, c] + _float(at2[n, y, 2 * j + 1, c])
                    )
            for x in range(len(row)):
                fallen[x] = -two * abs(row[x])
            _exponentials(fallen)
            for x in range(len(row)):  # tanh |x| = (1 - exp(-2 |x|)) / (1 + exp(-2 |x|))
                out[n, y, x] = np.copysign(most * (one - fallen[x]) / (one + fallen[x]), row[x])


def mix_cpu(
    repaired: Tensor, references: Tensor, heads: BlendHeads, scale: int = 1
) -> tuple[Tensor, Tensor]:
    """Return the same as `nets.reference_blend.mix` of `sources_of`, on the CPU, to rounding;
    references are bytes.
    """
    out, recorded = torch.empty_like(repaired), torch.empty_like(repaired[..., :1])
    pixels = np.ascontiguousarray(references.numpy()).view(np.uint32)[..., 0]
    _mix(
        np.ascontiguousarray(repaired.numpy()),
        pixels,
        *(_array(part) for part in heads),
        scale,
        out.numpy(),
        recorded.numpy(),
    )
    return out, recorded


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _mix(repaired, references, weight, offset_px, correction, scale, out, recorded):
    """Blend a row at a time: where each pixel is looked up, what is found there, its share; channel
    by channel, so that rows are vectors.

    What the heads say is ``scale`` times coarser than the picture, offsets twice that, and is
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
    rows, near = (
        np.empty((2, width // (scale * DETAIL)), np.float32),
        np.empty((CHANNELS, width // scale), np.float32),
    )
    # What is said of the two coarser rows around a row of pixels, by whether their number is odd;
    # the next row most often has the same.
    moves, words = (
        np.empty((count, 2, 2, width), np.float32),
        np.empty((count, 2, CHANNELS, width), np.float32),
    )
    row_of = np.empty((count, 4), np.int64)
    place = np.empty((4, width), np.uint32)
    corners = np.empty((4, width), np.uint32)
    shares = np.empty((4, width), np.float32)
    found, blended = np.empty((CHANNELS, width), np.float32), np.empty((3, width), np.float32)
    total, share = np.empty(width, np.float32), np.empty(width, np.float32)
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
                        for j in range(rows.shape[1]):
                            for c in range(2):
                                rows[c, j] = np.float32(scale) * offset_px[b, k, row, j, c]
                        _stretched(rows, u0, u1, fu, moves[k, row % 2])
                upper, lower = moves[k, v0[y] % 2], moves[k, v1[y] % 2]
                for x in range(width):
                    px = np.float32(x) + upper[0, x] + fv[y] * (lower[0, x] - upper[0, x])
                    py = np.float32(y) + upper[1, x] + fv[y] * (lower[1, x] - upper[1, x])
                    px, py = (
                        min(max(px, zero), np.float32(width - 1)),
                        min(max(py, zero), np.float32(height - 1)),
                    )
                    left, top = np.int32(px), np.int32(py)
                    a, g = px - np.float32(left), py - np.float32(top)
                    shares[3, x] = g * a
                    shares[1, x], shares[2, x] = a - shares[3, x], g - shares[3, x]
                    shares[0, x] = one - a - shares[2, x]
                    beside, under = (
                        min(left + 1, width - 1) - left,
                        (min(top + 1, height - 1) - top) * width,
                    )
                    at = top * width + left
                    place[0, x], place[1, x], place[2, x], place[3, x] = (
                        at,
                        at + beside,
                        at + under,
                        at + beside + under,
                    )
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
                        found[c, x] = value
                for row in (y0[y], y1[y]):
                    if row_of[k, 2 + row % 2] != row:
                        row_of[k, 2 + row % 2] = row
                        if scale == 1:
                            _said(weight[b, k], correction[b, k], row, words[k, row % 2])
                        else:
                            _said(weight[b, k], correction[b, k], row, near)
                            _stretched(near, x0, x1, fx, words[k, row % 2])
                upper, lower = words[k, y0[y] % 2], words[k, y1[y] % 2]
                for x in range(width):
                    share[x] = min(upper[3, x] + fy[y] * (lower[3, x] - upper[3, x]), largest)
                _exponentials(share)
                for x in range(width):
                    share[x] *= min(max(found[3, x] * half, nowhere), one)
                    total[x] += share[x]
                for c in range(3):
                    for x in range(width):
                        said = upper[c, x] + fy[y] * (lower[c, x] - upper[c, x])
                        blended[c, x] += share[x] * (found[c, x] * level - one + said)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _said(weight, correction, row, out):
    """Write a row of pixels of what a head says of cells: three corrections, then the logarithm of
    the weight.
    """
    i, into = row // DETAIL, row % DETAIL * DETAIL
    for j in range(weight.shape[1]):
        for half in range(DETAIL):
            for c in range(3):
                out[c, DETAIL * j + half] = _float(correction[i, j, 3 * (into + half) + c])
            out[3, DETAIL * j + half] = _float(weight[i, j, into + half])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _exponentials(values):
    """Replace float32 values by their exponentials, within 3e-7 of them; those below -87 by that of
    -87.

    A whole power of two, written as the exponent of a float, times a polynomial on [-1/2, 1/2]
    (Taylor, degree 6, in the natural logarithm of two).
    """
    power = np.empty(len(values), np.int32)
    scale = power.view(np.float32)
    for i in range(len(values)):
        t = max(values[i], np.float32(-87.0)) * np.float32(1.4426950408889634)
        whole = np.int32(np.floor(t + np.float32(0.5)))
        f = (t - np.float32(whole)) * np.float32(0.6931471805599453)
        power[i] = (whole + np.int32(127)) << np.int32(23)
        p = np.float32(1 / 720)
        p = p * f + np.float32(1 / 120)
        p = p * f + np.float32(1 / 24)
        p = p * f + np.float32(1 / 6)
        p = p * f + np.float32(1 / 2)
        p = p * f + np.float32(1.0)
        values[i] = p * f + np.float32(1.0)
    for i in range(len(values)):
        values[i] *= scale[i]
