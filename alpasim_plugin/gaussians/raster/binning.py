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
def count_tiles(cursor, count, chunk_size, order, records, tiles_x, tiles_y, boxes, histogram):
    """Count, per chunk of ``chunk_size`` splats in the order of depth, how many meet each tile.

    ``boxes`` takes four int32 per rank, the tiles of the splat's box: first and one past the last
    column, the same for rows.
    """
    while True:
        chunk = v.fetch_add(cursor, 0, 1)
        if chunk >= histogram.shape[0]:
            return
        counts = histogram[chunk]
        counts[:] = 0
        for rank in range(chunk * chunk_size, min((chunk + 1) * chunk_size, count)):
            v.prefetch(records, order[min(rank + 12, count - 1)] * RECORD)
            at = order[rank] * RECORD
            left, right = _tile_span(records[at + U], records[at + RADIUS_X], tiles_x)
            top, bottom = _tile_span(records[at + V], records[at + RADIUS_Y], tiles_y)
            boxes[rank, 0], boxes[rank, 1] = left, right
            boxes[rank, 2], boxes[rank, 3] = top, bottom
            for row in range(top, bottom):
                for tile in range(row * tiles_x + left, row * tiles_x + right):
                    counts[tile] += 1


@kernel
def fill_tiles(cursor, count, chunk_size, order, boxes, tiles_x, position, lists):
    """Write each tile's list of records; ``position`` says where each chunk's part of it begins.

    Chunks ascend and so do the ranks in a chunk, hence every list is in depth order.
    """
    while True:
        chunk = v.fetch_add(cursor, 0, 1)
        if chunk >= position.shape[0]:
            return
        at = position[chunk]
        for rank in range(chunk * chunk_size, min((chunk + 1) * chunk_size, count)):
            left, right, top, bottom = boxes[rank]
            for row in range(top, bottom):
                for tile in range(row * tiles_x + left, row * tiles_x + right):
                    lists[at[tile]] = order[rank]
                    at[tile] += 1
