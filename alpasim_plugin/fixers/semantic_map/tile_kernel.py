"""The Triton kernel that draws the semantic map on a GPU: what `raster` does, in float64.

Importing this module needs Triton. With ``TRITON_INTERPRET=1`` in the environment before the first
import, the kernel runs interpreted on the CPU.
"""

# Triton's decorators and tensor types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator,misc"

from __future__ import annotations

import triton
import triton.language as tl

from alpasim_plugin.fixers.semantic_map import style

_NEAR_M = tl.constexpr(style.NEAR_M)
_DEPTH_MAX_M = tl.constexpr(style.DEPTH_MAX_M)


@triton.jit
def draw_tiles(
    primitives,
    samples,
    levels,
    counts,
    cameras,
    most,
    rows,
    width,
    height,
    tiles_x,
    tiles_y,
    COLUMNS: tl.constexpr,
    TILE: tl.constexpr,
):
    """Draw a tile of ``rows`` rows of a view, from the last number of its camera on: each sample
    shows the nearest primitive, of equally near ones the first. A view has ``counts`` of ``most``
    primitives; for the columns of one see `on_device`.
    """
    view = tl.program_id(0) // (tiles_x * tiles_y)
    tile = tl.program_id(0) % (tiles_x * tiles_y)
    primitives += view * most * COLUMNS
    levels += view.to(tl.int64) * (rows * width * 3)
    top = tl.load(cameras + view * 23 + 22).to(tl.int32)
    left = (tile % tiles_x) * TILE
    above = (tile // tiles_x) * TILE
    tile_top = top + above
    lane = tl.arange(0, TILE * TILE)[:, None]
    column = left + lane % TILE
    row = above + lane // TILE
    x = column.to(tl.float64) + 0.5
    y = (top + row).to(tl.float64) + 0.5
    sample = samples + 2 * tl.arange(0, 4)[None, :]
    sample_x = x + tl.load(sample)
    sample_y = y + tl.load(sample + 1)
    stretch = tl.cast(width, tl.float64) / height
    depth = tl.full((TILE * TILE, 4), 0.0, tl.float32)
    colour = tl.full((TILE * TILE, 4), 0, tl.int32)
    for k in range(tl.load(counts + view)):
        p = primitives + k * COLUMNS
        in_columns = (tl.load(p) < left + TILE) & (tl.load(p + 2) > left)
        in_rows = (tl.load(p + 1) < tile_top + TILE) & (tl.load(p + 3) > tile_top)
        if in_columns & in_rows:
            nearest = tl.load(p + 4)
            farthest = tl.load(p + 5)
            ix = tl.load(p + 6)
            iy = tl.load(p + 7)
            i0 = tl.load(p + 8)
            middle = tl.minimum(tl.maximum(ix * x + iy * y + i0, farthest), nearest)
            fade = tl.maximum(1.0 - 1.0 / (middle * _DEPTH_MAX_M), 0.0)
            share = tl.load(p + 26) * x + tl.load(p + 27) * y + tl.load(p + 28)
            share = tl.minimum(tl.maximum(share / middle, 0.0), 1.0)
            a = tl.load(p + 17) * sample_x + tl.load(p + 18) * sample_y + tl.load(p + 19)
            half = tl.load(p + 16)
            if half > 0.0:
                t = tl.minimum(tl.maximum(a, 0.0), 1.0)
                across = sample_x - tl.load(p + 20) - t * tl.load(p + 22)
                down = sample_y * stretch - tl.load(p + 21) - t * tl.load(p + 23)
                covered = across * across + down * down <= half * fade * (half * fade)
                inverse = tl.broadcast_to(middle, (TILE * TILE, 4))
            else:
                b = tl.load(p + 20) * sample_x + tl.load(p + 21) * sample_y + tl.load(p + 22)
                c = tl.load(p + 23) * sample_x + tl.load(p + 24) * sample_y + tl.load(p + 25)
                inverse = ix * sample_x + iy * sample_y + i0
                covered = (a >= 0.0) & (b >= 0.0) & (c >= 0.0) & (inverse * _NEAR_M <= 1.0)
                inverse = tl.minimum(tl.maximum(inverse, farthest), nearest)
            inverse = inverse / tl.maximum(1.0 - tl.load(p + 9) * inverse, 1e-3)
            packed = tl.full((TILE * TILE, 1), 0, tl.int32)
            for channel in tl.static_range(3):
                front = tl.load(p + 10 + channel)
                level = (front + share * (tl.load(p + 13 + channel) - front)) * fade
                packed |= (level + 0.5).to(tl.int32) << (8 * channel)
            nearer = covered & (inverse.to(tl.float32) > depth)
            depth = tl.where(nearer, inverse.to(tl.float32), depth)
            colour = tl.where(nearer, packed, colour)
    inside = (row < rows) & (column < width)
    for channel in tl.static_range(3):
        level_sum = tl.sum((colour >> (8 * channel)) & 255, axis=1, keep_dims=True)
        place = (row * width + column) * 3 + channel
        tl.store(levels + place, ((level_sum + 2) // 4).to(tl.uint8), inside)
