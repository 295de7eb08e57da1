"""Take the image's gradient back to the splats, sixteen pixels at a time.

The forward pass is that of `raster_kernels`, which keeps each pixel's transmittance and the last splat
drawn there. The backward pass walks a tile's list from the back: with ``T`` the transmittance
behind a splat and ``S`` what all splats behind it add to the loss,

    T_before = T / (1 - alpha),    dL/dalpha = T_before q - S / (1 - alpha),    S <- S + T_before alpha q,

where ``q`` is the splat's colour, depth and 1 weighted by the gradients of the pixel's sums. alpha
is at most 0.99 and the division undoes the multiplication of the forward pass to rounding.

Sums over the pixels of a tile go to one row per (splat, tile) pair, so that no two threads write to
one place and the order of additions is fixed. They are moments of ``h = alpha dL/dalpha`` over the
whitened coordinates ``s, t`` of the exponent, which stay small for needles.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import ALPHA_MAX, PEAK, RECORD, TILE, B, G, R, Z
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.raster_kernels import (
    CUT,
    KEPT,
    KEPT_LAST,
    KEPT_T,
    block_centres,
    falloff,
    pixel_of,
    touched_blocks,
    whitened,
)

_f = np.float32

# Columns of a block in the backward pass: the above, then the sum S and the gradients of colour,
# depth sum and alpha.
BACK_S, BACK_R, BACK_G, BACK_B, BACK_D, BACK_A, BACK = range(32, 144, 16)
# One row per (splat, tile) pair: gradients of colour and depth, then the moments of h: 1, s, t, s
# s, s t, t t.
PAIR_R, PAIR_G, PAIR_B, PAIR_Z, PAIR_H, PAIR_S, PAIR_T, PAIR_SS, PAIR_ST, PAIR_TT = range(10)
PAIR = 10


@kernel
def start_backward(pixels, tile, tile_x, tile_y, kept, g_colour, g_alpha, g_depth):
    """Load a tile's state; return the bit mask of blocks where anything was drawn and the position
    behind the last splat drawn.
    """
    pixels[:] = _f(0.0)
    live = 0
    end = 0
    for block in range(16):
        kept_offset = (tile * 16 + block) * KEPT
        base = block * BACK
        for pixel in range(16):
            x, y = pixel_of(tile_x, tile_y, block, pixel)
            block_offset = base + pixel
            last = kept[kept_offset + KEPT_LAST + pixel]
            pixels[block_offset + KEPT_T], pixels[block_offset + KEPT_LAST] = (
                kept[kept_offset + KEPT_T + pixel],
                last,
            )
            if last >= _f(0.0):  # pixels outside of the image have none
                live |= 1 << block
                end = max(end, int(last) + 1)
                (
                    pixels[block_offset + BACK_R],
                    pixels[block_offset + BACK_G],
                    pixels[block_offset + BACK_B],
                ) = (
                    g_colour[y, x, 0],
                    g_colour[y, x, 1],
                    g_colour[y, x, 2],
                )
                pixels[block_offset + BACK_D], pixels[block_offset + BACK_A] = (
                    g_depth[y, x],
                    g_alpha[y, x],
                )
    return live, end


@kernel
def _tile_backward(first, end, lists, records, x0, y0, pixels, live, pairs):
    """Walk a tile's splats from the back and write a row of ``pairs`` for each that was drawn."""
    zero = v.splat(_f(0.0))
    for i in range(end - 1, -1, -1):
        v.prefetch(records, np.int64(lists[first + max(i - 8, 0)]) * RECORD)
        offset = np.int64(lists[first + i]) * RECORD
        todo = touched_blocks(records, offset, x0, y0) & live
        if todo == 0:
            continue
        red, green, blue = records[offset + R], records[offset + G], records[offset + B]
        to_red = zero
        to_green = zero
        to_blue = zero
        to_depth = zero
        m = zero
        m_s = zero
        m_t = zero
        m_ss = zero
        m_st = zero
        m_tt = zero
        while todo != 0:
            block = v.lowest_bit(todo)
            todo &= todo - 1
            base = block * BACK
            x, y = block_centres(x0, y0, block)
            s, t = whitened(records, offset, x, y)
            exponent = v.fnma(s, s, v.fnma(t, t, records[offset + PEAK]))
            visible = (exponent >= CUT) & (v.load(pixels, base + KEPT_LAST) >= i)
            if v.bits(visible) == 0:
                continue
            full = v.select(visible, falloff(exponent), 0.0)
            alpha = v.minimum(full, ALPHA_MAX)
            inverse = 1.0 / (1.0 - alpha)
            before = v.load(pixels, base + KEPT_T) * inverse
            g_red = v.load(pixels, base + BACK_R)
            g_green = v.load(pixels, base + BACK_G)
            g_blue = v.load(pixels, base + BACK_B)
            g_depth = v.load(pixels, base + BACK_D)
            q = v.fma(records[offset + Z], g_depth, v.load(pixels, base + BACK_A))
            q = v.fma(red, g_red, v.fma(green, g_green, v.fma(blue, g_blue, q)))
            behind = v.load(pixels, base + BACK_S)
            weight = before * alpha
            v.store(pixels, base + KEPT_T, before)
            v.store(pixels, base + BACK_S, v.fma(weight, q, behind))
            to_red = v.fma(weight, g_red, to_red)
            to_green = v.fma(weight, g_green, to_green)
            to_blue = v.fma(weight, g_blue, to_blue)
            to_depth = v.fma(weight, g_depth, to_depth)
            # The clamp of alpha ends the gradient; colour and depth above still receive theirs.
            h = v.select(full <= ALPHA_MAX, alpha * v.fnma(behind, inverse, before * q), 0.0)
            h_s = h * s
            h_t = h * t
            m = m + h
            m_s = m_s + h_s
            m_t = m_t + h_t
            m_ss = v.fma(h_s, s, m_ss)
            m_st = v.fma(h_s, t, m_st)
            m_tt = v.fma(h_t, t, m_tt)
        row = (first + i) * PAIR
        pairs[row + PAIR_R] = v.total(to_red)
        pairs[row + PAIR_G] = v.total(to_green)
        pairs[row + PAIR_B] = v.total(to_blue)
        pairs[row + PAIR_Z] = v.total(to_depth)
        pairs[row + PAIR_H] = v.total(m)
        pairs[row + PAIR_S] = v.total(m_s)
        pairs[row + PAIR_T] = v.total(m_t)
        pairs[row + PAIR_SS] = v.total(m_ss)
        pairs[row + PAIR_ST] = v.total(m_st)
        pairs[row + PAIR_TT] = v.total(m_tt)


