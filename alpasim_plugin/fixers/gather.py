"""The operations of the generator in pixels for processors: each is one compiled pass over memory,
where torch makes one for every addition.

Equal to `network.pixel_generator.TORCH` to rounding, on float32 tensors without gradients.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import math
from itertools import product

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.kernels import inlined_kernel, kernel, vector_kernel
from alpasim_plugin.fixers.network.pixel_generator import sparse_source
from alpasim_plugin.fixers.network.reference_blend import (
    CELL,
    CHANNELS,
    DETAIL,
    FINER_PX,
    HALF,
    MATCH_CELLS,
    NOWHERE,
    OFFSET_PX,
    BlendHeads,
    Operations,
    ReferenceCells,
)
from alpasim_plugin.gaussians.raster.stages import map_on_threads

LARGEST = np.float32(60.0)  # logarithm of a weight: larger ones would overflow, and change nothing
# The same of a weight that is next to nothing.
LEAST = np.float32(-87.0)
BAND = 8  # rows of a smaller image that are enlarged at a time


def _array(x: Tensor) -> np.ndarray:
    """Return a tensor's values as a contiguous array; float32 where they are floats."""
    return np.ascontiguousarray((x.float() if x.is_floating_point() else x).numpy())


def gather_references(references: Tensor, render: Tensor) -> ReferenceCells:
    """Return the same as `network.reference_blend.gather_references`, of references as bytes."""
    (b, k), (_, h, w, _) = references.shape[:2], render.shape
    sizes = [
        (n, h // side, w // side, side * side * CHANNELS)
        for n, side in ((b, CELL), (b, DETAIL), (b * k, CELL), (b * k, DETAIL))
    ]
    made = ReferenceCells(*(torch.empty(size) for size in sizes))
    lines = _array(references).reshape(b, k, h, -1)
    _gather_references(lines, _array(render), *(part.numpy() for part in made))
    return made


@kernel
def _gather_references(references, render, mean4, mean2, each4, each2):
    batch = references.shape[0]
    count = references.shape[1]
    height = render.shape[1]
    width = render.shape[2]
    share = np.float32(1.0) / np.float32(count)
    level = np.float32(1.0 / HALF)
    size = CHANNELS * width
    row = np.empty(size, dtype=np.float32)
    mean = np.empty(size, dtype=np.float32)
    for b in range(batch):
        for y in range(height):
            i4 = y // CELL
            i2 = y // DETAIL
            at4 = (y % CELL) * CELL * CHANNELS
            at2 = (y % DETAIL) * DETAIL * CHANNELS
            render_row = render[b, y]
            mean[:] = np.float32(0.0)
            for k in range(count):
                line = references[b, k, y]
                for i in range(len(row)):
                    row[i] = np.float32(line[i])
                for x in range(width):
                    holds = row[CHANNELS * x + 3] * level * np.float32(0.5)
                    for c in range(3):
                        row[CHANNELS * x + c] = (
                            row[CHANNELS * x + c] * level - np.float32(1.0) - render_row[x, c]
                        ) * holds
                    row[CHANNELS * x + 3] = holds
                for i in range(len(row)):
                    mean[i] += row[i] * share
                _put_runs(row, each4[b * count + k, i4], at4, CELL * CHANNELS)
                _put_runs(row, each2[b * count + k, i2], at2, DETAIL * CHANNELS)
            _put_runs(mean, mean4[b, i4], at4, CELL * CHANNELS)
            _put_runs(mean, mean2[b, i2], at2, DETAIL * CHANNELS)


@inlined_kernel
def _put_runs(row, cells, offset, run):
    """Write a row of pixels into the row of cells that it crosses, ``run`` values into each, from
    ``offset`` on.

    It is inlined, so that ``run`` is a constant where it is called, and a run is a vector.
    """
    for j in range(cells.shape[0]):
        cell = cells[j]
        for i in range(run):
            cell[offset + i] = row[run * j + i]


def blend(repaired: Tensor, references: Tensor, heads: BlendHeads) -> tuple[Tensor, Tensor]:
    """Return the same as `network.reference_blend.blend`, of references as bytes."""
    out = torch.empty_like(repaired)
    recorded = torch.empty_like(repaired[..., :1])
    whole = _array(repaired), *_sources(references, heads), out.numpy(), recorded.numpy()
    none = np.empty((0, 0, 0), dtype=np.float32)
    for image, pixels, weight, offset_px, correction, *made in zip(*whole, strict=True):
        _blend(image, pixels, weight, offset_px, correction, none, 1, 0, *made)
    return out, recorded


def _sources(references: Tensor, heads: BlendHeads) -> tuple[np.ndarray, ...]:
    """Return references as one number a pixel, its first channel the lowest byte, and the heads."""
    return _array(references).view(np.uint32)[..., 0], *(_array(part) for part in heads[:3])


def enlarge(
    rgb: Tensor,
    change: Tensor,
    references: Tensor | None,
    heads: BlendHeads | None,
    scale: int,
) -> Tensor:
    """Return the same as `network.reference_blend.enlarge`, a band of rows at a time, which stays in
    the processor's cache; the bands are shared by torch's number of threads.
    """
    height, width = rgb.shape[1:3]
    out = torch.empty_like(rgb)
    renders, changes, levels = _array(rgb), _array(change), out.numpy()
    sources = finer = None
    if references is not None and heads is not None:
        sources = _sources(references, heads)
        if heads.finer is not None:
            finer = _array(heads.finer.permute(0, 2, 3, 1))

    def enlarge_band(image_and_row: tuple[int, int]) -> None:
        b, first = image_and_row
        band = slice(first, min(first + BAND * scale, height))
        added = _enlarged_rows(changes[b], scale, band)[:, :width]
        image = cv2.addWeighted(renders[b, band], 1 / HALF, added, 1, -1, dtype=cv2.CV_32F)
        if sources is not None:
            mixed = np.empty_like(image)
            recorded = np.empty_like(image[..., :1])
            of_image = (part[b] for part in sources)
            more = np.empty((0, 0, 0), dtype=np.float32)
            if finer is not None:
                more = _enlarged_rows(finer[b], FINER_PX, band)
            _blend(image, *of_image, more, scale, first, mixed, recorded)
            image = mixed
        levels[b, band] = cv2.addWeighted(image, HALF, image, 0, HALF, dtype=cv2.CV_8U)

    bands = list(product(range(len(rgb)), range(0, height, BAND * scale)))
    map_on_threads(torch.get_num_threads(), enlarge_band, bands)
    return out


def _enlarged_rows(coarse: np.ndarray, side: int, rows: slice) -> np.ndarray:
    """Return some rows ``(n, W, C)`` of an image whose cells of ``side`` pixels have the values
    ``(h, w, C)``, interpolated bilinearly.
    """
    above = max(rows.start // side - 1, 0)
    around = coarse[above : -(-rows.stop // side) + 1]
    out = cv2.resize(around, None, fx=side, fy=side, interpolation=cv2.INTER_LINEAR)
    inner = out[rows.start - above * side :][: rows.stop - rows.start]
    return inner.reshape(*inner.shape[:2], -1)


@vector_kernel
def _blend(
    repaired, references, weight, offset_px, correction, finer, scale, first_row, out, recorded
):
    """Blend a row at a time: where each pixel is looked up, what is found there, its share; channel
    by channel, so that rows are vectors.

    What the heads say is ``scale`` times coarser than the image, offsets twice that, and is
    interpolated between the middles. ``repaired`` holds the rows from ``first_row`` on, and
    ``finer``, of shape ``(n, W, K)``, what is added to the logarithms there; it may be empty.
    """
    count, height, width = references.shape
    cells_down, cells_across = weight.shape[1:3]
    y0, y1, fy = _between(height, scale, DETAIL * cells_down)
    x0, x1, fx = _between(width, scale, DETAIL * cells_across)
    v0, v1, fv = _between(height, scale * DETAIL, cells_down)
    u0, u1, fu = _between(width, scale * DETAIL, cells_across)
    coarse_offset = np.empty((2, cells_across), dtype=np.float32)
    coarse_correction = np.empty((CHANNELS, DETAIL * cells_across), dtype=np.float32)
    # The two coarser rows around a row of pixels, by whether their number is odd; the next row of
    # pixels most often lies between the same two.
    offset_rows = np.empty((count, 2, 2, width), dtype=np.float32)
    correction_rows = np.empty((count, 2, CHANNELS, width), dtype=np.float32)
    row_of = np.empty((count, 4), dtype=np.int64)
    place = np.empty((4, width), dtype=np.uint32)
    corners = np.empty((4, width), dtype=np.uint32)
    shares = np.empty((4, width), dtype=np.float32)
    looked_up = np.empty((CHANNELS, width), dtype=np.float32)
    blended = np.empty((3, width), dtype=np.float32)
    total = np.empty(width, dtype=np.float32)
    share = np.empty(width, dtype=np.float32)
    row_of[:] = -1
    for i in range(len(repaired)):
        y = first_row + i
        _begin_row(repaired[i], blended, total)
        for k in range(count):
            for row in (v0[y], v1[y]):
                if row_of[k, row % 2] != row:
                    row_of[k, row % 2] = row
                    _offset_row(offset_px[k], row, scale, coarse_offset)
                    _stretched(coarse_offset, u0, u1, fu, offset_rows[k, row % 2])
            upper = offset_rows[k, v0[y] % 2]
            lower = offset_rows[k, v1[y] % 2]
            _place_row(upper, lower, fv[y], y, height, place, shares)
            _sample_row(references[k].reshape(-1), place, shares, corners, looked_up)
            for row in (y0[y], y1[y]):
                if row_of[k, 2 + row % 2] != row:
                    row_of[k, 2 + row % 2] = row
                    _correction_row(weight[k], correction[k], row, coarse_correction)
                    _stretched(coarse_correction, x0, x1, fx, correction_rows[k, row % 2])
            upper = correction_rows[k, y0[y] % 2]
            lower = correction_rows[k, y1[y] % 2]
            _weigh_row(upper, lower, fy[y], finer, i, k, looked_up, share, total)
            _add_row(upper, lower, fy[y], looked_up, share, blended)
        _end_row(blended, total, out[i], recorded[i])


@vector_kernel
def _begin_row(repaired, blended, total):
    """Begin a row of pixels with the repaired frame ``(W, 3)``, whose weight is 1.

    Args:
        repaired: ``(W, 3)``.
        blended: ``(3, W)``, written.
        total: ``(W,)`` sum of weights, written.
    """
    total[:] = np.float32(1.0)
    for x in range(len(repaired)):
        for c in range(3):
            blended[c, x] = repaired[x, c]


@vector_kernel
def _end_row(blended, total, out, recorded):
    """Divide a row of pixels by the sum of weights.

    Args:
        blended: ``(3, W)`` weighted sum.
        total: ``(W,)`` sum of weights.
        out: ``(W, 3)``, written.
        recorded: ``(W, 1)``, written: the references' share of the weights.
    """
    unit = np.float32(1.0)
    zero = np.float32(0.0)
    for x in range(len(out)):
        over = unit / total[x]
        for c in range(3):
            out[x, c] = blended[c, x] * over
        recorded[x, 0] = max(unit - over, zero)


@vector_kernel
def _weigh_row(upper, lower, share_down, finer, i, k, looked_up, share, total):
    """Weigh a row of pixels of a reference.

    Args:
        upper, lower: ``(CHANNELS, W)`` corrections of the coarser rows around; the last channel is
            the logarithm of the weight.
        share_down: The share of the lower one.
        finer: ``(n, W, K)`` what is added to the logarithm in row ``i`` for reference ``k``; it may
            be empty.
        looked_up: ``(CHANNELS, W)``, see `_sample_row`; the last channel tells where it holds.
        share: ``(W,)`` weight of the reference, written.
        total: ``(W,)`` sum of weights, added to.
    """
    unit = np.float32(1.0)
    largest = np.float32(LARGEST)
    nowhere = np.float32(NOWHERE)
    half = np.float32(0.5 / HALF)
    for x in range(len(share)):
        share[x] = upper[3, x] + share_down * (lower[3, x] - upper[3, x])
    if finer.size:
        for x in range(len(share)):
            share[x] += finer[i, x, k]
    for x in range(len(share)):
        weight = _exponential(min(share[x], largest))
        share[x] = weight * min(max(looked_up[3, x] * half, nowhere), unit)
        total[x] += share[x]


@inlined_kernel
def _exponential(x):
    """Return the exponential of a float32 to within a share of ``3e-7 + 1e-7 abs(x)``; below `LEAST`
    that of `LEAST`.

    A whole power of two, written as the exponent of a float, times a polynomial on [-1/2, 1/2]
    (Taylor, degree 6, in the natural logarithm of two). Loops over it become vectors, over
    ``np.exp`` they do not.
    """
    power = max(x, np.float32(LEAST)) * np.float32(1 / math.log(2))
    whole = np.floor(power + np.float32(0.5))
    fraction = (power - whole) * np.float32(math.log(2))
    value = np.float32(1 / 720)
    value = value * fraction + np.float32(1 / 120)
    value = value * fraction + np.float32(1 / 24)
    value = value * fraction + np.float32(1 / 6)
    value = value * fraction + np.float32(1 / 2)
    value = value * fraction + np.float32(1.0)
    value = value * fraction + np.float32(1.0)
    exponent = (np.int32(whole) + np.int32(127)) << np.int32(23)
    return value * np.int32(exponent).view(np.float32)


@vector_kernel
def _place_row(upper, lower, share_down, y, height, place, shares):
    """Find where a row of pixels looks a reference up: the four pixels around each place, and their
    bilinear shares.

    Args:
        upper, lower: ``(2, W)`` offsets in pixels, across and down, of the coarser rows around.
        share_down: The share of the lower one.
        y, height: The row and the number of rows of the image.
        place: ``(4, W)`` uint32, written: indices into the flat reference.
        shares: ``(4, W)`` float32, written.
    """
    unit = np.float32(1.0)
    zero = np.float32(0.0)
    width = place.shape[1]
    for x in range(width):
        px = np.float32(x) + upper[0, x] + share_down * (lower[0, x] - upper[0, x])
        py = np.float32(y) + upper[1, x] + share_down * (lower[1, x] - upper[1, x])
        px = min(max(px, zero), np.float32(width - 1))
        py = min(max(py, zero), np.float32(height - 1))
        left = np.int32(px)
        top = np.int32(py)
        to_right = px - np.float32(left)
        to_below = py - np.float32(top)
        shares[3, x] = to_below * to_right
        shares[1, x] = to_right - shares[3, x]
        shares[2, x] = to_below - shares[3, x]
        shares[0, x] = unit - to_right - shares[2, x]
        next_column = min(left + 1, width - 1) - left
        next_row = (min(top + 1, height - 1) - top) * width
        first = top * width + left
        place[0, x] = first
        place[1, x] = first + next_column
        place[2, x] = first + next_row
        place[3, x] = first + next_column + next_row


@vector_kernel
def _sample_row(image, place, shares, corners, looked_up):
    """Look a reference up at places found by `_place_row`, channel by channel.

    Args:
        image: ``(H W,)`` uint32, a pixel's four bytes in one number.
        place, shares: ``(4, W)``.
        corners: ``(4, W)`` uint32, scratch.
        looked_up: ``(CHANNELS, W)`` float32, written: 0 to 255.
    """
    width = place.shape[1]
    for corner in range(4):
        for x in range(width):
            corners[corner, x] = image[place[corner, x]]
    for c in range(CHANNELS):
        shift = np.uint32(8 * c)
        for x in range(width):
            value = np.float32(0.0)
            for corner in range(4):
                byte = np.int32((corners[corner, x] >> shift) & np.uint32(255))
                value += shares[corner, x] * np.float32(byte)
            looked_up[c, x] = value


@vector_kernel
def _add_row(upper, lower, share_down, looked_up, share, blended):
    """Add a row of a reference, corrected and weighed, to what is blended.

    Args:
        upper, lower: ``(CHANNELS, W)`` corrections of the coarser rows around.
        share_down: The share of the lower one.
        looked_up: ``(CHANNELS, W)``, see `_sample_row`.
        share: ``(W,)`` weight of the reference.
        blended: ``(3, W)``, added to.
    """
    level = np.float32(1.0 / HALF)
    for c in range(3):
        for x in range(looked_up.shape[1]):
            correction = upper[c, x] + share_down * (lower[c, x] - upper[c, x])
            blended[c, x] += share[x] * (looked_up[c, x] * level - np.float32(1.0) + correction)


@vector_kernel
def _stretched(coarse, before, after, share, out):
    """Write rows of pixels between coarser ones; see `_between`."""
    for c in range(len(out)):
        line = coarse[c]
        for x in range(out.shape[1]):
            first = line[before[x]]
            out[c, x] = first + share[x] * (line[after[x]] - first)


@kernel
def _between(length, scale, count):
    """Return for each pixel of a row or column the values before and after it, ``scale`` pixels
    wide and ``count`` in number, and the share of the second.
    """
    before = np.empty(length, dtype=np.uint32)
    after = np.empty(length, dtype=np.uint32)
    share = np.empty(length, dtype=np.float32)
    last = count - 1
    for x in range(length):
        place = max((x + 0.5) / scale - 0.5, 0.0)
        before[x] = min(int(place), last)
        after[x] = min(before[x] + 1, last)
        share[x] = place - before[x]
    return before, after, share


@vector_kernel
def _offset_row(offset_px, row, scale, out):
    """Write the offsets ``(2, w)`` that a head gives for a row of cells, in pixels of an image that
    is ``scale`` times finer.
    """
    for j in range(out.shape[1]):
        for c in range(2):
            out[c, j] = np.float32(scale) * offset_px[row, j, c]


@kernel
def _correction_row(weight, correction, row, out):
    """Write a row of pixels of what a head says of cells: three corrections, then the logarithm of
    the weight.
    """
    i = row // DETAIL
    into = row % DETAIL * DETAIL
    for j in range(weight.shape[1]):
        for half in range(DETAIL):
            for c in range(3):
                out[c, DETAIL * j + half] = correction[i, j, 3 * (into + half) + c]
            out[3, DETAIL * j + half] = weight[i, j, into + half]


def smaller(x: Tensor, scale: int) -> Tensor:
    """Return the same as `network.reference_blend.smaller`, of at most four channels."""
    if scale == 1:
        return x
    height, width, channels = x.shape[-3:]
    below = -height % scale
    right = -width % scale
    size = (height + below) // scale, (width + right) // scale
    out = torch.empty(*x.shape[:-3], *size, channels, dtype=x.dtype)
    images, resized = (a.reshape(-1, *a.shape[-3:]) for a in (_array(x), out.numpy()))

    def average(i: int) -> None:
        whole = cv2.copyMakeBorder(images[i], 0, below, 0, right, cv2.BORDER_REPLICATE)
        cv2.resize(whole, size[::-1], dst=resized[i], interpolation=cv2.INTER_AREA)

    map_on_threads(torch.get_num_threads(), average, range(len(images)))
    return out


def likeness(sought: Tensor, candidates: Tensor) -> Tensor:
    """Return the same as `network.reference_blend.likeness`."""
    n, h, w, channels = candidates.shape
    reach = 2 * MATCH_CELLS + 1
    out = torch.empty(n, h, w, reach**2)
    # Channels before columns, so that a row of cells is a vector.
    around = F.pad(candidates, (0, 0, MATCH_CELLS, MATCH_CELLS, MATCH_CELLS, MATCH_CELLS))
    rows_sought, rows_around = (_array(x.transpose(2, 3)) for x in (sought, around))
    _likeness(rows_sought, rows_around, np.float32(1 / channels), out.numpy())
    return out.to(sought.dtype)


@vector_kernel
def _likeness(sought, around, share, out):
    """Fill ``out`` ``(N, h, w, side * side)`` with the mean of products of ``sought``
    ``(B, h, C, w)`` and what stands ``side * side`` cells around in ``around``
    ``(N, h + side - 1, C, w + side - 1)``.
    """
    channels, width = sought.shape[2:]
    count = len(around) // len(sought)
    side = around.shape[3] - width + 1
    sums = np.empty(width, dtype=np.float32)
    for n in range(len(around)):
        for y in range(sought.shape[1]):
            cells = sought[n // count, y]
            for i in range(side):
                around_cells = around[n, y + i]
                for j in range(side):
                    sums[:] = np.float32(0.0)
                    for c in range(channels):
                        for x in range(width):
                            sums[x] += cells[c, x] * around_cells[c, x + j]
                    for x in range(width):
                        out[n, y, x, i * side + j] = sums[x] * share


def offsets(at2: Tensor, at4: Tensor) -> Tensor:
    """Return the same as `network.reference_blend.offsets`."""
    coarse = _array(at4)
    out = np.empty(at2.shape, dtype=np.float32)
    for i, plane in enumerate(coarse):
        cv2.resize(plane, at2.shape[2:0:-1], dst=out[i], interpolation=cv2.INTER_LINEAR)
    return torch.from_numpy(out).add_(at2).tanh_().mul_(OFFSET_PX)


CPU = Operations(gather_references, blend, smaller, enlarge, likeness, offsets, sparse_source)
