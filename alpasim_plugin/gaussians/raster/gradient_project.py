"""Pack training parameters for projection and take the gradients of splats back to them.

The backward pass repeats the projection in float64 (`rasterize_reference.project_gaussians` is the
readable form of the forward pass). With rows ``m, n`` of ``M = J R_camera R_q diag(s)``, ``W`` the
upper triangular whitening of the screen covariance ``C = M M^T + 0.3 I`` (``W^T W = C^-1``) and
moments of ``h = alpha dL/dalpha`` over whitened coordinates ``w``: ``dL/d(u, v) = W^T sum h w`` and
``dL/dM = W^T (sum h w w^T) W M``. ``W M`` has entries of at most 1, so that needles of thousands of
pixels lose nothing.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import math

import numpy as np

from alpasim_plugin.core.kernels import float_kernel
from alpasim_plugin.gaussians.constants import (
    ALPHA_MIN,
    CAM_FX,
    CAM_FY,
    CAM_SLOPE_HIGH_X,
    CAM_SLOPE_HIGH_Y,
    CAM_SLOPE_LOW_X,
    CAM_SLOPE_LOW_Y,
    EPS2D_PX2,
    EXPONENT_SCALE,
    EXTENT_MAX_SIGMA,
    GEO_EXTENT,
    GEO_FACTOR,
    GEO_PEAK,
    GEO_REACH,
    GEO_SIZE,
    LOG_SCALE_LIMIT,
    POSE_CENTRE,
    POSE_ROTATION,
    RECORD,
    R,
)
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.gradient_kernels import (
    PAIR,
    PAIR_B,
    PAIR_G,
    PAIR_H,
    PAIR_R,
    PAIR_S,
    PAIR_SS,
    PAIR_ST,
    PAIR_T,
    PAIR_TT,
    PAIR_Z,
    basis_gradient,
    write_basis,
)

_f = np.float32


# Small vectors and matrices are tuples (of rows) with constant indices: they live in registers.


@float_kernel
def _dot(a, b):
    """Return the inner product of two 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@float_kernel
def _times(matrix, b):
    """Return a 3 x 3 matrix times a column."""
    return _dot(matrix[0], b), _dot(matrix[1], b), _dot(matrix[2], b)


@float_kernel
def _transposed(matrix):
    """Return a 3 x 3 matrix with rows and columns swapped."""
    p, q, r = matrix
    return (p[0], q[0], r[0]), (p[1], q[1], r[1]), (p[2], q[2], r[2])


@float_kernel
def _scaled(a, factor):
    """Return a 3-vector times a number."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@float_kernel
def _less(a, share, b):
    """Return ``a - share b`` of 3-vectors."""
    return a[0] - share * b[0], a[1] - share * b[1], a[2] - share * b[2]


@float_kernel
def _two_products(p, a, q, b):
    """Return ``p a + q b`` of two numbers and two 3-vectors."""
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


@float_kernel
def _unit_quaternion(quaternions, i):
    """Return row i as w, x, y, z of length one, and one over its length, float64."""
    w = np.float64(quaternions[i, 0])
    x = np.float64(quaternions[i, 1])
    y = np.float64(quaternions[i, 2])
    z = np.float64(quaternions[i, 3])
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse


@float_kernel
def _rotation(q):
    """Return the rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@float_kernel
