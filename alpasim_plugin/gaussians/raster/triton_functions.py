"""Triton functions that the kernels of pinholes and of lenses share: vectors, what a block of Gaussians is
made of, and what it writes. Three tensors, one per axis, are a tuple.
"""

# Triton's decorators and tensor types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator,misc"

from __future__ import annotations

import triton
import triton.language as tl

from alpasim_plugin.gaussians import constants, sh

ALPHA_MIN = tl.constexpr(constants.ALPHA_MIN)
EPS2D_PX2 = tl.constexpr(constants.EPS2D_PX2)
ALPHA_MAX = tl.constexpr(constants.ALPHA_MAX)
_STOP = tl.constexpr(constants.TRANSMITTANCE_STOP)
_CENTRE = tl.constexpr(constants.POSE_CENTRE)
_RED = tl.constexpr(constants.R)
_C0 = tl.constexpr(sh.C0)
_C1 = tl.constexpr(sh.C1)
_C20, _C21, _C22 = (tl.constexpr(value) for value in sh.C2)
_C30, _C31, _C32, _C33, _C34 = (tl.constexpr(value) for value in sh.C3)


@triton.jit
def vector(numbers, place):
    """Return three numbers of an array."""
    return tl.load(numbers + place), tl.load(numbers + place + 1), tl.load(numbers + place + 2)


@triton.jit
def number(numbers, place):
    """Return a number in float32."""
    return tl.load(numbers + place).to(tl.float32)


@triton.jit
def vector32(numbers, place):
    """Return three numbers in float32."""
    return number(numbers, place), number(numbers, place + 1), number(numbers, place + 2)


@triton.jit
def dot(a, b):
    """Return the dot product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    """Return the cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def scaled(a, k):
    """Return a vector times a number."""
    return a[0] * k, a[1] * k, a[2] * k


@triton.jit
def added(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@triton.jit
def combined(weights, a, b, c):
    """Return the sum of three vectors with weights: a row times a matrix of three rows."""
    return added(added(scaled(a, weights[0]), scaled(b, weights[1])), scaled(c, weights[2]))


@triton.jit
def as_f64(a):
    """Return a vector in float64."""
    return a[0].to(tl.float64), a[1].to(tl.float64), a[2].to(tl.float64)


@triton.jit
def as_f32(a):
    """Return a vector in float32."""
    return a[0].to(tl.float32), a[1].to(tl.float32), a[2].to(tl.float32)


@triton.jit
def offsets(means, i, present, pose):
    """Return Gaussians' means from the camera's centre in their node's axes, float64: positions keep
    millimetres at coordinates of the size of UTM's.
    """
    centre = vector(pose, _CENTRE)
    return (
        tl.load(means + 3 * i, present, 0.0) - centre[0],
        tl.load(means + 3 * i + 1, present, 0.0) - centre[1],
        tl.load(means + 3 * i + 2, present, 0.0) - centre[2],
    )


@triton.jit
def _factor_row(factors, i, visible):
    return (
        tl.load(factors + 9 * i, visible, 0.0),
        tl.load(factors + 9 * i + 1, visible, 0.0),
        tl.load(factors + 9 * i + 2, visible, 0.0),
    )


@triton.jit
def factor_rows(factors, i, visible):
    """Return the rows of the matrices whose product with their transpose is the covariance."""
    return (
        _factor_row(factors, i, visible),
        _factor_row(factors + 3, i, visible),
        _factor_row(factors + 6, i, visible),
    )


@triton.jit
def _colour(sh_ptr, offset, visible, x, y, z, CHANNEL: tl.constexpr, SIZE: tl.constexpr):
    """Return one colour channel of splats seen along unit directions, 0 where it would be less.

    ``offset`` is the first coefficient of each splat; the order is that of `sh.sh_terms`.
    """
    offset += CHANNEL
    value = 0.5 + _C0 * tl.load(sh_ptr + offset, visible, 0.0)
    if SIZE > 1:
        value -= _C1 * y * tl.load(sh_ptr + offset + 3, visible, 0.0)
        value += _C1 * z * tl.load(sh_ptr + offset + 6, visible, 0.0)
        value -= _C1 * x * tl.load(sh_ptr + offset + 9, visible, 0.0)
    if SIZE > 4:
        value += _C20 * x * y * tl.load(sh_ptr + offset + 12, visible, 0.0)
        value -= _C20 * y * z * tl.load(sh_ptr + offset + 15, visible, 0.0)
        value += _C21 * (2 * z * z - x * x - y * y) * tl.load(sh_ptr + offset + 18, visible, 0.0)
        value -= _C20 * x * z * tl.load(sh_ptr + offset + 21, visible, 0.0)
        value += _C22 * (x * x - y * y) * tl.load(sh_ptr + offset + 24, visible, 0.0)
    if SIZE > 9:
        four_zz = 4 * z * z - x * x - y * y
        value -= _C30 * y * (3 * x * x - y * y) * tl.load(sh_ptr + offset + 27, visible, 0.0)
        value += _C31 * x * y * z * tl.load(sh_ptr + offset + 30, visible, 0.0)
        value -= _C32 * y * four_zz * tl.load(sh_ptr + offset + 33, visible, 0.0)
        cubic = z * (2 * z * z - 3 * x * x - 3 * y * y)
        value += _C33 * cubic * tl.load(sh_ptr + offset + 36, visible, 0.0)
        value -= _C32 * x * four_zz * tl.load(sh_ptr + offset + 39, visible, 0.0)
        value += _C34 * z * (x * x - y * y) * tl.load(sh_ptr + offset + 42, visible, 0.0)
        value -= _C30 * x * (x * x - 3 * y * y) * tl.load(sh_ptr + offset + 45, visible, 0.0)
    return tl.maximum(value, 0.0)


@triton.jit
def store_colours(sh_ptr, i, d, record, on_screen, SIZE: tl.constexpr):
    """Write the colours of Gaussians seen along ``d``, float64, of any length but 0."""
    inverse = 1.0 / tl.sqrt(tl.maximum(dot(d, d), 1e-30))  # what is not present has no direction
    toward = as_f32(scaled(d, inverse))
    first = i * (SIZE * 3)
    for channel in tl.static_range(3):
        value = _colour(sh_ptr, first, on_screen, toward[0], toward[1], toward[2], channel, SIZE)
        tl.store(record + _RED + channel, value, on_screen)


@triton.jit
def slots_of(block, BLOCK: tl.constexpr):
    """Return the slots of a block's Gaussians, int64: their places in tensors do not fit int32."""
    return block.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)


