"""Project small Gaussians through a lens, sixteen at a time, to ellipses of the lens's own image.

About its mean a lens's image changes evenly: within the outline of a small Gaussian by the slopes of the
lens at the mean, K pixels a radian. With the rows of T the two directions across the line of sight, its
covariance in the image is ``J S J^T + eps I``, J = K T / n: Zwicker et al., EWA Splatting (2002), for
another lens than a pinhole. What this misses is of the size of the outline in radians, by which the
caller chooses what is small.

While a shutter is open the pixel u of a point moves by j in a shutter, and the time of a pixel is that
of its place, with the gradient g: from ``du = J dx + j (g . du)`` follows that steps in the image are
those of an instant times ``I + j g^T / (1 - g . j)``.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import (
    BLOCK_REACH,
    EPS2D_PX2,
    EXPONENT_SCALE,
    GEO_EXTENT,
    GEO_FACTOR,
    GEO_PEAK,
    L11,
    L12,
    L22,
    POSE_ANTIALIAS,
    POSE_ROTATION,
    POSE_TURN,
    RADIUS_X,
    RADIUS_Y,
    U,
    V,
)
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.lens_map_kernels import (
    added,
    moved_at,
    place_on_sphere,
    scaled,
    shown_and_slopes,
    tangents,
    time_seen,
    turned_back,
)
from alpasim_plugin.gaussians.raster.lens_rays import (
    LENS_BEND,
    LENS_HEIGHT,
    LENS_MARGIN,
    LENS_MOST,
    LENS_ROLLS,
    LENS_S_MOST,
    LENS_SMALL,
    LENS_TIME,
    LENS_WIDTH,
)
from alpasim_plugin.gaussians.raster.lens_records import (
    BOTTOM,
    DEPTH,
    INVERSE_O2,
    LEFT,
    PEAK,
    RIGHT,
    TOP,
)
from alpasim_plugin.gaussians.raster.project_kernels import BLOCK_HALF, dot, load3, row
from alpasim_plugin.gaussians.raster.raster_kernels import CUT

WIDEST = 0.03  # radians: the most standard deviations across of a small Gaussian
# Shutters from the middle at which a mean may be seen. Beside the image the time of a row goes on to
# grow as it does from row to row inside.
BEYOND = 0.55
MOST_CHANGE = 0.25  # of a step in the image by what moves while it is exposed


@kernel
def _in_camera(pose, a):
    """Return a row times the rotation from a node to the camera."""
    return added(
        added(
            _numbers_times(row(pose, POSE_ROTATION), a[0]),
            _numbers_times(row(pose, POSE_ROTATION + 3), a[1]),
        ),
        _numbers_times(row(pose, POSE_ROTATION + 6), a[2]),
    )


@kernel
def _numbers_times(numbers, k):
    return numbers[0] * k, numbers[1] * k, numbers[2] * k


@kernel
def _image_at(lens, p):
    h, held, s = place_on_sphere(lens, p)
    pixel, slopes = shown_and_slopes(lens, h, held)
    return pixel, slopes, s


@kernel
def _rows(place, k):
    """Return the two rows of J in the camera's axes, and the distance."""
    n = v.sqrt(dot(place, place))
    right, down = tangents(place, n)
    inverse = 1.0 / n
    u = added(scaled(right, k[0] * inverse), scaled(down, k[1] * inverse))
    w = added(scaled(right, k[2] * inverse), scaled(down, k[3] * inverse))
    return u, w, n


@kernel
def _times_factor(a, factor):
    x, y, z = factor
    return (
        dot(a, (x[0], y[0], z[0])),
        dot(a, (x[1], y[1], z[1])),
        dot(a, (x[2], y[2], z[2])),
    )