def pack(means, log_scales, quaternions, logits, lane_means, geometry):
    """Write parameters into the lanes that `project_kernels.project_node` reads; Gaussians below
    the alpha cut get means of NaN.

    Returns:
        The first Gaussian that cannot be drawn (a number not finite, a quaternion of length zero, a
        scale beyond ``exp(20)`` m), or -1.
    """
    n = means.shape[0]
    lane_means[:] = np.nan
    bad = -1
    for i in range(n):
        q, inverse_length = _unit_quaternion(quaternions, i)
        largest = max(log_scales[i, 0], max(log_scales[i, 1], log_scales[i, 2]))
        finite = means[i, 0] + means[i, 1] + means[i, 2] + inverse_length + logits[i]
        finite += log_scales[i, 0] + log_scales[i, 1] + log_scales[i, 2]
        # A quaternion of length zero has an infinite inverse, one that is not finite an inverse of
        # zero or NaN.
        if not (math.isfinite(finite) and inverse_length > 0.0 and largest <= LOG_SCALE_LIMIT):
            if bad < 0:
                bad = i
            continue
        opacity = 1.0 / (1.0 + math.exp(-np.float64(logits[i])))
        if opacity < ALPHA_MIN:
            continue
        group, lane = i // 16, i % 16
        for axis in range(3):
            lane_means[group * 48 + axis * 16 + lane] = means[i, axis]
        at = group * (GEO_SIZE * 16) + lane
        s0 = math.exp(np.float64(log_scales[i, 0]))
        s1 = math.exp(np.float64(log_scales[i, 1]))
        s2 = math.exp(np.float64(log_scales[i, 2]))
        p, q, r = _rotation(q)
        f = at + GEO_FACTOR * 16
        geometry[f], geometry[f + 16], geometry[f + 32] = p[0] * s0, p[1] * s1, p[2] * s2
        geometry[f + 48], geometry[f + 64], geometry[f + 80] = q[0] * s0, q[1] * s1, q[2] * s2
        geometry[f + 96], geometry[f + 112], geometry[f + 128] = r[0] * s0, r[1] * s1, r[2] * s2
        geometry[at + GEO_PEAK * 16] = (math.log2(opacity) + 4.0) / 8.0
        geometry[at + GEO_EXTENT * 16] = min(
            EXTENT_MAX_SIGMA, math.sqrt(2.0 * math.log(opacity / ALPHA_MIN))
        )
        geometry[at + GEO_REACH * 16] = max(s0, max(s1, s2))
    return bad


@float_kernel
def sum_pairs(cursor, chunk_size, gaussian, starts, lists, pairs, records, sums):
    """Add up the pairs of each visible splat; called by each thread. The order, tile by tile, never
    depends on threads.

    Args:
        cursor: int64 ``(1,)``, the next chunk; shared by all threads.
        chunk_size: Splats taken at once.
        gaussian: int64 ``(M,)``, which Gaussian a rank shows.
        starts: See `binning.tile_offsets`.
        lists: Ranks per tile.
        pairs: From `gradient_kernels.tile_gradients`.
        records: Splats in the order of depth; where a colour is 0 its clamp ends the gradient.
        sums: float32 output, PAIR per Gaussian; rows of Gaussians that are not visible stay as they
            are.
    """
    chunk = np.empty(chunk_size * PAIR)
    while True:
        first = v.fetch_add(cursor, 0, 1) * chunk_size
        if first >= gaussian.shape[0]:
            return
        end = min(first + chunk_size, gaussian.shape[0])
        chunk[:] = 0.0
        for tile in range(starts.shape[0] - 1):
            low, high = starts[tile], starts[tile + 1]
            while low < high:  # ranks ascend within a tile
                middle = (low + high) // 2
                if lists[middle] < first:
                    low = middle + 1
                else:
                    high = middle
            while low < starts[tile + 1] and lists[low] < end:
                at = (lists[low] - first) * PAIR
                for k in range(PAIR):
                    chunk[at + k] += pairs[low * PAIR + k]
                low += 1
        for rank in range(first, end):
            at, out = (rank - first) * PAIR, gaussian[rank] * PAIR
            for k in range(PAIR):
                sums[out + k] = chunk[at + k]
            for channel in range(3):
                if not records[rank * RECORD + R + channel] > _f(0.0):
                    sums[out + PAIR_R + channel] = _f(0.0)


@float_kernel
def _shape_gradient(m, n, sums, at):
    """Return the gradients of (u, v), of row m and of row n from the moments of h."""
    mm = _dot(m, m)
    nn = _dot(n, n)
    mn = _dot(m, n)
    c22 = nn + EPS2D_PX2
    x01 = m[0] * n[1] - m[1] * n[0]
    x02 = m[0] * n[2] - m[2] * n[0]
    x12 = m[1] * n[2] - m[2] * n[1]
    det = x01 * x01 + x02 * x02 + x12 * x12 + EPS2D_PX2 * (mm + c22)
    # The moments are over s and t, which are the whitened coordinates times EXPONENT_SCALE.
    w11, w22 = math.sqrt(c22 / det) / EXPONENT_SCALE, 1.0 / (math.sqrt(c22) * EXPONENT_SCALE)
    w12 = -w11 * mn / c22
    du, dv = w11 * sums[at + PAIR_S], w12 * sums[at + PAIR_S] + w22 * sums[at + PAIR_T]
    h_ss = sums[at + PAIR_SS]
    h_st = sums[at + PAIR_ST]
    h_tt = sums[at + PAIR_TT]
    # W M, then (sum h w w^T) W M, then W^T on the left; each w above holds one factor 1 /
    # EXPONENT_SCALE.
    s, t = _two_products(w11, m, w12, n), _scaled(n, w22)
    a, b = _two_products(h_ss, s, h_st, t), _two_products(h_st, s, h_tt, t)
    return du, dv, _scaled(a, w11), _two_products(w12, a, w22, b)


