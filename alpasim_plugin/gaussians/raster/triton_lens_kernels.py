"""Triton kernels that draw a lens in one pass: project Gaussians through it, composite tiles along the
rays of its pixels.

They compute what `lens_project_kernels`, `lens_small_kernels`, `lens_map_kernels` and
`lens_raster_kernels` do, where the equations stand; the definition is `tests/gaussians/lens_reference.py`.
Columns of records, lenses and motions are theirs, but for an opacity in the place of its logarithm, and
for ellipses whose exponent is ``-(s^2 + t^2) / 2``.
"""

# Triton's decorators and tensor types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator,misc"

from __future__ import annotations

import triton
import triton.language as tl

from alpasim_plugin.cameras import image_map
from alpasim_plugin.gaussians import constants
from alpasim_plugin.gaussians.raster import (
    lens_map_kernels,
    lens_on_device,
    lens_project_kernels,
    lens_rays,
    lens_records,
    lens_small_kernels,
    lens_touch_kernels,
)
from alpasim_plugin.gaussians.raster.triton_functions import (
    ALPHA_MIN,
    EPS2D_PX2,
    added,
    as_f32,
    as_f64,
    combined,
    cross,
    dot,
    ellipse_q2,
    factor_rows,
    layer,
    number,
    offsets,
    pixels_of,
    scaled,
    slots_of,
    store_colours,
    store_pixels,
    store_tiles,
    vector,
    vector32,
)

_POSE = tl.constexpr(lens_on_device.LENS_POSE)
_ANTIALIAS = tl.constexpr(constants.POSE_ANTIALIAS)
_NEAR = tl.constexpr(constants.POSE_NEAR)
_FAR = tl.constexpr(constants.POSE_FAR)
_TURN = tl.constexpr(constants.POSE_TURN)
_SHIFT = tl.constexpr(constants.POSE_SHIFT)
_MOVED = tl.constexpr(lens_on_device.MOVED)
_NODE_MOTION = tl.constexpr(lens_on_device.NODE_MOTION)
_MOVES_RAD = tl.constexpr(lens_on_device.MOVES_RAD)
_MOVES_M = tl.constexpr(lens_on_device.MOVES_M)

_LENS_SIZE = tl.constexpr(lens_rays.LENS_SIZE)
_MIDDLE = tl.constexpr(lens_rays.LENS_MIDDLE)
_COS = tl.constexpr(lens_rays.LENS_COS)
_SIN = tl.constexpr(lens_rays.LENS_SIN)
_S_MOST = tl.constexpr(lens_rays.LENS_S_MOST)
_LEAST = tl.constexpr(lens_rays.LENS_LEAST)
_MOST = tl.constexpr(lens_rays.LENS_MOST)
_MARGIN = tl.constexpr(lens_rays.LENS_MARGIN)
_LINEAR = tl.constexpr(lens_rays.LENS_LINEAR)
_BENT = tl.constexpr(lens_rays.LENS_BENDS + 1)
_SMALL = tl.constexpr(lens_rays.LENS_SMALL)
_TIME = tl.constexpr(lens_rays.LENS_TIME)
_LENS_TURN = tl.constexpr(lens_rays.LENS_TURN)
_LENS_SHIFT = tl.constexpr(lens_rays.LENS_SHIFT)
_G = tl.constexpr(lens_rays.LENS_G)
_BEND = tl.constexpr(lens_rays.LENS_BEND)
_SLOPE = tl.constexpr(lens_rays.LENS_SLOPE)
_DEGREE = tl.constexpr(image_map.DEGREE)
_MOTION = tl.constexpr(lens_rays.MOTION)
_MOTION_TURN = tl.constexpr(lens_rays.MOTION_TURN)
_MOTION_SPEED = tl.constexpr(lens_rays.MOTION_SPEED)
_MOTION_CENTRE = tl.constexpr(lens_rays.MOTION_CENTRE)

_A = tl.constexpr(lens_records.ROW_A)
_B = tl.constexpr(lens_records.ROW_B)
_C = tl.constexpr(lens_records.ROW_C)
_RED = tl.constexpr(constants.R)
_INVERSE_O2 = tl.constexpr(lens_records.INVERSE_O2)
_OPACITY = tl.constexpr(lens_records.PEAK)
_DISTANCE_SEEN = tl.constexpr(lens_records.DEPTH)
_ROW_S = tl.constexpr(lens_records.ROW_S)
_NODE = tl.constexpr(lens_records.NODE)
_DISTANCE = tl.constexpr(lens_records.DISTANCE)
_PASSED = tl.constexpr(lens_records.PASSED)