@kernel
def is_small(lens, pose, geometry, geo, p, low_pass, moves):
    """Return which Gaussians an ellipse of the image shows closely enough.

    A point at q standard deviations is shown q^2 e beside where the slopes at the mean put it, in
    standard deviations: e is the share of the distance by which the Gaussian reaches along the line
    of sight, what the lens bends across it, and the share by which it nears or turns while its rows
    are exposed. So its opacity is off by at most 1.16 e.

    Args:
        lens, pose, geometry, geo: See `write_small`.
        p: Means in the camera's axes, float32.
        low_pass: That of a pixel, radians.
        moves: By how many radians and metres things move in a shutter.
    """
    f = geo + GEO_FACTOR * 16
    factor = load3(geometry, f), load3(geometry, f + 48), load3(geometry, f + 96)
    inverse = 1.0 / v.sqrt(dot(p, p))
    along = _times_factor(_in_camera(pose, scaled(p, inverse)), factor)
    along2 = dot(along, along)
    whole2 = dot(factor[0], factor[0]) + dot(factor[1], factor[1]) + dot(factor[2], factor[2])
    across = v.sqrt(v.maximum(whole2 - along2, 0.0)) * inverse
    shutters = (abs(lens[LENS_TIME]) + abs(lens[LENS_TIME + 1])) * lens[LENS_MOST]
    bend = v.fma(inverse, shutters * moves[1], lens[LENS_BEND] + shutters * moves[0])
    off = v.fma(across + low_pass, bend, v.sqrt(along2) * inverse)
    return (off <= lens[LENS_SMALL]) & (across <= WIDEST)


@kernel
def write_small(lanes, lens, pose, moving, geometry, geo, p, mask):
    """Write the ellipses of small Gaussians at ``p`` in the camera's axes, float32; ``moving`` as
    of `moved_at`.

    Returns:
        The bits of those that are drawn so, and of those of them that reach the image; what moves
        fast, or lies beyond where the lens is described, is not drawn so.
    """
    place, speed, time = p, p, p[0] * 0.0
    if lens[LENS_ROLLS] > 0:
        time = time_seen(lens, moving, p, BEYOND)
        place, speed = moved_at(p, moving, lens, time)
    centre, k, s = _image_at(lens, place)
    mask = mask & (s < lens[LENS_S_MOST])
    row_u, row_w, n = _rows(place, k)
    motion = time, time
    if lens[LENS_ROLLS] > 0:
        motion = dot(row_u, speed), dot(row_w, speed)
        mask = mask & (_share_exposed(lens, motion) <= MOST_CHANGE)
        turn = row(pose, POSE_TURN)
        # A row times a rotation is the row turned back.
        row_u = turned_back(row_u, turn, time)
        row_w = turned_back(row_w, turn, time)
    taken = v.bits(mask)
    if taken == 0:
        return 0, 0
    antialias = pose[POSE_ANTIALIAS]
    eps = antialias if antialias > 0 else EPS2D_PX2
    rows = _in_camera(pose, row_u), _in_camera(pose, row_w)
    covariance, variance, kept = _in_image(rows, geometry, geo + GEO_FACTOR * 16, eps)
    peak = v.load(geometry, geo + GEO_PEAK * 16)
    chosen = taken
    if antialias > 0:
        v.store(lanes, PEAK * 16, kept)
        for lane in range(PEAK * 16, PEAK * 16 + 16):
            lanes[lane] = np.log2(lanes[lane]) / 16
        peak = peak + v.load(lanes, PEAK * 16)
        chosen &= v.bits(peak >= CUT)
    if lens[LENS_ROLLS] > 0:
        covariance, variance = _while_exposed(lens, motion, covariance, variance)
    extent = v.load(geometry, geo + GEO_EXTENT * 16)
    chosen &= _write_ellipse(lanes, lens, centre, covariance, variance, peak, extent)
    v.store(lanes, INVERSE_O2 * 16, n * 0.0 - 1.0)
    v.store(lanes, PEAK * 16, peak)
    v.store(lanes, DEPTH * 16, n)
    return taken, chosen


@kernel
def _share_exposed(lens, motion):
    """Return by how many shutters the time of a pixel changes while what it shows moves for one."""
    by_u = v.absolute(motion[0]) * abs(lens[LENS_TIME])
    return v.fma(v.absolute(motion[1]), abs(lens[LENS_TIME + 1]), by_u)


