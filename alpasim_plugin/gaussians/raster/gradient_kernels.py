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

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.kernels import float_kernel, kernel
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
from alpasim_plugin.gaussians.sh import C0, C1, C2, C3, sh_terms

_f = np.float32
_sh_terms = float_kernel(sh_terms)

# Columns of a block in the backward pass: the above, then the sum S and the gradients of colour,
# depth sum and alpha.
_S = 32
_GR = 48
_GG = 64
_GB = 80
_GD = 96
_GA = 112
_BACK = 128
# One row per (splat, tile) pair: gradients of colour and depth, then the moments of h: 1, s, t, s
# s, s t, t t.
PAIR_R, PAIR_G, PAIR_B, PAIR_Z, PAIR_H, PAIR_S, PAIR_T, PAIR_SS, PAIR_ST, PAIR_TT = range(10)
PAIR = 10


@kernel
def _start_backward(pixels, tile, tile_x, tile_y, kept, g_colour, g_alpha, g_depth):
    """Load a tile's state; return the bit mask of blocks where anything was drawn and the position
    behind the last splat drawn.
    """
    pixels[:] = _f(0.0)
    live, end = 0, 0
    for block in range(16):
        at = (tile * 16 + block) * KEPT
        base = block * _BACK
        for pixel in range(16):
            x, y = pixel_of(tile_x, tile_y, block, pixel)
            here = base + pixel
            last = kept[at + KEPT_LAST + pixel]
            pixels[here + KEPT_T], pixels[here + KEPT_LAST] = kept[at + KEPT_T + pixel], last
            if last >= _f(0.0):  # pixels outside of the image have none
                live |= 1 << block
                end = max(end, int(last) + 1)
                pixels[here + _GR], pixels[here + _GG], pixels[here + _GB] = (
                    g_colour[y, x, 0],
                    g_colour[y, x, 1],
                    g_colour[y, x, 2],
                )
                pixels[here + _GD], pixels[here + _GA] = g_depth[y, x], g_alpha[y, x]
    return live, end


@kernel
def _tile_backward(first, end, lists, records, x0, y0, pixels, live, pairs):
    """Walk a tile's splats from the back and write a row of ``pairs`` for each that was drawn."""
    zero = v.splat(_f(0.0))
    for i in range(end - 1, -1, -1):
        v.prefetch(records, np.int64(lists[first + max(i - 8, 0)]) * RECORD)
        at = np.int64(lists[first + i]) * RECORD
        todo = touched_blocks(records, at, x0, y0) & live
        if todo == 0:
            continue
        red, green, blue = records[at + R], records[at + G], records[at + B]
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
            base = block * _BACK
            x, y = block_centres(x0, y0, block)
            s, t = whitened(records, at, x, y)
            exponent = v.fnma(s, s, v.fnma(t, t, records[at + PEAK]))
            drawn = (exponent >= CUT) & (v.load(pixels, base + KEPT_LAST) >= i)
            if v.bits(drawn) == 0:
                continue
            full = v.select(drawn, falloff(exponent), 0.0)
            alpha = v.minimum(full, ALPHA_MAX)
            inverse = 1.0 / (1.0 - alpha)
            before = v.load(pixels, base + KEPT_T) * inverse
            g_red = v.load(pixels, base + _GR)
            g_green = v.load(pixels, base + _GG)
            g_blue = v.load(pixels, base + _GB)
            g_depth = v.load(pixels, base + _GD)
            q = v.fma(records[at + Z], g_depth, v.load(pixels, base + _GA))
            q = v.fma(red, g_red, v.fma(green, g_green, v.fma(blue, g_blue, q)))
            behind = v.load(pixels, base + _S)
            weight = before * alpha
            v.store(pixels, base + KEPT_T, before)
            v.store(pixels, base + _S, v.fma(weight, q, behind))
            to_red = v.fma(weight, g_red, to_red)
            to_green = v.fma(weight, g_green, to_green)
            to_blue = v.fma(weight, g_blue, to_blue)
            to_depth = v.fma(weight, g_depth, to_depth)
            # The clamp of alpha ends the gradient; colour and depth above still receive theirs.
            h = v.select(full <= ALPHA_MAX, alpha * v.fnma(behind, inverse, before * q), 0.0)
            h_s, h_t = h * s, h * t
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
    pixels = np.empty(16 * _BACK, np.float32)
    while True:
        tile = v.fetch_add(cursor, 0, 1)
        if tile >= starts.shape[0] - 1:
            return
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        live, end = _start_backward(pixels, tile, tile_x, tile_y, kept, g_colour, g_alpha, g_depth)
        x0, y0 = _f(tile_x * TILE) + _f(0.5), _f(tile_y * TILE) + _f(0.5)
        _tile_backward(starts[tile], end, lists, records, x0, y0, pixels, live, pairs)