_LEAST_SLOPE = tl.constexpr(lens_map_kernels.LEAST_SLOPE)
_AROUND = tl.constexpr(lens_project_kernels.AROUND)
_WIDE = tl.constexpr(lens_project_kernels.WIDE)
_CLOSE = tl.constexpr(lens_touch_kernels.CLOSE)
_SMALL_SHIFTS = tl.constexpr(lens_project_kernels.SMALL_SHIFTS)
_NEAR_SHIFTS = tl.constexpr(lens_project_kernels.NEAR_SHIFTS)
_LATE = tl.constexpr(lens_project_kernels.LATE)
_EVERY = tl.constexpr(lens_project_kernels.EVERY)
_WIDEST = tl.constexpr(lens_small_kernels.WIDEST)
_BEYOND = tl.constexpr(lens_small_kernels.BEYOND)
_MOST_CHANGE = tl.constexpr(lens_small_kernels.MOST_CHANGE)
_EIGHTH = tl.constexpr(0.5**0.5)  # cosine and sine of an eighth of a turn
_TINY = tl.constexpr(1e-30)
_ROUNDING = tl.constexpr(1e-5)  # of a distance, in float32


# Where a lens shows points: see `lens_map_kernels`.


@triton.jit
def _polynomial(lens, FIRST: tl.constexpr, DEGREE: tl.constexpr, s):
    x = s * (2.0 / number(lens, _S_MOST)) - 1.0
    value = x * number(lens, FIRST + DEGREE) + number(lens, FIRST + DEGREE - 1)
    for k in tl.static_range(2, DEGREE + 1):
        value = value * x + number(lens, FIRST + DEGREE - k)
    return value


@triton.jit
def _place_on_sphere(lens, p):
    """Return h of points, held to where the lens is described, its s and that before."""
    n = tl.sqrt(dot(p, p))
    inverse = 1.0 / tl.maximum(n + p[2], 1e-6 * n + 1e-30)
    hx = p[0] * inverse
    hy = p[1] * inverse
    s = hx * hx + hy * hy
    held = tl.minimum(s, number(lens, _S_MOST))
    shrink = tl.sqrt(held / tl.maximum(s, 1e-30))
    return hx * shrink, hy * shrink, held, s


@triton.jit
def _pixel(lens, hx, hy, held, g, BENDS: tl.constexpr):
    x = hx * g
    y = hy * g
    if BENDS:
        k = 2.0 / (1.0 - held)
        tx = hx * k
        ty = hy * k
        r2 = tx * tx + ty * ty
        p1 = number(lens, _BENT)
        p2 = number(lens, _BENT + 1)
        x += r2 * (number(lens, _BENT + 2) + r2 * number(lens, _BENT + 3))
        x += 2.0 * p1 * tx * ty + p2 * (2.0 * tx * tx + r2)
        y += r2 * (number(lens, _BENT + 4) + r2 * number(lens, _BENT + 5))
        y += p1 * (2.0 * ty * ty + r2) + 2.0 * p2 * tx * ty
    u = x * number(lens, _LINEAR) + y * number(lens, _LINEAR + 1) + number(lens, _MIDDLE)
    v = x * number(lens, _LINEAR + 2) + y * number(lens, _LINEAR + 3) + number(lens, _MIDDLE + 1)
    return u, v


@triton.jit
def _shown(lens, p, BENDS: tl.constexpr):
    """Return the pixels at which a lens shows points, and their s."""
    hx, hy, held, s = _place_on_sphere(lens, p)
    u, v = _pixel(lens, hx, hy, held, _polynomial(lens, _G, _DEGREE, held), BENDS)
    return u, v, s


@triton.jit
def _times_bent(lens, hx, hy, held, j0, j1, j2, j3):
    """Return a Jacobian by h with that of the tangential and thin prism terms added."""
    p1 = number(lens, _BENT)
    p2 = number(lens, _BENT + 1)
    t = 2.0 / (1.0 - held)
    x = hx * t
    y = hy * t
    r2 = x * x + y * y
    fx = r2 * 4.0 * number(lens, _BENT + 3) + 2.0 * number(lens, _BENT + 2)
    fy = r2 * 4.0 * number(lens, _BENT + 5) + 2.0 * number(lens, _BENT + 4)
    xx = 2.0 * p1 * y + 6.0 * p2 * x + fx * x
    xy = 2.0 * p1 * x + 2.0 * p2 * y + fx * y
    yx = 2.0 * p1 * x + 2.0 * p2 * y + fy * x
    yy = 6.0 * p1 * y + 2.0 * p2 * x + fy * y
    # of the tangents by h: t I + t^2 h h^T
    d00 = x * x + t
    d01 = x * y
    d11 = y * y + t
    j0 += xx * d00 + xy * d01
    j1 += xx * d01 + xy * d11
    j2 += yx * d00 + yy * d01
    j3 += yx * d01 + yy * d11
    return j0, j1, j2, j3


@triton.jit
def _slopes(lens, hx, hy, held, g, BENDS: tl.constexpr):
    """Return the derivative of the pixel by the two tangents of `_tangents`, row by row."""
    slope = 2.0 * _polynomial(lens, _SLOPE, _DEGREE - 1, held)
    slope = tl.maximum(slope, (_LEAST_SLOPE - 1.0) * g / tl.maximum(held, 1e-12))
    j0 = slope * hx * hx + g
    j1 = slope * hx * hy
    j2 = j1
    j3 = slope * hy * hy + g
    if BENDS:
        j0, j1, j2, j3 = _times_bent(lens, hx, hy, held, j0, j1, j2, j3)
    a0 = number(lens, _LINEAR)
    a1 = number(lens, _LINEAR + 1)
    a2 = number(lens, _LINEAR + 2)
    a3 = number(lens, _LINEAR + 3)
    k = 0.5 * held + 0.5
    return (
        k * (a0 * j0 + a1 * j2),
        k * (a0 * j1 + a1 * j3),
        k * (a2 * j0 + a3 * j2),
        k * (a2 * j1 + a3 * j3),
    )


