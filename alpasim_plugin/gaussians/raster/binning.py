"""List splats per tile, nearest first.

One sort of all visible splats by depth, then a counting sort into tiles that keeps its order: on a
CPU this beats the sort of all (tile, depth) pairs that GPU rasterisers use.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.kernels import inlined_kernel, kernel
from alpasim_plugin.gaussians.constants import (
    HALF_WIDTH,
    RADIUS_X,
    RADIUS_Y,
    RECORD,
    SLOPE,
    TILE,
    TOP_Y,
    U,
    V,
)
from alpasim_plugin.gaussians.raster import simd as v


@inlined_kernel
def _tile_span(low, high, n_tiles):
    """Return the first and one past the last tile whose pixel centres can lie between two
    coordinates.
    """
    # Clamped as floats, since far off-screen bounds do not fit an integer; truncation is rounding
    # down, as nothing is negative.
    half = np.float32(0.5)
    per_tile = np.float32(1.0 / TILE)
    zero = np.float32(0.0)
    limit = np.float32(n_tiles)
    first = min(max((low - half) * per_tile, zero), limit)
    last = min(max((high - half) * per_tile + np.float32(1.0), zero), limit)
    return np.int32(first), np.int32(last)


@inlined_kernel
def _ellipse_columns(records, at, row, tiles_x):
    """Return the first and one past the last tile of a tile row that a splat's ellipse can
    touch.
    """
    centre, radius_y = records[at + V], records[at + RADIUS_Y]
    low = max(np.float32(row * TILE + 0.5) - centre, -radius_y)
    high = min(np.float32(row * TILE + TILE - 0.5) - centre, radius_y)
    left = right = records[at + RADIUS_X]
    top_y = records[at + TOP_Y]
    slope = records[at + SLOPE]
    half_width = records[at + HALF_WIDTH]
    one = np.float32(1.0)
    zero = np.float32(0.0)
    slack = np.float32(0.02)
    # The rightmost point lies at dy = top_y and the leftmost at -top_y; outside of the band the
    # nearer end of the band counts.
    if top_y < low or top_y > high:
        end = low if top_y < low else high
        share = end / radius_y
        right = min(
            right, slope * end + half_width * np.sqrt(max(zero, one - share * share)) + slack
        )
    if -top_y < low or -top_y > high:
        end = low if -top_y < low else high
        share = end / radius_y
        left = min(left, half_width * np.sqrt(max(zero, one - share * share)) - slope * end + slack)
    return _tile_span(records[at + U] - left, records[at + U] + right, tiles_x)


@inlined_kernel
def _tile_box(records, at, tiles_x, tiles_y):
    """Return the tiles of a splat's box: first and one past the last column, the same for rows."""
    left, right = _tile_span(
        records[at + U] - records[at + RADIUS_X], records[at + U] + records[at + RADIUS_X], tiles_x
    )
    top, bottom = _tile_span(
        records[at + V] - records[at + RADIUS_Y], records[at + V] + records[at + RADIUS_Y], tiles_y
    )
    return left, right, top, bottom


@inlined_kernel
def _is_large(left, right, top, bottom):
    """Return whether a box has corners that its ellipse may leave empty: such splats are listed row
    by row, the others box by box.
    """
    return bottom - top > 2 and right - left > 2


@inlined_kernel
def _count_box(changes, stride, left, right, top, bottom):
    """Count a box of tiles at its four corners; `tile_offsets` adds up from there."""
    changes[top * stride + left] += 1
    changes[top * stride + right] -= 1
    changes[bottom * stride + left] -= 1
    changes[bottom * stride + right] += 1


@kernel
def count_tiles(cursor, count, chunk_size, order, records, tiles_x, tiles_y, boxes, histogram):
    """Count, per chunk of ``chunk_size`` splats in the order of depth, how many meet each tile.

    ``boxes`` takes four int32 per rank, the tiles of the splat's box. A row of ``histogram`` takes
    changes of the counts from tile to tile.
    """
    n_chunks, stride = histogram.shape[0], tiles_x + 1
    while True:
        chunk = v.fetch_add(cursor, 0, 1)
        if chunk >= n_chunks:
            return
        changes = histogram[chunk]
        changes[:] = 0
        for rank in range(chunk * chunk_size, min((chunk + 1) * chunk_size, count)):
            v.prefetch(records, order[min(rank + 12, count - 1)] * RECORD)
            at = order[rank] * RECORD
            left, right, top, bottom = _tile_box(records, at, tiles_x, tiles_y)
            boxes[4 * rank] = left
            boxes[4 * rank + 1] = right
            boxes[4 * rank + 2] = top
            boxes[4 * rank + 3] = bottom
            if _is_large(left, right, top, bottom):
                for row in range(top, bottom):
                    first, end = _ellipse_columns(records, at, row, tiles_x)
                    _count_box(changes, stride, first, end, row, row + 1)
            else:
                _count_box(changes, stride, left, right, top, bottom)


@kernel
def tile_offsets(histogram, tiles_x, starts):
    """Turn the changes into each chunk's write positions; fill ``starts`` (tiles + 1); return the
    number of (splat, tile) pairs.

    A row of ``histogram`` has a column and a row of tiles more than the image; positions lie at the
    tiles' own places in it.
    """
    n_chunks, stride = histogram.shape[0], tiles_x + 1
    n_rows = (starts.shape[0] - 1) // tiles_x
    for chunk in range(n_chunks):
        counts = histogram[chunk]
        for row in range(n_rows):
            along = np.int64(0)
            for at in range(row * stride, row * stride + tiles_x):
                along += counts[at]
                counts[at] = along + (counts[at - stride] if row > 0 else 0)
    total = np.int64(0)
    for row in range(n_rows):
        for column in range(tiles_x):
            starts[row * tiles_x + column] = total
            for chunk in range(n_chunks):
                here = histogram[chunk, row * stride + column]
                histogram[chunk, row * stride + column] = total
                total += here
    starts[starts.shape[0] - 1] = total
    return total


@kernel
def fill_tiles(cursor, count, chunk_size, order, records, boxes, tiles_x, histogram, lists):
    """Write each tile's list of records; chunks ascend and so do the ranks in a chunk, hence every
    list is in depth order.
    """
    n_chunks, stride = histogram.shape[0], tiles_x + 1
    while True:
        chunk = v.fetch_add(cursor, 0, 1)
        if chunk >= n_chunks:
            return
        position = histogram[chunk]
        for rank in range(chunk * chunk_size, min((chunk + 1) * chunk_size, count)):
            record = np.int32(order[rank])
            left = boxes[4 * rank]
            right = boxes[4 * rank + 1]
            top = boxes[4 * rank + 2]
            bottom = boxes[4 * rank + 3]
            large = _is_large(left, right, top, bottom)
            for row in range(top, bottom):
                if large:
                    left, right = _ellipse_columns(records, np.int64(record) * RECORD, row, tiles_x)
                for tile in range(row * stride + left, row * stride + right):
                    lists[position[tile]] = record
                    position[tile] += 1
