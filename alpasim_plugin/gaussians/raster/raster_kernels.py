"""Composite the splats of each tile, sixteen pixels at a time.

A tile of 16 x 16 pixels is sixteen blocks of 4 x 4. For each splat one vector operation over the block centres tells which blocks it can
touch; each touched block is one vector of pixels. Blocks whose pixels are all finished are left out, and a tile ends when no block is left.

The exponential is ``alpha = o exp(-q^2/2) = P(y)^8`` with ``y = peak - s^2 - t^2`` in [-0.5, 0.5] wherever alpha reaches the cut, and P a
polynomial of degree 5 for ``2^(y - 0.5)``: relative error below 2e-6, without range reduction.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np
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
from alpasim_plugin.plugins.kernels import njit

_f = np.float32
_nodes = np.cos(np.pi * (np.arange(6) + 0.5) / 6) / 2  # interpolation at Chebyshev nodes of [-0.5, 0.5]
P0, P1, P2, P3, P4, P5 = (_f(c) for c in chebyshev.cheb2poly(chebyshev.chebfit(2 * _nodes, 2.0 ** (_nodes - 0.5), 5)) * 2.0 ** np.arange(6))
CUT = _f((np.log2(ALPHA_MIN) + 4.0) / 8.0)
_ALPHA_MAX = _f(ALPHA_MAX)
_STOP = _f(TRANSMITTANCE_STOP)
# Columns of a block's state, sixteen pixels each. A finished pixel keeps its transmittance with the sign turned.
STATE_T, STATE_R, STATE_G, STATE_B, STATE_D = 0, 16, 32, 48, 64
STATE = 80


@njit(cache=True, nogil=True)
def pixel_of(tile_x, tile_y, block, pixel):
    """Return the image column and row of a pixel (0..15) of a tile's block (0..15)."""
    return tile_x * TILE + (block & 3) * 4 + (pixel & 3), tile_y * TILE + (block >> 2) * 4 + (pixel >> 2)


@njit(cache=True, nogil=True)
def place_of(row, column):
    """Return where the state of a tile's pixel begins."""
    return ((row >> 2) * 4 + (column >> 2)) * STATE + (row & 3) * 4 + (column & 3)


@njit(cache=True, nogil=True)
def start_tile(state, tile_x, tile_y, width, height):
    """Reset the state of a tile and return the bit mask of blocks that hold a pixel of the image."""
    live = 0
    state[:] = _f(0.0)
    for block in range(16):
        for pixel in range(16):
            x, y = pixel_of(tile_x, tile_y, block, pixel)
            inside = x < width and y < height
            state[block * STATE + STATE_T + pixel] = _f(1.0) if inside else _f(-1.0)
            if inside:
                live |= 1 << block
    return live


@njit(cache=True, nogil=True)
def touched_blocks(records, at, dx, dy):
    """Return the bit mask of the sixteen blocks that a splat can touch; ``dx, dy`` is the tile's first pixel from the splat's centre."""
    nil, four, middle = _f(0.0), _f(4.0), _f(1.5)
    l11, l12, l22 = records[at + L11], records[at + L12], records[at + L22]
    s = v.splat(l11 * dx + l12 * dy + middle * (l11 + l12)) + v.lane_pattern(four * l11, four * l12)
    t = v.splat(l22 * dy + middle * l22) + v.lane_pattern(nil, four * l22)
    touched = v.fma(s, s, t * t) <= v.splat(records[at + BLOCK_REACH])
    x = v.splat(dx + middle) + v.lane_pattern(four, nil)
    y = v.splat(dy + middle) + v.lane_pattern(nil, four)
    touched = touched & (v.absolute(x) <= v.splat(records[at + RADIUS_X] + middle))
    touched = touched & (v.absolute(y) <= v.splat(records[at + RADIUS_Y] + middle))
    return v.bits(touched)


@njit(cache=True, nogil=True)
def block_coordinates(records, at, dx, dy, block):
    """Return ``s`` and ``t`` at the sixteen pixels of a block: the splat's exponent is ``peak - s^2 - t^2``."""
    l11, l12, l22 = records[at + L11], records[at + L12], records[at + L22]
    column, row = _f(_f(4.0) * _f(block & 3)), _f(_f(4.0) * _f(block >> 2))
    s = v.splat(l11 * dx + l12 * dy + l11 * column + l12 * row) + v.lane_pattern(l11, l12)
    t = v.splat(l22 * dy + l22 * row) + v.lane_pattern(_f(0.0), l22)
    return s, t


