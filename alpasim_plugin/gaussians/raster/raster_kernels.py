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

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.polynomial import chebyshev

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
_nodes = (
    np.cos(np.pi * (np.arange(6) + 0.5) / 6) / 2
)  # interpolation at Chebyshev nodes of [-0.5, 0.5]
P0, P1, P2, P3, P4, P5 = (
    _f(c)
    for c in chebyshev.cheb2poly(chebyshev.chebfit(2 * _nodes, 2.0 ** (_nodes - 0.5), 5))
    * 2.0 ** np.arange(6)
)
CUT = _f((np.log2(ALPHA_MIN) + 4.0) / 8.0)
_ALPHA_MAX = _f(ALPHA_MAX)
_STOP = _f(TRANSMITTANCE_STOP)
# Columns of a block's state, sixteen pixels each. A finished pixel keeps its transmittance with the
# sign turned.
STATE_T = 0
STATE_R = 16
STATE_G = 32
STATE_B = 48
STATE_D = 64
STATE = 80
CHUNK = 256  # splats of a tile that are taken at once, a multiple of 64


@njit(cache=True, nogil=True)
def pixel_of(tile_x, tile_y, block, pixel):
    """Return the image column and row of a pixel (0..15) of a tile's block (0..15)."""
    return tile_x * TILE + (block & 3) * 4 + (pixel & 3), tile_y * TILE + (block >> 2) * 4 + (
        pixel >> 2
    )


@njit(cache=True, nogil=True)
def place_of(row, column):
    """Return where the state of a tile's pixel begins."""
    return ((row >> 2) * 4 + (column >> 2)) * STATE + (row & 3) * 4 + (column & 3)


@njit(cache=True, nogil=True)
def block_centres(x0, y0, block):
    """Return the pixel centres of a tile's block, ``x`` and ``y``; ``x0, y0`` is that of the tile's
    first pixel.
    """
    zero, one = _f(0.0), _f(1.0)
    x = v.splat(x0 + _f(4.0) * _f(block & 3)) + v.lane_pattern(one, zero)
    y = v.splat(y0 + _f(4.0) * _f(block >> 2)) + v.lane_pattern(zero, one)
    return x, y


@njit(cache=True, nogil=True)
def start_tile(state, x0, y0, width, height):
    """Reset the state of a tile and return the bit mask of blocks that hold a pixel of the
    image.
    """
    live = 0
    zero = v.splat(_f(0.0))
    for block in range(16):
        base = block * STATE
        x, y = block_centres(x0, y0, block)
        inside = (x < v.splat(_f(width))) & (y < v.splat(_f(height)))
        v.store(state, base + STATE_T, v.select(inside, v.splat(_f(1.0)), v.splat(_f(-1.0))))
        v.store(state, base + STATE_R, zero)
        v.store(state, base + STATE_G, zero)
        v.store(state, base + STATE_B, zero)
        v.store(state, base + STATE_D, zero)
        if v.bits(inside) != 0:
            live |= 1 << block
    return live


@njit(cache=True, nogil=True)
def touched_blocks(records, at, x0, y0):
    """Return the bit mask of the sixteen blocks that a splat can touch; ``x0, y0`` is the centre of
    the tile's first pixel.
    """
    zero = _f(0.0)
    four = _f(4.0)
    middle = _f(1.5)
    x = v.splat(x0 + middle - records[at + U]) + v.lane_pattern(four, zero)
    y = v.splat(y0 + middle - records[at + V]) + v.lane_pattern(zero, four)
    s = v.fma(v.splat(records[at + L11]), x, v.splat(records[at + L12]) * y)
    t = v.splat(records[at + L22]) * y
    touched = v.fma(s, s, t * t) <= v.splat(records[at + BLOCK_REACH])
    touched = touched & (v.absolute(x) <= v.splat(records[at + RADIUS_X] + middle))
    touched = touched & (v.absolute(y) <= v.splat(records[at + RADIUS_Y] + middle))
    return v.bits(touched)


@njit(cache=True, nogil=True)
def whitened(records, at, x, y):
    """Return ``s`` and ``t`` at sixteen pixel centres: the splat's exponent is ``peak - s^2 -
    t^2``.
    """
    dx, dy = x - v.splat(records[at + U]), y - v.splat(records[at + V])
    return v.fma(v.splat(records[at + L11]), dx, v.splat(records[at + L12]) * dy), v.splat(
        records[at + L22]
    ) * dy


@njit(cache=True, nogil=True)
def falloff(y):
    """Return ``2^(8 y - 4)``, the opacity at an exponent between the cut and 0.5, not yet held to
    the largest alpha.
    """
    p = v.fma(v.splat(P5), y, v.splat(P4))
    p = v.fma(p, y, v.splat(P3))
    p = v.fma(p, y, v.splat(P2))
    p = v.fma(p, y, v.splat(P1))
    p = v.fma(p, y, v.splat(P0))
    p = p * p
    p = p * p
    return p * p


