"""List splats per tile, nearest first.

One sort of all visible splats by depth, then a counting sort into tiles that keeps its order: on a
CPU this beats the sort of all (tile, depth) pairs that GPU rasterisers use.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.kernels import inlined_kernel, kernel
from alpasim_plugin.gaussians.constants import RADIUS_X, RADIUS_Y, RECORD, TILE, U, V
from alpasim_plugin.gaussians.raster import simd as v

RADIX_BITS = 11  # most of a key that a pass of the sort looks at: its counts stay in the cache
LOW_HALF = np.int64(0xFFFFFFFF)


@kernel
def sorted_numbers(keys, width):
    """Return the numbers of keys, by key, equal ones by number; and the places of those in that
    order whose key is that of a neighbour.

    A radix sort, which takes a third of the time of a sort by comparisons.

    Args:
        keys: int32 ``(N,)``, not negative.
        width: Bits of the largest.
    """
    passes = max(1, (width + RADIX_BITS - 1) // RADIX_BITS)
    bits = max(1, (width + passes - 1) // passes)
    size = 1 << bits
    # Pairs ``key << 32 | number``
    source = np.empty(keys.shape[0], dtype=np.int64)
    target = np.empty(keys.shape[0], dtype=np.int64)
    places = np.zeros((passes, size), dtype=np.int64)
    for i in range(keys.shape[0]):
        key = np.int64(keys[i])
        source[i] = (key << 32) | i
        for step in range(passes):
            places[step, (key >> (step * bits)) & (size - 1)] += 1
    for step in range(passes):
        total = 0
        for digit in range(size):
            count = places[step, digit]
            places[step, digit] = total
            total += count
        shift = 32 + step * bits
        for i in range(keys.shape[0]):
            digit = (source[i] >> shift) & (size - 1)
            target[places[step, digit]] = source[i]
            places[step, digit] += 1
        source, target = target, source
    tied = np.empty(keys.shape[0], dtype=np.int64)
    n_tied = 0
    is_like_last = False
    for i in range(keys.shape[0]):
        key = source[i] >> 32
        is_like_next = i + 1 < keys.shape[0] and key == source[i + 1] >> 32
        if is_like_last or is_like_next:
            tied[n_tied] = i
            n_tied += 1
        is_like_last = is_like_next
        target[i] = source[i] & LOW_HALF
    return target, tied[:n_tied]


@inlined_kernel
def _tile_span(centre, radius, n_tiles):
    """Return the first and one past the last tile whose pixel centres can lie within a radius."""
    # Clamped as floats, since far off-screen bounds do not fit an integer; truncation is rounding
    # down, as nothing is negative.
    half = np.float32(0.5)
    per_tile = np.float32(1.0 / TILE)
    zero = np.float32(0.0)
    limit = np.float32(n_tiles)
    first = min(max((centre - radius - half) * per_tile, zero), limit)
    last = min(max((centre + radius - half) * per_tile + np.float32(1.0), zero), limit)
    return np.int32(first), np.int32(last)


@kernel
def tile_boxes(records, tiles_x, tiles_y, boxes):
    """Write the tiles of each splat's box, four int16: first and one past the last column, the same
    for rows.

    In the order of the records: that of depth would wait for memory at each of them.
    """
    for splat in range(boxes.shape[0]):
        offset = splat * RECORD
        left, right = _tile_span(records[offset + U], records[offset + RADIUS_X], tiles_x)
        top, bottom = _tile_span(records[offset + V], records[offset + RADIUS_Y], tiles_y)
        boxes[splat, 0] = left
        boxes[splat, 1] = right
        boxes[splat, 2] = top
        boxes[splat, 3] = bottom


@kernel
def count_tiles(cursor, chunk_size, order, by_record, boxes, changes):
    """Put boxes in the order of depth and count, per chunk of ``chunk_size`` of them, how many meet
    each tile.

    ``changes`` has a row and a column more than the tiles. Its sums along both are the counts,
    since a box adds one at its first corner and takes it off past its ends.
    """
    while True:
        chunk = v.fetch_add(cursor, 0, 1)
        if chunk >= changes.shape[0]:
            return
        for row in range(changes.shape[1]):
            for column in range(changes.shape[2]):
                changes[chunk, row, column] = 0
        for rank in range(chunk * chunk_size, min((chunk + 1) * chunk_size, order.shape[0])):
            splat = order[rank]
            left = by_record[splat, 0]
            right = by_record[splat, 1]
            top = by_record[splat, 2]
            bottom = by_record[splat, 3]
            boxes[rank, 0] = left
            boxes[rank, 1] = right
            boxes[rank, 2] = top
            boxes[rank, 3] = bottom
            changes[chunk, top, left] += 1
            changes[chunk, top, right] -= 1
            changes[chunk, bottom, left] -= 1
            changes[chunk, bottom, right] += 1


@kernel
def fill_tiles(cursor, chunk_size, order, boxes, tiles_x, position, lists):
    """Write each tile's list of records; ``position`` says where each chunk's part of it begins.

    Chunks ascend and so does the depth in a chunk, hence every list is in depth order.
    """
    while True:
        chunk = v.fetch_add(cursor, 0, 1)
        if chunk >= position.shape[0]:
            return
        next_place = position[chunk]
        for rank in range(chunk * chunk_size, min((chunk + 1) * chunk_size, order.shape[0])):
            splat = order[rank]
            left, right, top, bottom = boxes[rank]
            for row in range(top, bottom):
                for tile in range(row * tiles_x + left, row * tiles_x + right):
                    lists[next_place[tile]] = splat
                    next_place[tile] += 1
