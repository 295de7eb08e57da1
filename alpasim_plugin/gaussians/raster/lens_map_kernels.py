"""Where a lens shows points, sixteen at a time, and how its image changes there: what the projections
of large and small Gaussians share. The form of a lens is that of `cameras.image_map`.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from alpasim_plugin.cameras.image_map import DEGREE
from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.lens_rays import (
    LENS_BENDS,
    LENS_G,
    LENS_LINEAR,
    LENS_MIDDLE,
    LENS_S_MOST,
    LENS_SLOPE,
    LENS_TIME,
    LENS_TURN,
    MOTION,
    MOTION_CENTRE,
    MOTION_TURN,
)
from alpasim_plugin.gaussians.raster.project_kernels import cross, dot, row

LEAST_SLOPE = 0.05  # of the pixels per radian along the radius to those across


@kernel
def scaled(a, k):
    """Return a vector of three times a number."""
    return a[0] * k, a[1] * k, a[2] * k


@kernel
def added(a, b):
    """Return the sum of two vectors of three."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@kernel
def _polynomial(lens, first, degree, s):
    x = v.fma(s, 2.0 / lens[LENS_S_MOST], -1.0)
    value = v.fma(x, lens[first + degree], lens[first + degree - 1])
    for k in range(degree - 2, -1, -1):
        value = v.fma(value, x, lens[first + k])
    return value


@kernel
def place_on_sphere(lens, p):
    """Return h of points, held to where the lens is described, its s and that before."""
    n = v.sqrt(dot(p, p))
    inverse = 1.0 / v.maximum(n + p[2], 1e-6 * n + 1e-30)
    hx = p[0] * inverse
    hy = p[1] * inverse
    s = v.fma(hx, hx, hy * hy)
    held = v.minimum(s, lens[LENS_S_MOST])
    shrink = v.sqrt(held / v.maximum(s, 1e-30))
    return (hx * shrink, hy * shrink), held, s


@kernel
def _bent(lens, x, y):
    """Return what the tangential and thin prism terms add at tangents x, y."""
    k = LENS_BENDS + 1
    r2 = v.fma(x, x, y * y)
    xy = x * y
    radial_x = r2 * v.fma(r2, lens[k + 3], lens[k + 2])
    radial_y = r2 * v.fma(r2, lens[k + 5], lens[k + 4])
    bent_x = radial_x + 2.0 * lens[k] * xy + lens[k + 1] * v.fma(2.0 * x, x, r2)
    bent_y = radial_y + lens[k] * v.fma(2.0 * y, y, r2) + 2.0 * lens[k + 1] * xy
    return bent_x, bent_y


@kernel
def shown(lens, p):
    """Return the pixels ``u, v`` at which a lens shows points, and their s."""
    h, held, s = place_on_sphere(lens, p)
    u, w = _pixel(lens, h, held, _polynomial(lens, LENS_G, DEGREE, held))
    return u, w, s


@kernel
def _pixel(lens, h, held, g):
    x = h[0] * g
    y = h[1] * g
    if lens[LENS_BENDS] > 0:
        k = 2.0 / (1.0 - held)
        bent_x, bent_y = _bent(lens, h[0] * k, h[1] * k)
        x = x + bent_x
        y = y + bent_y
    a = LENS_LINEAR
    u = v.fma(x, lens[a], v.fma(y, lens[a + 1], lens[LENS_MIDDLE]))
    w = v.fma(x, lens[a + 2], v.fma(y, lens[a + 3], lens[LENS_MIDDLE + 1]))
    return u, w


@kernel
def _times_bent(lens, h, held, j):
    """Return a Jacobian by h with that of the tangential and thin prism terms added."""
    k = LENS_BENDS + 1
    p1, p2 = lens[k], lens[k + 1]
    t = 2.0 / (1.0 - held)
    x = h[0] * t
    y = h[1] * t
    r2 = v.fma(x, x, y * y)
    fx = v.fma(r2, 4.0 * lens[k + 3], 2.0 * lens[k + 2])
    fy = v.fma(r2, 4.0 * lens[k + 5], 2.0 * lens[k + 4])
    xx = 2.0 * p1 * y + 6.0 * p2 * x + fx * x
    xy = 2.0 * p1 * x + 2.0 * p2 * y + fx * y
    yx = 2.0 * p1 * x + 2.0 * p2 * y + fy * x
    yy = 6.0 * p1 * y + 2.0 * p2 * x + fy * y
    # of the tangents by h: t I + t^2 h h^T
    d00 = v.fma(x, x, t)
    d01 = x * y
    d11 = v.fma(y, y, t)
    return (
        j[0] + xx * d00 + xy * d01,
        j[1] + xx * d01 + xy * d11,
        j[2] + yx * d00 + yy * d01,
        j[3] + yx * d01 + yy * d11,
    )