@triton.jit
def _tangents(p, n):
    """Return two unit vectors across the directions of points, along h's axes."""
    inverse = 1.0 / tl.maximum(n + p[2], 1e-7 * n)
    hx = p[0] * inverse
    hy = p[1] * inverse
    k = 2.0 / (hx * hx + hy * hy + 1.0)
    mixed = -k * hx * hy
    return (1.0 - k * hx * hx, mixed, -k * hx), (mixed, 1.0 - k * hy * hy, -k * hy)


# While a shutter is open: see `lens_map_kernels`.


@triton.jit
def _turned(a, turn, time):
    """Return vectors turned by ``time turn``, to second order."""
    first = cross(turn, a)
    second = cross(turn, first)
    return added(added(a, scaled(first, time)), scaled(second, 0.5 * time * time))


@triton.jit
def _moved_at(p, pose, motion, lens, time):
    """Return where points are in the camera's axes at times of the shutter, and by how much they move
    in one.
    """
    node = tl.load(pose + _NODE_MOTION).to(tl.int32)
    motion += tl.maximum(node, 0) * _MOTION
    node_turn = scaled(vector32(motion, _MOTION_TURN), (node >= 0).to(tl.float32))
    moved = vector32(pose, _MOVED)
    from_centre = added(p, scaled(vector32(motion, _MOTION_CENTRE), -1.0))
    even = added(cross(node_turn, from_centre), scaled(moved, -1.0))
    place = added(p, scaled(even, time))
    turn = vector32(lens, _LENS_TURN)
    speed = added(even, scaled(cross(turn, place), -1.0))
    return _turned(place, turn, -time), _turned(speed, turn, -time)


@triton.jit
def _time_of(lens, u, v, most):
    """Return when pixels are exposed, in shutters from the middle, held to ``most``."""
    time = u * number(lens, _TIME) + v * number(lens, _TIME + 1) + number(lens, _TIME + 2)
    return tl.minimum(tl.maximum(time, -most), most)


@triton.jit
def _time_after(p, pose, motion, lens, time, most, BENDS: tl.constexpr):
    """Return when the pixel is exposed in which points are shown that moved until a time."""
    place, _ = _moved_at(p, pose, motion, lens, time)
    u, v, _ = _shown(lens, place, BENDS)
    return _time_of(lens, u, v, most)


@triton.jit
def _time_seen(p, pose, motion, lens, most, BENDS: tl.constexpr):
    """Return when points are seen: at the time of the pixel that shows them then."""
    first = _time_after(p, pose, motion, lens, p[0] * 0.0, most, BENDS)
    missed = _time_after(p, pose, motion, lens, first, most, BENDS) - first
    is_off = tl.abs(first) > 1e-3
    slope = (missed - first) / tl.where(is_off, first, 1.0)
    slope = tl.minimum(tl.where(is_off, slope, -1.0), -0.5)
    time = first - missed / slope
    again = _time_after(p, pose, motion, lens, time, most, BENDS)
    time -= (again - time) / slope
    return tl.minimum(tl.maximum(time, -most), most)


# Small Gaussians, ellipses of the image: see `lens_small_kernels`.


@triton.jit
def _in_node(pose, a):
    """Return a row in the camera's axes times the rotation from a node to the camera."""
    return combined(a, vector32(pose, 0), vector32(pose, 3), vector32(pose, 6))


@triton.jit
def _is_small(lens, pose, factor, p, n):
    """Return which Gaussians, at distances ``n``, an ellipse of the image shows closely enough."""
    turn_rad = number(pose, _MOVES_RAD)
    shift_m = number(pose, _MOVES_M)
    inverse = 1.0 / n
    along = combined(_in_node(pose, scaled(p, inverse)), factor[0], factor[1], factor[2])
    along2 = dot(along, along)
    whole2 = dot(factor[0], factor[0]) + dot(factor[1], factor[1]) + dot(factor[2], factor[2])
    across = tl.sqrt(tl.maximum(whole2 - along2, 0.0)) * inverse
    shutters = tl.abs(number(lens, _TIME)) + tl.abs(number(lens, _TIME + 1))
    shutters *= number(lens, _MOST)
    bend = inverse * shutters * shift_m + number(lens, _BEND) + shutters * turn_rad
    off = (across + _low_pass(lens, pose)) * bend + tl.sqrt(along2) * inverse
    is_close = (off <= number(lens, _SMALL)) & (across <= _WIDEST)
    return is_close & (n >= _SMALL_SHIFTS * shift_m)


@triton.jit
def _image_rows(place, k0, k1, k2, k3):
    """Return by how much the pixel changes with places, two rows in the camera's axes, and the
    distance.
    """
    n = tl.sqrt(dot(place, place))
    right, down = _tangents(place, n)
    inverse = 1.0 / n
    to_u = added(scaled(right, k0 * inverse), scaled(down, k1 * inverse))
    to_v = added(scaled(right, k2 * inverse), scaled(down, k3 * inverse))
    return to_u, to_v, n