@kernel
def _in_image(rows, geometry, first, eps):
    """Return covariances in the image at an instant, three numbers; their determinants over the
    last; and the share of that without the low-pass in it.

    As of a pinhole: from the determinant's Cauchy-Binet parts, scaled before they are squared.
    """
    factor = load3(geometry, first), load3(geometry, first + 48), load3(geometry, first + 96)
    m = _times_factor(rows[0], factor)
    n = _times_factor(rows[1], factor)
    nn = dot(n, n)
    c11 = dot(m, m) + eps
    c22 = nn + eps
    root = v.sqrt(1.0 / c22)
    minors = (
        v.fnma(m[1], n[0], m[0] * n[1]) * root,
        v.fnma(m[2], n[0], m[0] * n[2]) * root,
        v.fnma(m[2], n[1], m[1] * n[2]) * root,
    )
    raw = dot(minors, minors)
    variance = raw + eps * ((c11 + nn) / c22)
    return (c11, dot(m, n), c22), variance, raw / variance


@kernel
def _while_exposed(lens, motion, covariance, variance):
    """Return `_in_image` of a rolling shutter, without the share: see the equations above."""
    time_u, time_w = lens[LENS_TIME], lens[LENS_TIME + 1]
    c11, c12, c22 = covariance
    inverse = 1.0 / v.fnma(motion[0], time_u, v.fnma(motion[1], time_w, 1.0))
    g00 = v.fma(motion[0], time_u * inverse, 1.0)
    g01 = motion[0] * (time_w * inverse)
    g10 = motion[1] * (time_u * inverse)
    g11 = v.fma(motion[1], time_w * inverse, 1.0)
    determinant = g00 * g11 - g01 * g10
    to_u = g00 * c11 + g01 * c12, g00 * c12 + g01 * c22
    to_w = g10 * c11 + g11 * c12, g10 * c12 + g11 * c22
    after = (
        to_u[0] * g00 + to_u[1] * g01,
        to_u[0] * g10 + to_u[1] * g11,
        to_w[0] * g10 + to_w[1] * g11,
    )
    return after, variance * determinant * determinant * (c22 / after[2])


@kernel
def _write_ellipse(lanes, lens, centre, covariance, variance, peak, extent):
    """Write ellipses; returns the bits of those that are in the image.

    Args:
        centre: Pixels.
        covariance: Three numbers, square pixels.
        variance: Its determinant over the last.
        peak, extent: See `constants`.
    """
    u, w = centre
    c11, c12, c22 = covariance
    l11 = EXPONENT_SCALE / v.sqrt(variance)
    l12 = v.negative(l11 * (c12 / c22))
    l22 = EXPONENT_SCALE / v.sqrt(c22)
    margin = lens[LENS_MARGIN]
    radius_x = v.fma(extent, v.sqrt(c11), margin)
    radius_y = v.fma(extent, v.sqrt(c22), margin)
    corner_s = BLOCK_HALF * (l11 + v.absolute(l12))
    corner_t = BLOCK_HALF * l22
    corner = v.sqrt(v.fma(corner_s, corner_s, corner_t * corner_t))
    reach = v.sqrt(v.maximum(peak - CUT, 0.0)) + corner + 1e-3
    v.store(lanes, U * 16, u)
    v.store(lanes, V * 16, w)
    v.store(lanes, L11 * 16, l11)
    v.store(lanes, L12 * 16, l12)
    v.store(lanes, L22 * 16, l22)
    v.store(lanes, RADIUS_X * 16, radius_x)
    v.store(lanes, RADIUS_Y * 16, radius_y)
    v.store(lanes, BLOCK_REACH * 16, reach * reach)
    v.store(lanes, LEFT * 16, u - radius_x)
    v.store(lanes, RIGHT * 16, u + radius_x)
    v.store(lanes, TOP * 16, w - radius_y)
    v.store(lanes, BOTTOM * 16, w + radius_y)
    in_columns = (u + radius_x >= 0.5) & (u - radius_x <= lens[LENS_WIDTH] - 0.5)
    in_rows = (w + radius_y >= 0.5) & (w - radius_y <= lens[LENS_HEIGHT] - 0.5)
    return v.bits(in_columns & in_rows)
