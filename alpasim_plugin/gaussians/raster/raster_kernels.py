"""Composite the splats of each tile, sixteen pixels at a time.

A tile of 16 x 16 pixels is sixteen blocks of 4 x 4. A tile's list is taken in chunks: for each
splat of a chunk one vector operation over the block centres tells which blocks it can touch; then
each block blends the splats that touch it, one after the other, with its pixels in registers. So
the innermost loop has no branch that depends on the image, and its end is hard to foresee once per
64 splats only. A block whose pixels are all finished is left out, and a tile ends when no block is
left.

The exponential is ``alpha = o exp(-q^2/2) = P(y)^8`` with ``y = peak - s^2 - t^2`` in [-0.5, 0.5]
wherever alpha reaches the cut, and P a polynomial of degree 5 for ``2^(y - 0.5)``: relative error
below 2e-6, without range reduction.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np
from numpy.polynomial import chebyshev

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLOCK_REACH,
    L11,
    L12,
    L22,
    PEAK,
    RADIUS_X,
    RADIUS_Y,
    RECORD,
    TILE,
    TRANSMITTANCE_STOP,
    B,
    G,
    R,
    U,
    V,
    Z,
)
from alpasim_plugin.gaussians.raster import simd as v

_f = np.float32
# Interpolation at Chebyshev nodes of [-0.5, 0.5].
_nodes = np.cos(np.pi * (np.arange(6) + 0.5) / 6) / 2
P0, P1, P2, P3, P4, P5 = (
    _f(c)
    for c in chebyshev.cheb2poly(chebyshev.chebfit(2 * _nodes, 2.0 ** (_nodes - 0.5), 5))
    * 2.0 ** np.arange(6)
)
CUT = _f((np.log2(ALPHA_MIN) + 4.0) / 8.0)
# Columns of a block's state, sixteen pixels each. A finished pixel keeps its transmittance with the
# sign turned.
STATE_T, STATE_R, STATE_G, STATE_B, STATE_D, STATE = range(0, 96, 16)
# What the forward pass keeps per block: transmittance and position of the last splat drawn, sixteen
# pixels each.
KEPT_T = 0
KEPT_LAST = 16
KEPT = 32
CHUNK = 256  # splats of a tile that are taken at once, a multiple of 64


@kernel
def pixel_of(tile_x, tile_y, block, pixel):
    """Return the image column and row of a pixel (0..15) of a tile's block (0..15)."""
    return tile_x * TILE + (block & 3) * 4 + (pixel & 3), tile_y * TILE + (block >> 2) * 4 + (
        pixel >> 2
    )


@kernel
def block_centres(x0, y0, block):
    """Return the pixel centres of a tile's block, ``x`` and ``y``; ``x0, y0`` is that of the tile's
    first pixel.
    """
    x = v.lane_pattern(_f(1.0), _f(0.0)) + (x0 + 4 * (block & 3))
    y = v.lane_pattern(_f(0.0), _f(1.0)) + (y0 + 4 * (block >> 2))
    return x, y


@kernel
def start_tile(state, x0, y0, width, height):
    """Reset the state of a tile and return the bit mask of blocks that hold a pixel of the
    image.
    """
    live = 0
    zero = v.splat(_f(0.0))
    for block in range(16):
        base = block * STATE
        x, y = block_centres(x0, y0, block)
        inside = (x < width) & (y < height)
        v.store(state, base + STATE_T, v.select(inside, 1.0, -1.0))
        v.store(state, base + STATE_R, zero)
        v.store(state, base + STATE_G, zero)
        v.store(state, base + STATE_B, zero)
        v.store(state, base + STATE_D, zero)
        if v.bits(inside) != 0:
            live |= 1 << block
    return live