@triton.jit
def _in_image(row_u, row_v, factor, eps):
    """Return covariances in the image at an instant, their determinants over the last number, and the
    share of that without the low-pass in it.
    """
    m = combined(row_u, factor[0], factor[1], factor[2])
    n = combined(row_v, factor[0], factor[1], factor[2])
    nn = dot(n, n)
    c11 = dot(m, m) + eps
    c22 = nn + eps
    minors = scaled(cross(m, n), tl.sqrt(1.0 / c22))
    raw = dot(minors, minors)
    variance = raw + eps * ((c11 + nn) / c22)
    return c11, dot(m, n), c22, variance, raw / variance


@triton.jit
def _while_exposed(lens, move_u, move_v, c11, c12, c22, variance):
    """Return `_in_image` of a rolling shutter, without the share."""
    time_u = number(lens, _TIME)
    time_v = number(lens, _TIME + 1)
    inverse = 1.0 / (1.0 - move_u * time_u - move_v * time_v)
    g00 = move_u * time_u * inverse + 1.0
    g01 = move_u * time_v * inverse
    g10 = move_v * time_u * inverse
    g11 = move_v * time_v * inverse + 1.0
    determinant = g00 * g11 - g01 * g10
    u0 = g00 * c11 + g01 * c12
    u1 = g00 * c12 + g01 * c22
    v0 = g10 * c11 + g11 * c12
    v1 = g10 * c12 + g11 * c22
    after = v0 * g10 + v1 * g11
    variance *= determinant * determinant * (c22 / after)
    return u0 * g00 + u1 * g01, u0 * g10 + u1 * g11, after, variance


@triton.jit
def _write_small(
    lens,
    pose,
    motion,
    factor,
    p,
    opacity,
    extent,
    record,
    mask,
    ROLLS: tl.constexpr,
    BENDS: tl.constexpr,
):
    """Write the ellipses of small Gaussians at ``p``; return which are drawn so, and their boxes."""
    place = p
    if ROLLS:
        time = _time_seen(p, pose, motion, lens, _BEYOND, BENDS)
        place, speed = _moved_at(p, pose, motion, lens, time)
    hx, hy, held, s = _place_on_sphere(lens, place)
    g = _polynomial(lens, _G, _DEGREE, held)
    u, v = _pixel(lens, hx, hy, held, g, BENDS)
    k0, k1, k2, k3 = _slopes(lens, hx, hy, held, g, BENDS)
    mask = mask & (s < number(lens, _S_MOST))
    row_u, row_v, n = _image_rows(place, k0, k1, k2, k3)
    if ROLLS:
        move_u = dot(row_u, speed)
        move_v = dot(row_v, speed)
        change = tl.abs(move_u * number(lens, _TIME)) + tl.abs(move_v * number(lens, _TIME + 1))
        mask = mask & (change <= _MOST_CHANGE)
        turn = vector32(pose, _TURN)
        # A row times a rotation is the row turned back.
        row_u = _turned(row_u, turn, -time)
        row_v = _turned(row_v, turn, -time)
    antialias = number(pose, _ANTIALIAS)
    eps = tl.where(antialias > 0, antialias, EPS2D_PX2)
    node_u = _in_node(pose, row_u)
    node_v = _in_node(pose, row_v)
    c11, c12, c22, variance, kept = _in_image(node_u, node_v, factor, eps)
    if ROLLS:
        c11, c12, c22, variance = _while_exposed(lens, move_u, move_v, c11, c12, c22, variance)
    l11 = 1.0 / tl.sqrt(variance)
    tl.store(record, u, mask)
    tl.store(record + 1, v, mask)
    tl.store(record + 2, l11, mask)
    tl.store(record + 3, -l11 * (c12 / c22), mask)
    tl.store(record + 4, 1.0 / tl.sqrt(c22), mask)
    tl.store(record + _INVERSE_O2, n * 0.0 - 1.0, mask)
    tl.store(record + _OPACITY, opacity * tl.where(antialias > 0, tl.sqrt(kept), 1.0), mask)
    tl.store(record + _DISTANCE_SEEN, n, mask)
    half_u = extent * tl.sqrt(c11) + number(lens, _MARGIN)
    half_v = extent * tl.sqrt(c22) + number(lens, _MARGIN)
    return mask, u - half_u, u + half_u, v - half_v, v + half_v


# Large Gaussians, evaluated along rays: see `lens_project_kernels`.


@triton.jit
def _covariance(pose, factor):
    """Return the six numbers of covariances in the camera's axes, float64."""
    f0 = as_f64(factor[0])
    f1 = as_f64(factor[1])
    f2 = as_f64(factor[2])
    x = combined(vector(pose, 0), f0, f1, f2)
    y = combined(vector(pose, 3), f0, f1, f2)
    z = combined(vector(pose, 6), f0, f1, f2)
    return dot(x, x), dot(x, y), dot(x, z), dot(y, y), dot(y, z), dot(z, z)