@triton.jit
def _tiles_between(low, high, count, TILE: tl.constexpr):
    """Return the first tile and the last + 1 that pixels ``low`` to ``high`` meet, in 0..count."""
    # Clamped as floats: a splat at 1e30 pixels has no tile number.
    first = tl.minimum(tl.maximum(tl.floor(low / TILE), 0.0), count).to(tl.int32)
    last = tl.minimum(tl.maximum(tl.floor(high / TILE), -1.0), count - 1.0).to(tl.int32) + 1
    return first, last


@triton.jit
def store_tiles(
    left,
    right,
    top,
    bottom,
    visible,
    depths,
    boxes,
    counts,
    slot,
    depth,
    above,
    tiles_x,
    tiles_y,
    TILE: tl.constexpr,
):
    """Write the depths of splats, float32, and the tiles that their boxes, pixels, meet; return which
    are on the screen. What is not visible has depth infinity and no tile. ``above`` is the number of
    rows of tiles in the views before.
    """
    x0, x1 = _tiles_between(left, right, tiles_x, TILE)
    y0, y1 = _tiles_between(top, bottom, tiles_y, TILE)
    count = tl.maximum(x1 - x0, 0) * tl.maximum(y1 - y0, 0)
    count = tl.where(visible, count, 0)
    tl.store(depths + slot, tl.where(visible, depth, float("inf")))
    tl.store(counts + slot, count)
    tl.store(boxes + slot * 4, x0)
    tl.store(boxes + slot * 4 + 1, x1)
    tl.store(boxes + slot * 4 + 2, above + y0)
    tl.store(boxes + slot * 4 + 3, above + y1)
    return count > 0


@triton.jit
def pixels_of(tile, tiles_x, TILE: tl.constexpr):
    """Return the columns and the rows of a tile's pixels."""
    column = (tile % tiles_x) * TILE + tl.arange(0, TILE)[None, :]
    row = (tile // tiles_x) * TILE + tl.arange(0, TILE)[:, None]
    return tl.broadcast(column, row)


@triton.jit
def ellipse_q2(record, px, py):
    """Return the squared distance of pixels from a splat's middle, in standard deviations."""
    dx = px - tl.load(record)
    dy = py - tl.load(record + 1)
    s = tl.load(record + 2) * dx + tl.load(record + 3) * dy
    t = tl.load(record + 4) * dy
    return s * s + t * t


@triton.jit
def layer(alpha, transmittance, open_):
    """Return where a layer of an opacity is drawn, with which weight, what is seen through it and which
    pixels are open behind it: the splat that would close a pixel is left out, and so is all behind it.
    """
    alpha = tl.minimum(alpha, ALPHA_MAX)
    visible = (alpha >= ALPHA_MIN) & open_
    after = transmittance * (1.0 - alpha)
    open_ = open_ & ~(visible & (after <= _STOP))
    visible = visible & open_
    weight = tl.where(visible, alpha * transmittance, 0.0)
    return visible, weight, tl.where(visible, after, transmittance), open_


@triton.jit
def store_pixels(out, light, depth, transmittance, last, inside):
    """Write the six numbers of pixels: see `triton_kernels.composite`."""
    tl.store(out, light[0], inside)
    tl.store(out + 1, light[1], inside)
    tl.store(out + 2, light[2], inside)
    tl.store(out + 3, depth, inside)
    tl.store(out + 4, transmittance, inside)
    tl.store(out + 5, last.to(tl.float32), inside)
