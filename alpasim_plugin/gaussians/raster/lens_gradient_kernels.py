"""Take the gradient of a lens's image back to the splats, sixteen pixels at a time: the scheme of
`gradient_kernels` with the records of `lens_records`.

With y the whitened mean and e the whitened direction of a ray, its least Mahalanobis distance is that of
the residual ``r = t e - y``, where t is the place of the peak: ``q^2 = |r|^2``. A change of the whitened mean by
eta and of the covariance by tau (whitened on both sides) changes it by ``-2 r . eta - r^T tau r``, since at the
peak a change of t changes nothing. So a splat needs nine sums over its pixels besides that of ``h = alpha
dL/dalpha``: those of h r and h r r^T. In the basis of its record, with ``F = c^2 + (a^2 + b^2) / o^2``,

    r = (a c / F, b c / F, -q^2 / o),

which is never longer than the distance out to the alpha cut, so that needles and discs lose nothing. An
ellipse of the image has the residual (s, t, 0) from its centre to the pixel.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import ALPHA_MAX, EXPONENT_SCALE, TILE, R
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.gradient_kernels import (
    BACK,
    BACK_A,
    BACK_B,
    BACK_D,
    BACK_G,
    BACK_R,
    BACK_S,
    start_backward,
)
from alpasim_plugin.gaussians.raster.lens_raster_kernels import INVERSE_SCALE, Q2_SCALE, TINY
from alpasim_plugin.gaussians.raster.lens_rays import BLOCK_ROWS
from alpasim_plugin.gaussians.raster.lens_records import (
    DEPTH,
    INVERSE_O2,
    PEAK,
    ROW_A,
    ROW_B,
    ROW_C,
    SHORT,
)
from alpasim_plugin.gaussians.raster.lens_touch_kernels import touched
from alpasim_plugin.gaussians.raster.project_kernels import dot, load3, row
from alpasim_plugin.gaussians.raster.raster_kernels import (
    CUT,
    KEPT_LAST,
    KEPT_T,
    block_centres,
    falloff,
    touched_blocks,
    whitened,
)

_f = np.float32
UNSCALED = _f(1 / EXPONENT_SCALE)
# One row per (splat, tile) pair: gradients of colour and depth, then the sums of h times: 1; the
# residual; its products r1 r1, r1 r2, r1 r3, r2 r2, r2 r3, r3 r3.
PAIR_COLOUR, PAIR_DEPTH, PAIR_H, PAIR_RESIDUAL, PAIR_PRODUCTS = 0, 3, 4, 5, 8
LENS_PAIR = 14


@kernel
def _residual(records, place, d, x, y):
    """Return the whitened residual of sixteen pixels and q^2; ``d`` are their rays, ``x, y`` their
    centres.
    """
    if records[place + INVERSE_O2] < 0:
        s, t = whitened(records, place, x, y)
        q2 = v.fma(s, s, t * t) * INVERSE_SCALE
        return s * UNSCALED, t * UNSCALED, s * _f(0.0), q2
    a = dot(row(records, place + ROW_A), d)
    b = dot(row(records, place + ROW_B), d)
    ahead = v.maximum(dot(row(records, place + ROW_C), d), _f(0.0))
    across = v.maximum(v.fma(a, a, b * b), TINY)
    inverse_o2 = records[place + INVERSE_O2]
    below = v.fma(ahead, ahead, across * inverse_o2)
    q2 = across / below
    k = ahead / below
    return a * k, b * k, q2 * (-np.sqrt(inverse_o2)), q2


@kernel
def _touched(records, place, blocks, at_blocks, x0, y0):
    """Return the bit mask of the blocks that a splat can touch, as the forward pass does."""
    if records[place + INVERSE_O2] < 0:
        return touched_blocks(records, place, x0, y0)
    return touched(records, place, blocks, at_blocks, None, _f(0.0))


@kernel
def _splat_backward(records, place, number, todo, rays, at_rays, corner, pixels, pairs, at_pair):
    """Take the gradient of the pixels of a tile's blocks ``todo`` to a splat's row of ``pairs``."""
    x0, y0 = corner
    red, green, blue = row(records, place + R)
    zero = v.splat(_f(0.0))
    to_red = to_green = to_blue = to_depth = zero
    m = m1 = m2 = m3 = zero
    m11 = m12 = m13 = m22 = m23 = m33 = zero
    while todo != 0:
        block = v.lowest_bit(todo)
        todo &= todo - 1
        base = block * BACK
        x, y = block_centres(x0, y0, block)
        d = load3(rays, at_rays + block * 48)
        r1, r2, r3, q2 = _residual(records, place, d, x, y)
        exponent = v.fnma(q2, Q2_SCALE, records[place + PEAK])
        visible = (exponent >= CUT) & (v.load(pixels, base + KEPT_LAST) >= number)
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
        q = v.fma(records[place + DEPTH], g_depth, v.load(pixels, base + BACK_A))
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
        r1 = v.select(visible, r1, 0.0)
        r2 = v.select(visible, r2, 0.0)
        r3 = v.select(visible, r3, 0.0)
        h1 = h * r1
        h2 = h * r2
        h3 = h * r3
        m = m + h
        m1 = m1 + h1
        m2 = m2 + h2
        m3 = m3 + h3
        m11 = v.fma(h1, r1, m11)
        m12 = v.fma(h1, r2, m12)
        m13 = v.fma(h1, r3, m13)
        m22 = v.fma(h2, r2, m22)
        m23 = v.fma(h2, r3, m23)
        m33 = v.fma(h3, r3, m33)
    pairs[at_pair + PAIR_COLOUR] = v.total(to_red)
    pairs[at_pair + PAIR_COLOUR + 1] = v.total(to_green)
    pairs[at_pair + PAIR_COLOUR + 2] = v.total(to_blue)
    pairs[at_pair + PAIR_DEPTH] = v.total(to_depth)
    pairs[at_pair + PAIR_H] = v.total(m)
    pairs[at_pair + PAIR_RESIDUAL] = v.total(m1)
    pairs[at_pair + PAIR_RESIDUAL + 1] = v.total(m2)
    pairs[at_pair + PAIR_RESIDUAL + 2] = v.total(m3)
    pairs[at_pair + PAIR_PRODUCTS] = v.total(m11)
    pairs[at_pair + PAIR_PRODUCTS + 1] = v.total(m12)
    pairs[at_pair + PAIR_PRODUCTS + 2] = v.total(m13)
    pairs[at_pair + PAIR_PRODUCTS + 3] = v.total(m22)
    pairs[at_pair + PAIR_PRODUCTS + 4] = v.total(m23)
    pairs[at_pair + PAIR_PRODUCTS + 5] = v.total(m33)


@kernel
def lens_tile_gradients(
    cursor,
    tiles_x,
    starts,
    lists,
    records,
    rays,
    blocks,
    kept,
    g_colour,
    g_alpha,
    g_depth,
    pairs,
):
    """Take the gradient of an image through a lens and a global shutter to (splat, tile) pairs until no
    tile is left; called by each thread.

    Args:
        cursor, tiles_x, starts, lists: See `raster_kernels.composite_tiles`.
        records: Of `lens_project_kernels`, `SHORT` numbers each.
        rays, blocks: See `lens_rays.TileRays`.
        kept: As `lens_raster_kernels.composite_lens_tiles` wrote it.
        g_colour: float32 ``(H, W, 3)``, gradient of the sum of weighted colours.
        g_alpha: float32 ``(H, W)``.
        g_depth: float32 ``(H, W)``, gradient of the sum of weighted distances.
        pairs: float32 output, LENS_PAIR per entry of ``lists``, zero at the start.
    """
    pixels = np.empty(16 * BACK, dtype=np.float32)
    while True:
        tile = v.fetch_add(cursor, 0, 1)
        if tile >= starts.shape[0] - 1:
            return
        tile_x = tile % tiles_x
        tile_y = tile // tiles_x
        live, end = start_backward(pixels, tile, tile_x, tile_y, kept, g_colour, g_alpha, g_depth)
        corner = _f(tile_x * TILE) + _f(0.5), _f(tile_y * TILE) + _f(0.5)
        first = starts[tile]
        at_rays = tile * 16 * 48
        at_blocks = tile * BLOCK_ROWS * 16
        for i in range(end - 1, -1, -1):
            v.prefetch(records, np.int64(lists[first + max(i - 8, 0)]) * SHORT)
            place = np.int64(lists[first + i]) * SHORT
            todo = _touched(records, place, blocks, at_blocks, corner[0], corner[1]) & live
            if todo != 0:
                at_pair = (first + i) * LENS_PAIR
                _splat_backward(
                    records, place, i, todo, rays, at_rays, corner, pixels, pairs, at_pair
                )