@float_kernel
def _quaternion_gradient(q, inverse_length, d):
    """Return the gradient of a quaternion from that of the rotation matrix of its unit form."""
    w, x, y, z = q
    (d00, d01, d02), (d10, d11, d12), (d20, d21, d22) = d
    gw = 2 * (x * (d21 - d12) + y * (d02 - d20) + z * (d10 - d01))
    gx = 2 * (y * (d01 + d10) + z * (d02 + d20) + w * (d21 - d12) - 2 * x * (d11 + d22))
    gy = 2 * (x * (d01 + d10) + z * (d12 + d21) + w * (d02 - d20) - 2 * y * (d00 + d22))
    gz = 2 * (x * (d02 + d20) + y * (d12 + d21) + w * (d10 - d01) - 2 * z * (d00 + d11))
    radial = gw * w + gx * x + gy * y + gz * z  # the length does not matter, so its share goes
    return (
        (gw - radial * w) * inverse_length,
        (gx - radial * x) * inverse_length,
        (gy - radial * y) * inverse_length,
        (gz - radial * z) * inverse_length,
    )


@float_kernel
def _colour_gradient(i, size, direction, red, green, blue, sh, g_sh, basis, weights):
    """Write the gradient of a Gaussian's coefficients and return that of its unit view
    direction.
    """
    write_basis(basis, size, direction[0], direction[1], direction[2])
    for k in range(size):
        g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = (
            basis[k] * red,
            basis[k] * green,
            basis[k] * blue,
        )
        weights[k] = red * sh[i, k, 0] + green * sh[i, k, 1] + blue * sh[i, k, 2]
    return basis_gradient(weights, size, direction[0], direction[1], direction[2])