@triton.jit
def _times(s, a):
    """Return symmetric matrices times vectors."""
    return (
        s[0] * a[0] + s[1] * a[1] + s[2] * a[2],
        s[1] * a[0] + s[3] * a[1] + s[4] * a[2],
        s[2] * a[0] + s[4] * a[1] + s[5] * a[2],
    )


@triton.jit
def _with_square(s, a):
    """Return symmetric matrices plus ``a a^T``."""
    return (
        s[0] + a[0] * a[0],
        s[1] + a[0] * a[1],
        s[2] + a[0] * a[2],
        s[3] + a[1] * a[1],
        s[4] + a[1] * a[2],
        s[5] + a[2] * a[2],
    )


@triton.jit
def _kept_share(s, right, down, k0, k1, k2, k3, eps, n2):
    """Return the share of the determinants of the covariances in the image, without and with the
    low-pass.
    """
    sr = _times(s, right)
    sd = _times(s, down)
    rr = dot(sr, right)
    rd = dot(sr, down)
    dd = dot(sd, down)
    inverse = 1.0 / n2
    uu = inverse * (k0 * k0 * rr + 2.0 * k0 * k1 * rd + k1 * k1 * dd)
    vv = inverse * (k2 * k2 * rr + 2.0 * k2 * k3 * rd + k3 * k3 * dd)
    determinant = (k0 * k3 - k1 * k2) * inverse
    raw = tl.maximum(rr * dd - rd * rd, 0.0) * determinant * determinant
    return (raw / (raw + eps * (uu + vv) + eps * eps)).to(tl.float32)


@triton.jit
def _low_passed(s, p, n2, right, down, k0, k1, k2, k3, eps):
    """Return covariances with that of the pixel at the mean's place."""
    scale = tl.sqrt(n2 * eps) / (k0 * k3 - k1 * k2)
    m00 = k3 * scale
    m01 = -k1 * scale
    m10 = -k2 * scale
    m11 = k0 * scale
    s = _with_square(s, as_f64(added(scaled(right, m00), scaled(down, m10))))
    s = _with_square(s, as_f64(added(scaled(right, m01), scaled(down, m11))))
    size = tl.sqrt(0.5 * (m00 * m00 + m01 * m01 + m10 * m10 + m11 * m11) / n2)
    return _with_square(s, as_f64(scaled(p, size)))


@triton.jit
def _cholesky(s):
    """Return L of S = L L^T, six numbers row by row, and the inverses of its diagonal."""
    l11 = tl.sqrt(s[0])
    i1 = 1.0 / l11
    l21 = s[1] * i1
    l31 = s[2] * i1
    l22 = tl.sqrt(tl.maximum(s[3] - l21 * l21, 1e-14 * s[3]))
    i2 = 1.0 / l22
    l32 = (s[4] - l31 * l21) * i2
    l33 = tl.sqrt(tl.maximum(s[5] - l31 * l31 - l32 * l32, 1e-14 * s[5]))
    return (l11, l21, l22, l31, l32, l33), (i1, i2, 1.0 / l33)


@triton.jit
def _solved(lower, inverses, p):
    """Return L^-1 p."""
    x = p[0] * inverses[0]
    y = (p[1] - lower[1] * x) * inverses[1]
    return x, y, (p[2] - lower[3] * x - lower[4] * y) * inverses[2]


@triton.jit
def _row_solved(lower, inverses, q, k):
    """Return ``k q L^-1``."""
    z = q[2] * inverses[2]
    y = (q[1] - lower[4] * z) * inverses[1]
    return scaled(((q[0] - lower[1] * y - lower[3] * z) * inverses[0], y, z), k)


@triton.jit
def _spread(lower, q):
    """Return L q."""
    return (
        lower[0] * q[0],
        lower[1] * q[0] + lower[2] * q[1],
        lower[3] * q[0] + lower[4] * q[1] + lower[5] * q[2],
    )