@kernel
def pixels_per_radian(lens, h, held):
    """Return the derivative of the pixel by the two tangents of `tangents`, row by row."""
    return _slopes(lens, h, held, _polynomial(lens, LENS_G, DEGREE, held))


@kernel
def shown_and_slopes(lens, h, held):
    """Return pixels as `shown`, and `pixels_per_radian`."""
    g = _polynomial(lens, LENS_G, DEGREE, held)
    return _pixel(lens, h, held, g), _slopes(lens, h, held, g)


@kernel
def _slopes(lens, h, held, g):
    slope = 2.0 * _polynomial(lens, LENS_SLOPE, DEGREE - 1, held)
    slope = v.maximum(slope, (LEAST_SLOPE - 1.0) * g / v.maximum(held, 1e-12))
    mixed = slope * h[0] * h[1]
    j = v.fma(slope * h[0], h[0], g), mixed, mixed, v.fma(slope * h[1], h[1], g)
    if lens[LENS_BENDS] > 0:
        j = _times_bent(lens, h, held, j)
    a = LENS_LINEAR
    k = v.fma(held, 0.5, 0.5)
    return (
        k * (lens[a] * j[0] + lens[a + 1] * j[2]),
        k * (lens[a] * j[1] + lens[a + 1] * j[3]),
        k * (lens[a + 2] * j[0] + lens[a + 3] * j[2]),
        k * (lens[a + 2] * j[1] + lens[a + 3] * j[3]),
    )


@kernel
def tangents(p, n):
    """Return two unit vectors across the directions of points, along h's axes."""
    inverse = 1.0 / v.maximum(n + p[2], 1e-7 * n)
    hx = p[0] * inverse
    hy = p[1] * inverse
    k = 2.0 / (v.fma(hx, hx, hy * hy) + 1.0)
    mixed = v.negative(k * hx * hy)
    right = v.fnma(k * hx, hx, 1.0), mixed, v.negative(k * hx)
    down = mixed, v.fnma(k * hy, hy, 1.0), v.negative(k * hy)
    return right, down


@kernel
def moved_at(p, moving, lens, time):
    """Return where points are in the camera's axes at times of the shutter, and by how much they
    move in one: they go evenly, the camera and a road user's box turn to second order.

    Args:
        p: At the middle.
        moving: By how much the camera moves in a shutter as the node sees it ``(3,)``, the place of
            the node's motion, -1: it does not turn; and all motions, see `lens_rays.node_motion`.
        lens: float64 ``(LENS_SIZE,)``.
        time: In shutters from the middle.
    """
    moved, node, motion = moving
    zero = p[0] * 0.0
    even = zero - moved[0], zero - moved[1], zero - moved[2]
    if node >= 0:
        centre = row(motion, node * MOTION + MOTION_CENTRE)
        from_centre = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
        even = added(even, cross(row(motion, node * MOTION + MOTION_TURN), from_centre))
    place = (
        v.fma(time, even[0], p[0]),
        v.fma(time, even[1], p[1]),
        v.fma(time, even[2], p[2]),
    )
    turn = row(lens, LENS_TURN)
    turned = cross(turn, place)
    speed = even[0] - turned[0], even[1] - turned[1], even[2] - turned[2]
    return turned_back(place, turn, time), turned_back(speed, turn, time)


@kernel
def turned_back(a, turn, time):
    """Return vectors turned by ``-time turn``, to second order."""
    first = cross(turn, a)
    second = cross(turn, first)
    half = 0.5 * time * time
    return (
        v.fma(half, second[0], v.fnma(time, first[0], a[0])),
        v.fma(half, second[1], v.fnma(time, first[1], a[1])),
        v.fma(half, second[2], v.fnma(time, first[2], a[2])),
    )


@kernel
def _time_after(lens, moving, p, time, most):
    """Return when the pixel is exposed in which points are shown that moved until a time."""
    place, _ = moved_at(p, moving, lens, time)
    u, w, _ = shown(lens, place)
    time = v.fma(u, lens[LENS_TIME], v.fma(w, lens[LENS_TIME + 1], lens[LENS_TIME + 2]))
    return v.minimum(v.maximum(time, -most), most)


@kernel
def time_seen(lens, moving, p, most):
    """Return when points are seen: at the time of the pixel that shows them then, held to ``most``
    shutters before and after the middle.

    The difference of both times is 0 there; the chord method finds it, which as many steps of
    putting one in for the other would miss by a part of a pixel.
    """
    first = _time_after(lens, moving, p, p[0] * 0.0, most)
    missed = _time_after(lens, moving, p, first, most) - first
    is_off = v.absolute(first) > 1e-3
    slope = (missed - first) / v.select(is_off, first, 1.0)
    slope = v.minimum(v.select(is_off, slope, -1.0), -0.5)
    time = first - missed / slope
    time = time - (_time_after(lens, moving, p, time, most) - time) / slope
    return v.minimum(v.maximum(time, -most), most)