@kernel
def whitened(records, offset, x, y):
    """Return ``s`` and ``t`` at sixteen pixel centres: the splat's exponent is ``peak - s^2 -
    t^2``.
    """
    dx = x - records[offset + U]
    dy = y - records[offset + V]
    s = v.fma(records[offset + L11], dx, records[offset + L12] * dy)
    return s, records[offset + L22] * dy


@kernel
def touched_blocks(records, offset, x0, y0):
    """Return the bit mask of the sixteen blocks that a splat can touch; ``x0, y0`` is the centre of
    the tile's first pixel.
    """
    x = v.lane_pattern(_f(4.0), _f(0.0)) + (x0 + _f(1.5))
    y = v.lane_pattern(_f(0.0), _f(4.0)) + (y0 + _f(1.5))
    s, t = whitened(records, offset, x, y)
    touched = v.fma(s, s, t * t) <= records[offset + BLOCK_REACH]
    in_columns = v.absolute(x - records[offset + U]) <= records[offset + RADIUS_X] + _f(1.5)
    in_rows = v.absolute(y - records[offset + V]) <= records[offset + RADIUS_Y] + _f(1.5)
    return v.bits(touched & in_columns & in_rows)


@kernel
def falloff(y):
    """Return ``2^(8 y - 4)``, the opacity at an exponent between the cut and 0.5, not yet held to
    the largest alpha.
    """
    p = v.fma(P5, y, P4)
    p = v.fma(p, y, P3)
    p = v.fma(p, y, P2)
    p = v.fma(p, y, P1)
    p = v.fma(p, y, P0)
    p = p * p
    p = p * p
    return p * p