@float_kernel
def write_basis(basis, size, x, y, z):
    """Write ``size`` harmonics of a unit direction."""
    basis[0] = C0
    if size > 1:
        terms = _sh_terms(x, y, z)
        for k in range(1, size):
            basis[k] = terms[k - 1]


@float_kernel
def basis_gradient(weights, size, x, y, z):
    """Return the gradient with respect to x, y and z of the harmonics' sum weighted by
    ``weights``.
    """
    gx = 0.0
    gy = 0.0
    gz = 0.0
    w = weights
    if size > 1:
        gx = -C1 * w[3]
        gy = -C1 * w[1]
        gz = C1 * w[2]
    if size > 4:
        gx += C2[0] * (y * w[4] - z * w[7]) + 2 * x * (C2[2] * w[8] - C2[1] * w[6])
        gy += C2[0] * (x * w[4] - z * w[5]) - 2 * y * (C2[2] * w[8] + C2[1] * w[6])
        gz += -C2[0] * (y * w[5] + x * w[7]) + 4 * C2[1] * z * w[6]
    if size > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        gx += (
            -6 * C3[0] * x * y * w[9]
            + C3[1] * y * z * w[10]
            + 2 * C3[2] * x * y * w[11]
            - 6 * C3[3] * x * z * w[12]
        )
        gx += (
            -C3[2] * (4 * zz - 3 * xx - yy) * w[13]
            + 2 * C3[4] * x * z * w[14]
            - 3 * C3[0] * (xx - yy) * w[15]
        )
        gy += (
            -3 * C3[0] * (xx - yy) * w[9]
            + C3[1] * x * z * w[10]
            - C3[2] * (4 * zz - xx - 3 * yy) * w[11]
        )
        gy += (
            -6 * C3[3] * y * z * w[12]
            + 2 * C3[2] * x * y * w[13]
            - 2 * C3[4] * y * z * w[14]
            + 6 * C3[0] * x * y * w[15]
        )
        gz += (
            C3[1] * x * y * w[10]
            - 8 * C3[2] * (y * z * w[11] + x * z * w[13])
            + C3[3] * (6 * zz - 3 * xx - 3 * yy) * w[12]
        )
        gz += C3[4] * (xx - yy) * w[14]
    return gx, gy, gz


@float_kernel
def colour_splats(cursor, chunk_size, count, ids, means, centre, sh, records):
    """Write the colours of projected splats; called by each thread.

    Args:
        cursor: int64 ``(2,)``: the next chunk, and 1 where a colour was not finite; shared by all
            threads.
        chunk_size: Splats taken at once.
        count: Records.
        ids: int64, which Gaussian a record shows.
        means: float64 ``(N, 3)``, metres, world.
        centre: float64 ``(3,)``, camera centre, metres, world.
        sh: float32 ``(N, K, 3)``.
        records: float32, RECORD per splat; columns R, G, B are written, clamped at 0 below.
    """
    basis = np.empty(16)
    size = sh.shape[1]
    while True:
        first = v.fetch_add(cursor, 0, 1) * chunk_size
        if first >= count:
            return
        for place in range(first, min(first + chunk_size, count)):
            i = ids[place]
            x = means[i, 0] - centre[0]
            y = means[i, 1] - centre[1]
            z = means[i, 2] - centre[2]
            length = 1.0 / np.sqrt(x * x + y * y + z * z)
            write_basis(basis, size, x * length, y * length, z * length)
            red = 0.5
            green = 0.5
            blue = 0.5
            for k in range(size):
                red += basis[k] * sh[i, k, 0]
                green += basis[k] * sh[i, k, 1]
                blue += basis[k] * sh[i, k, 2]
            if not np.isfinite(red + green + blue):
                cursor[1] = 1
            at = place * RECORD
            records[at + R], records[at + G], records[at + B] = (
                max(red, 0.0),
                max(green, 0.0),
                max(blue, 0.0),
            )
