"""Project prepared Gaussians, sixteen at a time;
`alpasim_plugin.gaussians.raster.rasterize_reference` is the reference implementation.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import (
    ALPHA_MIN,
    BLOCK_REACH,
    CAM_CX,
    CAM_CY,
    CAM_FX,
    CAM_FY,
    CAM_HEIGHT,
    CAM_REACH,
    CAM_SLOPE_HIGH_X,
    CAM_SLOPE_HIGH_Y,
    CAM_SLOPE_LOW_X,
    CAM_SLOPE_LOW_Y,
    CAM_TIME_0,
    CAM_TIME_U,
    CAM_TIME_V,
    CAM_WIDTH,
    EPS2D_PX2,
    EXPONENT_SCALE,
    GEO_EXTENT,
    GEO_FACTOR,
    GEO_PEAK,
    GEO_SIZE,
    L11,
    L12,
    L22,
    PEAK,
    POSE_ANTIALIAS,
    POSE_CENTRE,
    POSE_FAR,
    POSE_NEAR,
    POSE_ROTATION,
    POSE_SHIFT,
    POSE_TURN,
    RADIUS_X,
    RADIUS_Y,
    RECORD,
    B,
    G,
    R,
    U,
    V,
    Z,
)
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.sh import C0, sh_terms

_sh_terms = kernel(sh_terms)
# Boxes and culls are grown by this: rounding must never cut a pixel that the alpha test would draw.
MARGIN_PX = 0.01
_CUT = (np.log2(ALPHA_MIN) + 4.0) / 8.0
BLOCK_HALF = 1.5
CHUNK = 16  # groups that a thread takes at once


# Three vectors of sixteen lanes, one per axis, are a tuple.


@kernel
def load3(array, offset):
    """Return three vectors that lie one after the other."""
    return v.load(array, offset), v.load(array, offset + 16), v.load(array, offset + 32)


@kernel
def row(pose, offset):
    """Return three numbers of a pose."""
    return pose[offset], pose[offset + 1], pose[offset + 2]


@kernel
def dot(a, b):
    """Return the dot product of sixteen vectors and sixteen others, or one that all share."""
    return v.fma(a[0], b[0], v.fma(a[1], b[1], a[2] * b[2]))


@kernel
def _jacobian_row(scale, slope, across, ahead):
    """Return a row of J R: ``scale (across - slope ahead)``."""
    return (
        scale * v.fnma(slope, ahead[0], across[0]),
        scale * v.fnma(slope, ahead[1], across[1]),
        scale * v.fnma(slope, ahead[2], across[2]),
    )


@kernel
def _times(row, rows):
    """Return a row times a matrix of three rows."""
    a, b, c = rows
    return (
        dot(row, (a[0], b[0], c[0])),
        dot(row, (a[1], b[1], c[1])),
        dot(row, (a[2], b[2], c[2])),
    )


@kernel
def _project_group(group, means, geometry, sh, sh_size, pose, camera, lanes):
    """Project sixteen Gaussians into ``lanes`` (RECORD columns of sixteen) and return the bit mask
    of those that reach the image.
    """
    x, y, z = load3(means, group * 48)
    dx = x - pose[POSE_CENTRE]
    dy = y - pose[POSE_CENTRE + 1]
    dz = z - pose[POSE_CENTRE + 2]
    r = POSE_ROTATION
    # Depth decides the order and is kept in float64 up to here; everything else tolerates float32
    # relative to the camera.
    z64 = pose[r + 6] * dx + pose[r + 7] * dy + pose[r + 8] * dz
    mask = (z64 >= pose[POSE_NEAR]) & (z64 <= pose[POSE_FAR])
    if v.bits(mask) == 0:
        return 0
    d = v.to_f32(dx), v.to_f32(dy), v.to_f32(dz)
    chosen = _project_shape(group, mask, d, v.to_f32(z64), geometry, pose, camera, lanes)
    if chosen != 0:
        colour_group(group, d, sh, sh_size, lanes)
    return chosen


@kernel
def cross(a, b):
    """Return the cross product, likewise."""
    return (
        v.fnma(a[2], b[1], a[1] * b[2]),
        v.fnma(a[0], b[2], a[2] * b[0]),
        v.fnma(a[1], b[0], a[0] * b[1]),
    )


@kernel
def _at_its_time(p, turn, shift, camera):
    """Return where points are, in camera axes, when the pixel that shows them is exposed.

    A point moves by ``turn x p + shift`` in a shutter, to second order; its time follows from its
    pixel, and its pixel from its time.
    """
    tx, ty, tz = cross(turn, p)
    first = tx + shift[0], ty + shift[1], tz + shift[2]
    cx, cy, cz = cross(turn, first)
    second = 0.5 * cx, 0.5 * cy, 0.5 * cz
    x, y, z = p
    for _ in range(3):
        inverse_z = 1.0 / v.maximum(z, 1e-3)
        u = v.fma(camera[CAM_FX], x * inverse_z, camera[CAM_CX])
        w = v.fma(camera[CAM_FY], y * inverse_z, camera[CAM_CY])
        time = v.fma(camera[CAM_TIME_U], u, camera[CAM_TIME_0])
        time = v.fma(camera[CAM_TIME_V], w, time)
        time = v.minimum(v.maximum(time, -0.5), 0.5)
        x = v.fma(time, v.fma(time, second[0], first[0]), p[0])
        y = v.fma(time, v.fma(time, second[1], first[1]), p[1])
        z = v.fma(time, v.fma(time, second[2], first[2]), p[2])
    return x, y, v.maximum(z, 1e-3)


@kernel
def _project_shape(group, mask, d, z, geometry, pose, camera, lanes):
    """Write the ellipses of Gaussians at ``d`` from the camera's centre; returns the bit mask of
    those that reach the image.
    """
    right = row(pose, POSE_ROTATION)
    down = row(pose, POSE_ROTATION + 3)
    ahead = row(pose, POSE_ROTATION + 6)
    fx = camera[CAM_FX]
    fy = camera[CAM_FY]
    x = dot(right, d)
    y = dot(down, d)
    if camera[CAM_REACH] > 0:
        x, y, z = _at_its_time((x, y, z), row(pose, POSE_TURN), row(pose, POSE_SHIFT), camera)
    inverse_z = 1.0 / z
    slope_x = x * inverse_z
    slope_y = y * inverse_z
    u = v.fma(fx, slope_x, camera[CAM_CX])
    w = v.fma(fy, slope_y, camera[CAM_CY])
    a = v.minimum(v.maximum(slope_x, camera[CAM_SLOPE_LOW_X]), camera[CAM_SLOPE_HIGH_X])
    b = v.minimum(v.maximum(slope_y, camera[CAM_SLOPE_LOW_Y]), camera[CAM_SLOPE_HIGH_Y])

    # Rows m, n of M = J R R_q diag(s).
    geo = group * (GEO_SIZE * 16)
    f = geo + GEO_FACTOR * 16
    factor = load3(geometry, f), load3(geometry, f + 48), load3(geometry, f + 96)
    m = _times(_jacobian_row(fx * inverse_z, a, right, ahead), factor)
    n = _times(_jacobian_row(fy * inverse_z, b, down, ahead), factor)
    mm = dot(m, m)
    nn = dot(n, n)
    mn = dot(m, n)
    antialias = pose[POSE_ANTIALIAS]
    eps = antialias if antialias > 0 else EPS2D_PX2
    c11 = mm + eps
    c22 = nn + eps
    extent = v.load(geometry, geo + GEO_EXTENT * 16)
    radius_x = extent * v.sqrt(c11)
    radius_y = extent * v.sqrt(c22)
    mask = mask & (u + radius_x + MARGIN_PX >= 0.5) & (w + radius_y + MARGIN_PX >= 0.5)
    mask = mask & (u - radius_x - MARGIN_PX <= camera[CAM_WIDTH] - 0.5)
    mask = mask & (w - radius_y - MARGIN_PX <= camera[CAM_HEIGHT] - 0.5)
    chosen = v.bits(mask)
    if chosen == 0:
        return 0

    # Variance of x given y, det / C22, from the Cauchy-Binet parts: scaled before squaring, so that
    # it neither cancels nor overflows.
    inverse_c22 = 1.0 / c22
    root = v.sqrt(inverse_c22)
    x01 = v.fnma(m[1], n[0], m[0] * n[1])
    x02 = v.fnma(m[2], n[0], m[0] * n[2])
    x12 = v.fnma(m[2], n[1], m[1] * n[2])
    minors = x01 * root, x02 * root, x12 * root
    raw_variance = dot(minors, minors)
    variance = raw_variance + eps * ((c11 + nn) * inverse_c22)
    deviation = v.sqrt(variance)
    l11 = EXPONENT_SCALE / deviation
    slope = mn * inverse_c22
    l12 = v.negative(l11 * slope)
    l22 = EXPONENT_SCALE * root
    peak = v.load(geometry, geo + GEO_PEAK * 16)
    if antialias > 0:
        # The share of the determinants: an opacity times its root, and so many octaves less.
        v.store(lanes, PEAK * 16, raw_variance / variance)
        for lane in range(PEAK * 16, PEAK * 16 + 16):
            lanes[lane] = np.log2(lanes[lane]) / 16
        peak = peak + v.load(lanes, PEAK * 16)
        chosen &= v.bits(peak >= _CUT)
    corner_s = BLOCK_HALF * (l11 + v.absolute(l12))
    corner_t = BLOCK_HALF * l22
    block_radius = (
        v.sqrt(peak - _CUT) + v.sqrt(v.fma(corner_s, corner_s, corner_t * corner_t)) + 1e-3
    )

    v.store(lanes, U * 16, u)
    v.store(lanes, V * 16, w)
    v.store(lanes, L11 * 16, l11)
    v.store(lanes, L12 * 16, l12)
    v.store(lanes, L22 * 16, l22)
    v.store(lanes, PEAK * 16, peak)
    v.store(lanes, Z * 16, z)
    v.store(lanes, RADIUS_X * 16, radius_x + MARGIN_PX)
    v.store(lanes, RADIUS_Y * 16, radius_y + MARGIN_PX)
    v.store(lanes, BLOCK_REACH * 16, block_radius * block_radius)
    return chosen


@kernel
def colour_group(group, d, sh, sh_size, lanes):
    """Write the colours of sixteen Gaussians at ``d`` from the camera's centre, clamped at 0
    below.
    """
    colour = group * sh_size * 48
    red, green, blue = load3(sh, colour)
    red = v.fma(red, C0, 0.5)
    green = v.fma(green, C0, 0.5)
    blue = v.fma(blue, C0, 0.5)
    if sh_size > 1:
        length = 1.0 / v.sqrt(dot(d, d))
        terms = _sh_terms(d[0] * length, d[1] * length, d[2] * length)
        for k in range(1, sh_size):
            r, g, b = load3(sh, colour + k * 48)
            red = v.fma(terms[k - 1], r, red)
            green = v.fma(terms[k - 1], g, green)
            blue = v.fma(terms[k - 1], b, blue)
    v.store(lanes, R * 16, v.maximum(red, 0.0))
    v.store(lanes, G * 16, v.maximum(green, 0.0))
    v.store(lanes, B * 16, v.maximum(blue, 0.0))


@kernel
def project_part(
    cursor,
    part,
    means,
    geometry,
    sh,
    sh_size,
    index,
    first_id,
    pose,
    camera,
    records,
    ids,
):
    """Project the Gaussians of one part and append those that reach the image; called by each
    thread, which takes bundles until none is left.

    Args:
        cursor: int64: the number of records written, then the next bundle of each part; shared by
            all threads.
        part: Which part this is.
        means: See `PreparedCloud`, also for the next ones.
        geometry: See above.
        sh: See above.
        sh_size: See above.
        index: See above.
        first_id: Added to a Gaussian's position in its cloud; makes identities unique and ordered
            by part.
        pose: float64 ``(POSE_SIZE,)``, see `constants`.
        camera: See `constants`.
        records: float32 output, RECORD per splat.
        ids: int64 output, one per splat.
    """
    lanes = np.empty(RECORD * 16, dtype=np.float32)
    groups = index.shape[0] // 16
    while True:
        first = v.fetch_add(cursor, part + 1, CHUNK)
        if first >= groups:
            return
        for group in range(first, min(first + CHUNK, groups)):
            chosen = _project_group(group, means, geometry, sh, sh_size, pose, camera, lanes)
            if chosen == 0:
                continue
            count = 0
            remaining = chosen
            while remaining != 0:
                remaining &= remaining - 1
                count += 1
            out = v.fetch_add(cursor, 0, count)
            while chosen != 0:
                lane = v.lowest_bit(chosen)
                chosen &= chosen - 1
                for field in range(RECORD):
                    records[out * RECORD + field] = lanes[field * 16 + lane]
                ids[out] = index[group * 16 + lane] + first_id
                out += 1