@triton.jit
def _basis(w):
    """Return two unit vectors across unit vectors and each other."""
    sign = tl.where(w[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + w[2])
    b = w[0] * w[1] * a
    first = sign * w[0] * w[0] * a + 1.0, sign * b, -sign * w[0]
    return first, (b, w[1] * w[1] * a + sign, -w[1])


@triton.jit
def _box(
    lens, place, n, first, second, turn_rad, shift_m, ROLLS: tl.constexpr, BENDS: tl.constexpr
):
    """Return the boxes of the outlines ``place + cos first + sin second``, and which are to be looked
    for everywhere.
    """
    u, v, s = _shown(lens, place, BENDS)
    left = u
    right = u
    top = v
    bottom = v
    bend_u = u * 0.0
    bend_v = u * 0.0
    for _ in range(4):
        u1, v1, s1 = _shown(lens, added(place, first), BENDS)
        u2, v2, s2 = _shown(lens, added(place, scaled(first, -1.0)), BENDS)
        left = tl.minimum(left, tl.minimum(u1, u2))
        right = tl.maximum(right, tl.maximum(u1, u2))
        top = tl.minimum(top, tl.minimum(v1, v2))
        bottom = tl.maximum(bottom, tl.maximum(v1, v2))
        bend_u = tl.maximum(bend_u, tl.abs(0.5 * (u1 + u2) - u))
        bend_v = tl.maximum(bend_v, tl.abs(0.5 * (v1 + v2) - v))
        s = tl.maximum(s, tl.maximum(s1, s2))
        turned_first = scaled(added(first, second), _EIGHTH)
        second = scaled(added(second, scaled(first, -1.0)), _EIGHTH)
        first = turned_first
    more_u = bend_u + number(lens, _MARGIN)
    more_v = bend_v + number(lens, _MARGIN)
    everywhere = s >= number(lens, _S_MOST)
    if ROLLS:
        rate = tl.abs(number(lens, _TIME)) * (right - left)
        rate += tl.abs(number(lens, _TIME + 1)) * (bottom - top)
        late = rate * (shift_m / n + turn_rad) * (_LATE * number(lens, _MOST)) + 0.1
        more_u += late
        more_v += late
        everywhere = everywhere | (n < _NEAR_SHIFTS * shift_m)
    return left - more_u, right + more_u, top - more_v, bottom + more_v, everywhere


@triton.jit
def _store3(record, column, a, mask):
    tl.store(record + column, a[0].to(tl.float32), mask)
    tl.store(record + column + 1, a[1].to(tl.float32), mask)
    tl.store(record + column + 2, a[2].to(tl.float32), mask)


@triton.jit
def _write_large(
    lens,
    pose,
    motion,
    factor,
    p,
    n,
    opacity,
    extent,
    record,
    mask,
    ROLLS: tl.constexpr,
    BENDS: tl.constexpr,
):
    """Write the rows of Gaussians at ``p``, float64; return their boxes."""
    place = as_f32(p)
    if ROLLS:
        time = _time_seen(place, pose, motion, lens, 0.5, BENDS)
        place, _ = _moved_at(place, pose, motion, lens, time)
    at_n2 = dot(place, place)
    at_n = tl.sqrt(at_n2)
    hx, hy, held, _ = _place_on_sphere(lens, place)
    k0, k1, k2, k3 = _slopes(lens, hx, hy, held, _polynomial(lens, _G, _DEGREE, held), BENDS)
    right, down = _tangents(place, at_n)
    antialias = number(pose, _ANTIALIAS)
    eps = tl.where(antialias > 0, antialias, EPS2D_PX2)
    s = _covariance(pose, factor)
    kept = _kept_share(s, as_f64(right), as_f64(down), k0, k1, k2, k3, eps, at_n2.to(tl.float64))
    tl.store(record + _OPACITY, opacity * tl.where(antialias > 0, tl.sqrt(kept), 1.0), mask)
    tl.store(record + _DISTANCE_SEEN, at_n, mask)
    s = _low_passed(s, place, at_n2, right, down, k0, k1, k2, k3, eps)
    lower, inverses = _cholesky(s)
    w = _solved(lower, inverses, p)
    o2 = dot(w, w)
    o = tl.sqrt(o2)
    w = scaled(w, 1.0 / o)
    q1, q2 = _basis(w)
    _store3(record, _A, _row_solved(lower, inverses, q1, n), mask)
    _store3(record, _B, _row_solved(lower, inverses, q2, n), mask)
    _store3(record, _C, _row_solved(lower, inverses, w, n / o), mask)
    tl.store(record + _INVERSE_O2, (1.0 / o2).to(tl.float32), mask)
    ratio = extent * extent / o2
    out = _AROUND * extent / tl.sqrt(tl.maximum(1.0 - ratio, 1.0 - _CLOSE))
    first = as_f32(scaled(_spread(lower, q1), out))
    second = as_f32(scaled(_spread(lower, q2), out))
    n32 = n.to(tl.float32)
    turn_rad = number(pose, _MOVES_RAD)
    shift_m = number(pose, _MOVES_M)
    left, right_end, top, bottom, everywhere = _box(
        lens, place, n32, first, second, turn_rad, shift_m, ROLLS, BENDS
    )
    size2 = tl.maximum(dot(first, first), dot(second, second))
    everywhere = everywhere | (ratio >= _CLOSE) | (size2 > _WIDE * n32 * n32)
    if ROLLS:
        moved = _solved(lower, inverses, vector(pose, _MOVED))
        _store3(record, _ROW_S, (dot(moved, q1), dot(moved, q2), dot(moved, w) / o), mask)
        passing = _solved(lower, inverses, vector(pose, _SHIFT))
        nearer = o - 0.55 * tl.sqrt(dot(passing, passing))
        passed = nearer < tl.maximum(2.0 * extent, 0.5 * o)
        everywhere = everywhere | passed
        tl.store(record + _NODE, n32 * 0.0 + number(pose, _NODE_MOTION), mask)
        tl.store(record + _DISTANCE, n32, mask)
        tl.store(record + _PASSED, passed.to(tl.float32), mask)
    left = tl.where(everywhere, -_EVERY, left)
    right_end = tl.where(everywhere, _EVERY, right_end)
    top = tl.where(everywhere, -_EVERY, top)
    bottom = tl.where(everywhere, _EVERY, bottom)
    return left, right_end, top, bottom


@triton.jit
def _low_pass(lens, pose):
    """Return the standard deviation of a pixel's low-pass, radians, the largest in the image."""
    return tl.sqrt(tl.maximum(number(pose, _ANTIALIAS), EPS2D_PX2)) / number(lens, _LEAST)


@triton.jit
def _reach(lens, pose, factor, n, extent):
    """Return how far Gaussians at distances ``n`` are drawn from their means, metres."""
    size = tl.sqrt(
        dot(factor[0], factor[0]) + dot(factor[1], factor[1]) + dot(factor[2], factor[2])
    )
    moved = 0.5 * (n * number(pose, _MOVES_RAD) + number(pose, _MOVES_M))
    return extent * (1.5 * _low_pass(lens, pose) * n + size) + moved + _ROUNDING * n


@triton.jit
def _in_cone(lens, p, reach):
    """Return which points may lie no farther than ``reach`` outside the cone that the image shows."""
    across = tl.sqrt(p[0] * p[0] + p[1] * p[1])
    return across * number(lens, _COS) - p[2] * number(lens, _SIN) <= reach


@triton.jit
def project_lens(
    spans,
    poses,
    lenses,
    motion,
    means,
    factors,
    opacities,
    extents,
    sh_ptr,
    records,
    depths,
    boxes,
    counts,
    tiles_x,
    tiles_y,
    SIZE: tl.constexpr,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
    LENGTH: tl.constexpr,
    ROLLS: tl.constexpr,
    BENDS: tl.constexpr,
):
    """Project a block of Gaussians of one node through a lens: their records, depths, boxes of tiles and
    the counts of these, as `triton_kernels.project` does.

    ``poses`` has `LENS_POSE` float64 numbers a node, ``lenses`` those of `lens_rays.camera_lens` a
    view, and ``motion`` those of `lens_rays.node_motion` a node that turns. A record has ``LENGTH``
    numbers. ``ROLLS`` and ``BENDS`` say whether the shutter rolls, and whether the lens has tangential
    or thin prism terms.
    """
    block = tl.program_id(0)
    pose = poses + tl.load(spans + block * 4) * _POSE
    lane = tl.arange(0, BLOCK)
    present = lane < tl.load(spans + block * 4 + 2)
    i = (tl.load(spans + block * 4 + 1) + lane).to(tl.int64)
    view = tl.load(spans + block * 4 + 3)
    lens = lenses + view * _LENS_SIZE
    d = offsets(means, i, present, pose)
    p = dot(vector(pose, 0), d), dot(vector(pose, 3), d), dot(vector(pose, 6), d)
    n = tl.sqrt(dot(p, p))
    opacity = tl.load(opacities + i, present, 0.0)
    extent = tl.load(extents + i, present, 0.0)
    visible = present & (opacity >= ALPHA_MIN)
    visible = visible & (n >= tl.load(pose + _NEAR)) & (n <= tl.load(pose + _FAR))
    # What is not visible is computed as if it stood straight ahead.
    p = tl.where(visible, p[0], 0.0), tl.where(visible, p[1], 0.0), tl.where(visible, p[2], 1.0)
    n = tl.where(visible, n, 1.0)
    factor = factor_rows(factors, i, visible)
    p32 = as_f32(p)
    n32 = n.to(tl.float32)
    visible = visible & _in_cone(lens, p32, _reach(lens, pose, factor, n32, extent))
    slot = slots_of(block, BLOCK)
    record = records + slot * LENGTH
    small = visible & _is_small(lens, pose, factor, p32, n32)
    left = n32 * 0.0
    right = left
    top = left
    bottom = left
    if tl.max(small.to(tl.int32)) > 0:
        small, left, right, top, bottom = _write_small(
            lens, pose, motion, factor, p32, opacity, extent, record, small, ROLLS, BENDS
        )
    large = visible & ~small
    if tl.max(large.to(tl.int32)) > 0:
        far_left, far_right, far_top, far_bottom = _write_large(
            lens, pose, motion, factor, p, n, opacity, extent, record, large, ROLLS, BENDS
        )
        left = tl.where(large, far_left, left)
        right = tl.where(large, far_right, right)
        top = tl.where(large, far_top, top)
        bottom = tl.where(large, far_bottom, bottom)
    largest = tl.maximum(tl.maximum(tl.abs(p[0]), tl.abs(p[1])), tl.abs(p[2]))
    on_screen = store_tiles(
        left,
        right,
        top,
        bottom,
        visible,
        depths,
        boxes,
        counts,
        slot,
        largest.to(tl.float32),
        view * tiles_y,
        tiles_x,
        tiles_y,
        TILE,
    )
    store_colours(sh_ptr, i, d, record, on_screen, SIZE)


# Compositing: see `lens_raster_kernels`.


@triton.jit
def _still_q2(record, inverse_o2, d):
    """Return q^2 on rays from the camera's centre."""
    a = dot(vector(record, _A), d)
    b = dot(vector(record, _B), d)
    ahead = tl.maximum(dot(vector(record, _C), d), 0.0)
    across = tl.maximum(a * a + b * b, _TINY)
    return across / (ahead * ahead + across * inverse_o2)


@triton.jit
def _rolling_q2(record, inverse_o2, d, time, lens, motion):
    """Return q^2 on the rays of a rolling shutter."""
    row_a = vector(record, _A)
    row_b = vector(record, _B)
    row_c = vector(record, _C)
    s = scaled(vector(record, _ROW_S), time)
    node = tl.load(record + _NODE)
    if node >= 0:
        # The ray that meets a moving road user at the shutter's middle as this ray does at its time.
        motion += node.to(tl.int32) * _MOTION
        turn = vector32(motion, _MOTION_TURN)
        speed = vector32(motion, _MOTION_SPEED)
        centre = vector32(motion, _MOTION_CENTRE)
        start = scaled(added(vector32(lens, _LENS_SHIFT), scaled(speed, -1.0)), time)
        start = _turned(added(start, scaled(centre, -1.0)), turn, -time)
        start = added(start, centre)
        d = _turned(d, turn, -time)
        inverse_n = 1.0 / tl.load(record + _DISTANCE)
        s = (
            dot(row_a, start) * inverse_n,
            dot(row_b, start) * inverse_n,
            dot(row_c, start) * inverse_n,
        )
    a = dot(row_a, d)
    b = dot(row_b, d)
    c = dot(row_c, d)
    x = s[1] * c + (b - s[2] * b)
    y = s[0] * c + (a - s[2] * a)
    z = s[0] * b - s[1] * a
    most = x * x + y * y + inverse_o2 * (z * z)
    across = tl.maximum(a * a + b * b, _TINY) * inverse_o2
    # A ray that leads away is nearest at its start. Seen backwards the equation has a second zero.
    q2 = tl.where(c > 0.0, most / (c * c + across), 1.0 / inverse_o2)
    if tl.load(record + _PASSED) > 0:
        middle = 1.0 / tl.sqrt(inverse_o2)
        along = middle - s[2] * middle
        is_ahead = along * (c * middle) - s[1] * b - s[0] * a > 0.0
        at_start = s[0] * s[0] + s[1] * s[1] + along * along
        q2 = tl.where(is_ahead, most / (c * c + across), at_start)
    return q2


@triton.jit
def composite_lens(
    records,
    splats,
    starts,
    rays,
    lenses,
    motion,
    image,
    width,
    height,
    tiles_x,
    tiles_y,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
    LENGTH: tl.constexpr,
    ROLLS: tl.constexpr,
):
    """Blend a tile's splats along the rays of a lens, as `triton_kernels.composite` does; where the lens
    sees nothing all numbers are 0, which is black and opaque.

    ``rays`` holds the planes ``(RAY, H, W)`` of what the pixels look along.
    """
    tile = tl.program_id(0)
    tiles = tiles_x * tiles_y
    column, row = pixels_of(tile % tiles, tiles_x, TILE)
    view = tile // tiles
    lens = lenses + view * _LENS_SIZE
    image += view.to(tl.int64) * (height * width * 6)
    inside = (column < width) & (row < height)
    pixel = row * width + column
    size = height * width
    d = (
        tl.load(rays + pixel, inside, 0.0),
        tl.load(rays + size + pixel, inside, 0.0),
        tl.load(rays + 2 * size + pixel, inside, 0.0),
    )
    open_ = tl.load(rays + 3 * size + pixel, inside, 0.0) > 0
    px = column.to(tl.float32) + 0.5
    py = row.to(tl.float32) + 0.5
    time = px * 0.0
    if ROLLS:
        time = _time_of(lens, px, py, 0.5)
        d = _turned(d, vector32(lens, _LENS_TURN), time)
    transmittance = open_.to(tl.float32)
    red = tl.zeros((TILE, TILE), tl.float32)
    green = tl.zeros((TILE, TILE), tl.float32)
    blue = tl.zeros((TILE, TILE), tl.float32)
    depth = tl.zeros((TILE, TILE), tl.float32)
    last = tl.zeros((TILE, TILE), tl.int32)
    first = tl.load(starts + tile)
    begin = first
    end = tl.load(starts + tile + 1)
    while begin < end:
        stop = tl.minimum(begin + CHUNK, end)
        for k in range(begin, stop):
            record = records + tl.load(splats + k).to(tl.int64) * LENGTH
            inverse_o2 = tl.load(record + _INVERSE_O2)
            if inverse_o2 < 0:
                q2 = ellipse_q2(record, px, py)
            elif ROLLS:
                q2 = _rolling_q2(record, inverse_o2, d, time, lens, motion)
            else:
                q2 = _still_q2(record, inverse_o2, d)
            alpha = tl.load(record + _OPACITY) * tl.exp(-0.5 * q2)
            visible, weight, transmittance, open_ = layer(alpha, transmittance, open_)
            red += weight * tl.load(record + _RED)
            green += weight * tl.load(record + _RED + 1)
            blue += weight * tl.load(record + _RED + 2)
            depth += weight * tl.load(record + _DISTANCE_SEEN)
            last = tl.where(visible, k + 1 - first, last)
        begin = stop
        if tl.max(open_.to(tl.int32)) == 0:
            begin = end
    store_pixels(image + pixel * 6, (red, green, blue), depth, transmittance, last, inside)