@kernel
def tile_gradients(
    cursor, tiles_x, starts, lists, records, kept, g_colour, g_alpha, g_depth, pairs
):
    """Take the image's gradient to (splat, tile) pairs until no tile is left; called by each
    thread.

    Args:
        cursor: int64 ``(1,)``, the next tile; shared by all threads.
        tiles_x: Tiles in a row of tiles.
        starts: See `binning.tile_offsets`.
        lists: Ranks per tile.
        records: Splats in the order of depth.
        kept: As `raster_kernels.composite_tiles` wrote it.
        g_colour: float32 ``(H, W, 3)``, gradient of the sum of weighted colours.
        g_alpha: float32 ``(H, W)``.
        g_depth: float32 ``(H, W)``, gradient of the sum of weighted depths.
        pairs: float32 output, PAIR per entry of ``lists``, zero at the start.
    """
    pixels = np.empty(16 * BACK, dtype=np.float32)
    while True:
        tile = v.fetch_add(cursor, 0, 1)
        if tile >= starts.shape[0] - 1:
            return
        tile_x = tile % tiles_x
        tile_y = tile // tiles_x
        live, end = start_backward(pixels, tile, tile_x, tile_y, kept, g_colour, g_alpha, g_depth)
        x0 = _f(tile_x * TILE) + _f(0.5)
        y0 = _f(tile_y * TILE) + _f(0.5)
        _tile_backward(starts[tile], end, lists, records, x0, y0, pixels, live, pairs)


@kernel
def add_pairs(lists, pairs, sums):
    """Add the rows of ``pairs`` to ``sums (M, K)``, by the splat that each is of."""
    columns = sums.shape[1]
    for i in range(lists.shape[0]):
        for k in range(columns):
            sums[lists[i], k] += pairs[i * columns + k]