@kernel
def _blend_block(block, x, y, first, masks, near, state, kept, kept_at):
    """Blend the splats of a chunk that touch a block; returns whether its pixels are finished."""
    base = block * STATE
    through = v.load(state, base + STATE_T)
    red = v.load(state, base + STATE_R)
    green = v.load(state, base + STATE_G)
    blue = v.load(state, base + STATE_B)
    depth = v.load(state, base + STATE_D)
    finished = False
    for word in range(CHUNK // 64):
        touching = 0
        for part in range(4):
            touching |= v.bits(v.has_bit(v.load(masks, word * 64 + part * 16), block)) << (
                part * 16
            )
        while touching != 0:
            place = word * 64 + v.lowest_bit(touching)
            touching &= touching - 1
            offset = place * RECORD
            s, t = whitened(near, offset, x, y)
            exponent = v.fnma(s, s, v.fnma(t, t, near[offset + PEAK]))
            visible = exponent >= CUT
            alpha = v.select(visible, v.minimum(falloff(exponent), ALPHA_MAX), 0.0)
            after = v.fnma(through, alpha, through)
            goes_on = after > TRANSMITTANCE_STOP
            weight = v.select(goes_on, through * alpha, 0.0)
            through = v.select(goes_on, after, v.negative(v.absolute(through)))
            red = v.fma(weight, near[offset + R], red)
            green = v.fma(weight, near[offset + G], green)
            blue = v.fma(weight, near[offset + B], blue)
            depth = v.fma(weight, near[offset + Z], depth)
            if kept is not None:
                last = v.select(goes_on & visible, first + place, v.load(kept, kept_at + KEPT_LAST))
                v.store(kept, kept_at + KEPT_LAST, last)
            if v.bits(through > 0.0) == 0:
                finished = True
                touching = 0
        if finished:
            break
    v.store(state, base + STATE_T, through)
    v.store(state, base + STATE_R, red)
    v.store(state, base + STATE_G, green)
    v.store(state, base + STATE_B, blue)
    v.store(state, base + STATE_D, depth)
    if kept is not None:
        v.store(kept, kept_at + KEPT_T, v.absolute(through))
    return finished


@kernel
def composite_tile(lists, start, end, records, x0, y0, state, live, kept, kept_at, near, masks):
    """Blend a tile's splats in order; ``x0, y0`` is the centre of its first pixel.

    ``near`` and ``masks`` are room for a chunk of splats: their records, and which blocks they
    touch.
    """
    for first in range(start, end, CHUNK):
        size = min(CHUNK, end - first)
        for i in range(size):
            v.prefetch(records, np.int64(lists[min(first + i + 16, end - 1)]) * RECORD)
            offset = np.int64(lists[first + i]) * RECORD
            v.store(near, i * RECORD, v.load(records, offset))
            masks[i] = touched_blocks(records, offset, x0, y0)
        for i in range(size, CHUNK):
            masks[i] = 0
        todo = live
        while todo != 0:
            block = v.lowest_bit(todo)
            todo &= todo - 1
            x, y = block_centres(x0, y0, block)
            offset = kept_at + block * KEPT
            if _blend_block(block, x, y, first - start, masks, near, state, kept, offset):
                live &= ~(1 << block)
        if live == 0:
            return


@kernel
def composite_tiles(
    cursor, tiles_x, starts, lists, records, kept, behind, colour, alpha, depth_sum
):
    """Render tiles until none is left; called by each thread.

    Args:
        cursor: int64 ``(1,)``, the next tile; shared by all threads.
        tiles_x: Tiles in a row of tiles.
        starts: See `binning.tile_offsets`.
        lists: Records per tile, nearest first.
        records: Projected splats.
        kept: float32 output, 16 x KEPT per tile, for `gradient_kernels.tile_gradients`, or None.
        behind: float32 ``(H, W, 3)`` or ``(1, 1, 3)``, the background; or None.
        colour: float32 output ``(H, W, 3)``, sum of weighted colours; with a background what is
            seen, clamped to 0..1.
        alpha: float32 output ``(H, W)``.
        depth_sum: float32 output ``(H, W)``, sum of weighted depths, metres; with a background
            their mean, 0 where alpha is 0.
    """
    state = np.empty(16 * STATE, dtype=np.float32)
    near = np.empty(CHUNK * RECORD, dtype=np.float32)
    masks = np.empty(CHUNK, dtype=np.int32)
    height, width = alpha.shape
    while True:
        tile = v.fetch_add(cursor, 0, 1)
        if tile >= starts.shape[0] - 1:
            return
        tile_x = tile % tiles_x
        tile_y = tile // tiles_x
        x0 = _f(tile_x * TILE) + _f(0.5)
        y0 = _f(tile_y * TILE) + _f(0.5)
        live = start_tile(state, x0, y0, width, height)
        kept_at = tile * 16 * KEPT
        if kept is not None:
            for offset in range(kept_at, kept_at + 16 * KEPT, KEPT):
                v.store(kept, offset + KEPT_T, v.splat(_f(1.0)))
                v.store(kept, offset + KEPT_LAST, v.splat(_f(-1.0)))
        first = starts[tile]
        end = starts[tile + 1]
        composite_tile(lists, first, end, records, x0, y0, state, live, kept, kept_at, near, masks)
        for row in range(min(TILE, height - tile_y * TILE)):
            y = tile_y * TILE + row
            for column in range(min(TILE, width - tile_x * TILE)):
                x = tile_x * TILE + column
                offset = ((row >> 2) * 4 + (column >> 2)) * STATE + (row & 3) * 4 + (column & 3)
                opacity = _f(1.0) - abs(state[offset + STATE_T])
                alpha[y, x] = opacity
                depth = state[offset + STATE_D]
                if behind is not None:
                    depth = depth / opacity if opacity > 0 else _f(0.0)
                depth_sum[y, x] = depth
                for channel in range(3):
                    light = state[offset + STATE_R + 16 * channel]
                    if behind is not None:
                        back = behind[min(y, behind.shape[0] - 1), min(x, behind.shape[1] - 1)]
                        light = light + (_f(1.0) - opacity) * back[channel]
                        light = min(max(light, _f(0.0)), _f(1.0))
                    colour[y, x, channel] = light