@njit(cache=True, nogil=True)
def _blend_block(block, x, y, first, masks, near, state, last):
    """Blend the splats of a chunk that touch a block; returns the position of the splat that
    finished it, or -1.
    """
    zero = v.splat(_f(0.0))
    cut = v.splat(CUT)
    largest = v.splat(_ALPHA_MAX)
    stop = v.splat(_STOP)
    base = block * STATE
    through = v.load(state, base + STATE_T)
    red = v.load(state, base + STATE_R)
    green = v.load(state, base + STATE_G)
    blue = v.load(state, base + STATE_B)
    depth = v.load(state, base + STATE_D)
    finished = -1
    for word in range(CHUNK // 64):
        touching = 0
        for part in range(4):
            touching |= v.bits(v.has_bit(v.load(masks, word * 64 + part * 16), block)) << (
                part * 16
            )
        while touching != 0:
            place = word * 64 + v.lowest_bit(touching)
            touching &= touching - 1
            at = place * RECORD
            s, t = whitened(near, at, x, y)
            exponent = v.fnma(s, s, v.fnma(t, t, v.splat(near[at + PEAK])))
            drawn = exponent >= cut
            alpha = v.select(drawn, v.minimum(falloff(exponent), largest), zero)
            after = v.fnma(through, alpha, through)
            goes_on = after > stop
            weight = v.select(goes_on, through * alpha, zero)
            through = v.select(goes_on, after, v.negative(v.absolute(through)))
            red = v.fma(weight, v.splat(near[at + R]), red)
            green = v.fma(weight, v.splat(near[at + G]), green)
            blue = v.fma(weight, v.splat(near[at + B]), blue)
            depth = v.fma(weight, v.splat(near[at + Z]), depth)
            if last is not None:
                v.store(
                    last,
                    block * 16,
                    v.select(goes_on & drawn, v.splat(_f(first + place)), v.load(last, block * 16)),
                )
            if v.bits(through > zero) == 0:
                finished = first + place
                touching = 0
        if finished >= 0:
            break
    v.store(state, base + STATE_T, through)
    v.store(state, base + STATE_R, red)
    v.store(state, base + STATE_G, green)
    v.store(state, base + STATE_B, blue)
    v.store(state, base + STATE_D, depth)
    return finished


@njit(cache=True, nogil=True)
def composite_tile(lists, start, end, records, x0, y0, state, live, last, near, masks):
    """Blend a tile's splats in order; ``x0, y0`` is the centre of its first pixel. Returns how many
    splats were looked at.

    ``last`` is None, or takes per pixel (sixteen a block) the position in the tile's list of the
    last splat drawn there. ``near`` and ``masks`` are room for a chunk of splats: their records,
    and which blocks they touch.
    """
    looked_at = 0
    for first in range(start, end, CHUNK):
        size = min(CHUNK, end - first)
        for i in range(size):
            v.prefetch(records, np.int64(lists[min(first + i + 16, end - 1)]) * RECORD)
            at = np.int64(lists[first + i]) * RECORD
            v.store(near, i * RECORD, v.load(records, at))
            masks[i] = touched_blocks(records, at, x0, y0)
        for i in range(size, CHUNK):
            masks[i] = 0
        todo = live
        while todo != 0:
            block = v.lowest_bit(todo)
            todo &= todo - 1
            x, y = block_centres(x0, y0, block)
            finished = _blend_block(block, x, y, first - start, masks, near, state, last)
            if finished >= 0:
                live &= ~(1 << block)
                looked_at = max(looked_at, finished + 1)
        if live == 0:
            return looked_at
    return end - start


@njit(cache=True, nogil=True)
def _finish_tile(state, tile_x, tile_y, background, rgb, alpha, depth):
    """Write a tile's pixels: background behind, colours clamped, depth divided by alpha."""
    height, width = alpha.shape
    step_y, step_x = min(background.shape[0] - 1, 1), min(background.shape[1] - 1, 1)
    zero, one = _f(0.0), _f(1.0)
    for row in range(min(TILE, height - tile_y * TILE)):
        y = tile_y * TILE + row
        for column in range(min(TILE, width - tile_x * TILE)):
            x = tile_x * TILE + column
            at = place_of(row, column)
            through = abs(state[at + STATE_T])
            opacity = one - through
            alpha[y, x] = opacity
            depth[y, x] = state[at + STATE_D] / opacity if opacity > zero else zero
            for channel in range(3):
                value = (
                    state[at + STATE_R + 16 * channel]
                    + through * background[y * step_y, x * step_x, channel]
                )
                rgb[y, x, channel] = min(max(value, zero), one)


@njit(cache=True, nogil=True)
def raster_tiles(cursor, tiles_x, starts, lists, records, background, rgb, alpha, depth):
    """Render tiles until none is left; called by each thread. ``cursor[0]`` is the next tile,
    ``cursor[1]`` sums the splats looked at.
    """
    state = np.empty(16 * STATE, np.float32)
    near = np.empty(CHUNK * RECORD, np.float32)
    masks = np.empty(CHUNK, np.int32)
    height, width = alpha.shape
    n_tiles = starts.shape[0] - 1
    while True:
        tile = v.fetch_add(cursor, 0, 1)
        if tile >= n_tiles:
            return
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        x0, y0 = _f(tile_x * TILE) + _f(0.5), _f(tile_y * TILE) + _f(0.5)
        live = start_tile(state, x0, y0, width, height)
        looked_at = composite_tile(
            lists, starts[tile], starts[tile + 1], records, x0, y0, state, live, None, near, masks
        )
        v.fetch_add(cursor, 1, looked_at)
        _finish_tile(state, tile_x, tile_y, background, rgb, alpha, depth)