@float_kernel
def splat_gradients(
    cursor,
    chunk_size,
    radii,
    sums,
    pose,
    camera,
    means,
    log_scales,
    quaternions,
    logits,
    sh,
    g_means,
    g_log_scales,
    g_quaternions,
    g_logits,
    g_sh,
    screen,
):
    """Write the gradients of visible Gaussians, in their own order (memory decides the speed);
    called by each thread.

    Args:
        cursor: int64 ``(1,)``, the next chunk; shared by all threads.
        chunk_size: Gaussians taken at once.
        radii: int32 ``(N,)``, 0 where a Gaussian is not visible.
        sums: From `sum_pairs`.
        pose: See layout; the node is the world.
        camera: See layout.
        means: float64 ``(N, 3)``, metres, world.
        log_scales: float32 ``(N, 3)``.
        quaternions: float32 ``(N, 4)``, wxyz, any length but zero.
        logits: float32 ``(N,)``, opacities before the logistic function.
        sh: float32 ``(N, K, 3)``.
        g_means: float64 output, likewise for the other ``g_``, float32; all zero at the start.
        g_log_scales: See above.
        g_quaternions: See above.
        g_logits: See above.
        g_sh: See above.
        screen: float32 output ``(N,)``, length of the gradient of the mean in pixels; zero at the
            start.
    """
    basis, weights = np.empty(16), np.empty(16)
    size = sh.shape[1]
    r = POSE_ROTATION
    right = (pose[r], pose[r + 1], pose[r + 2])
    down = (pose[r + 3], pose[r + 4], pose[r + 5])
    ahead = (pose[r + 6], pose[r + 7], pose[r + 8])
    fx, fy = np.float64(camera[CAM_FX]), np.float64(camera[CAM_FY])
    while True:
        first = v.fetch_add(cursor, 0, 1) * chunk_size
        if first >= radii.shape[0]:
            return
        for i in range(first, min(first + chunk_size, radii.shape[0])):
            if radii[i] == 0:
                continue
            at = i * PAIR
            p = (
                means[i, 0] - pose[POSE_CENTRE],
                means[i, 1] - pose[POSE_CENTRE + 1],
                means[i, 2] - pose[POSE_CENTRE + 2],
            )
            inverse_z = 1.0 / _dot(ahead, p)
            slope_x, slope_y = _dot(right, p) * inverse_z, _dot(down, p) * inverse_z
            a = min(
                max(slope_x, np.float64(camera[CAM_SLOPE_LOW_X])),
                np.float64(camera[CAM_SLOPE_HIGH_X]),
            )
            b = min(
                max(slope_y, np.float64(camera[CAM_SLOPE_LOW_Y])),
                np.float64(camera[CAM_SLOPE_HIGH_Y]),
            )
            scale_x, scale_y = fx * inverse_z, fy * inverse_z
            j, k = _scaled(_less(right, a, ahead), scale_x), _scaled(_less(down, b, ahead), scale_y)
            q, inverse_length = _unit_quaternion(quaternions, i)
            rotation = _rotation(q)
            s = (
                math.exp(np.float64(log_scales[i, 0])),
                math.exp(np.float64(log_scales[i, 1])),
                math.exp(np.float64(log_scales[i, 2])),
            )
            # Columns of R_q diag(s), then the rows m, n of M.
            x, y, z = _transposed(rotation)
            x = _scaled(x, s[0])
            y = _scaled(y, s[1])
            z = _scaled(z, s[2])
            columns = (x, y, z)
            du, dv, dm, dn = _shape_gradient(_times(columns, j), _times(columns, k), sums, at)
            screen[i] = math.sqrt(du * du + dv * dv)
            g_logits[i] = sums[at + PAIR_H] / (1.0 + math.exp(np.float64(logits[i])))

            # M = (J R_camera) (R_q diag s): the gradient of the second factor by columns, then that
            # of the rows j, k of the first.
            d0 = _two_products(dm[0], j, dn[0], k)
            d1 = _two_products(dm[1], j, dn[1], k)
            d2 = _two_products(dm[2], j, dn[2], k)
            g_log_scales[i, 0], g_log_scales[i, 1], g_log_scales[i, 2] = (
                _dot(x, d0),
                _dot(y, d1),
                _dot(z, d2),
            )
            turned = _transposed((_scaled(d0, s[0]), _scaled(d1, s[1]), _scaled(d2, s[2])))
            gw, gx, gy, gz = _quaternion_gradient(q, inverse_length, turned)
            g_quaternions[i, 0], g_quaternions[i, 1], g_quaternions[i, 2], g_quaternions[i, 3] = (
                gw,
                gx,
                gy,
                gz,
            )
            rows = _transposed(columns)
            dj, dk = _times(rows, dm), _times(rows, dn)

            # Depth: its own sum, the 1/z of J, and the slopes; a clamped slope passes nothing on.
            d_slope_x, d_slope_y = fx * du, fy * dv
            if a == slope_x:
                d_slope_x -= scale_x * _dot(dj, ahead)
            if b == slope_y:
                d_slope_y -= scale_y * _dot(dk, ahead)
            dx, dy = d_slope_x * inverse_z, d_slope_y * inverse_z
            dz = (
                sums[at + PAIR_Z]
                - (_dot(dj, j) + _dot(dk, k)) * inverse_z
                - dx * slope_x
                - dy * slope_y
            )

            inverse_distance = 1.0 / math.sqrt(_dot(p, p))
            direction = _scaled(p, inverse_distance)
            red = sums[at + PAIR_R]
            green = sums[at + PAIR_G]
            blue = sums[at + PAIR_B]
            e = _colour_gradient(i, size, direction, red, green, blue, sh, g_sh, basis, weights)
            e = _scaled(_less(e, _dot(e, direction), direction), inverse_distance)
            g_means[i, 0] = right[0] * dx + down[0] * dy + ahead[0] * dz + e[0]
            g_means[i, 1] = right[1] * dx + down[1] * dy + ahead[1] * dz + e[1]
            g_means[i, 2] = right[2] * dx + down[2] * dy + ahead[2] * dz + e[2]