@njit(cache=True, nogil=True)
def falloff(y):
    """Return ``2^(8 y - 4)``, the opacity at an exponent between the cut and 0.5, not yet held to the largest alpha."""
    p = v.fma(v.splat(P5), y, v.splat(P4))
    p = v.fma(p, y, v.splat(P3))
    p = v.fma(p, y, v.splat(P2))
    p = v.fma(p, y, v.splat(P1))
    p = v.fma(p, y, v.splat(P0))
    p = p * p
    p = p * p
    return p * p


@njit(cache=True, nogil=True)
def composite_tile(lists, start, end, records, x0, y0, state, live, last):
    """Blend a tile's splats in order; ``x0, y0`` is the centre of its first pixel. Returns how many splats were looked at.

    ``last`` is None, or takes per pixel (sixteen a block) the position in the tile's list of the last splat drawn there.
    """
    zero = v.splat(_f(0.0))
    for i in range(start, end):
        v.prefetch(records, np.int64(lists[min(i + 8, end - 1)]) * RECORD)
        at = np.int64(lists[i]) * RECORD
        dx, dy = x0 - records[at + U], y0 - records[at + V]
        todo = touched_blocks(records, at, dx, dy) & live
        if todo == 0:
            continue
        peak = v.splat(records[at + PEAK])
        red, green, blue, depth = v.splat(records[at + R]), v.splat(records[at + G]), v.splat(records[at + B]), v.splat(records[at + Z])
        while todo != 0:
            block = v.lowest_bit(todo)
            todo &= todo - 1
            s, t = block_coordinates(records, at, dx, dy, block)
            y = v.fnma(s, s, v.fnma(t, t, peak))
            drawn = y >= v.splat(CUT)
            if v.bits(drawn) == 0:
                continue
            alpha = v.select(drawn, v.minimum(falloff(y), v.splat(_ALPHA_MAX)), zero)
            base = block * STATE
            before = v.load(state, base + STATE_T)
            after = v.fnma(before, alpha, before)
            goes_on = after > v.splat(_STOP)
            weight = v.select(goes_on, before * alpha, zero)
            after = v.select(goes_on, after, v.negative(v.absolute(before)))
            v.store(state, base + STATE_T, after)
            v.store(state, base + STATE_R, v.fma(weight, red, v.load(state, base + STATE_R)))
            v.store(state, base + STATE_G, v.fma(weight, green, v.load(state, base + STATE_G)))
            v.store(state, base + STATE_B, v.fma(weight, blue, v.load(state, base + STATE_B)))
            v.store(state, base + STATE_D, v.fma(weight, depth, v.load(state, base + STATE_D)))
            if last is not None:
                place = v.splat(_f(i - start))
                v.store(last, block * 16, v.select(goes_on & drawn, place, v.load(last, block * 16)))
            if v.bits(after > zero) == 0:
                live &= ~(1 << block)
        if live == 0:
            return i + 1 - start
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
                value = state[at + STATE_R + 16 * channel] + through * background[y * step_y, x * step_x, channel]
                rgb[y, x, channel] = min(max(value, zero), one)


@njit(cache=True, nogil=True)
def raster_tiles(cursor, tiles_x, starts, lists, records, background, rgb, alpha, depth):
    """Render tiles until none is left; called by each thread. ``cursor[0]`` is the next tile, ``cursor[1]`` sums the splats looked at."""
    state = np.empty(16 * STATE, np.float32)
    height, width = alpha.shape
    n_tiles = starts.shape[0] - 1
    while True:
        tile = v.fetch_add(cursor, 0, 1)
        if tile >= n_tiles:
            return
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        live = start_tile(state, tile_x, tile_y, width, height)
        x0, y0 = _f(tile_x * TILE) + _f(0.5), _f(tile_y * TILE) + _f(0.5)
        looked_at = composite_tile(lists, starts[tile], starts[tile + 1], records, x0, y0, state, live, None)
        v.fetch_add(cursor, 1, looked_at)
        _finish_tile(state, tile_x, tile_y, background, rgb, alpha, depth)
