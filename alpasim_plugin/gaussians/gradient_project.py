"""Pack training parameters for projection and take the gradients of splats back to them.

The backward pass repeats the projection in float64 (`alpasim_plugin.gaussians.project` is its readable forward twin). With rows ``m, n`` of
``M = J R_camera R_q diag(s)``, ``W`` the upper triangular whitening of the screen covariance ``C = M M^T + 0.3 I`` (``W^T W = C^-1``) and
moments of ``h = alpha dL/dalpha`` over whitened coordinates ``w``: ``dL/d(u, v) = W^T sum h w`` and ``dL/dM = W^T (sum h w w^T) W M``.
``W M`` has entries of at most 1, so that needles of thousands of pixels lose nothing.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import math

import numpy as np
from numba import njit

from alpasim_plugin.gaussians import simd as v
from alpasim_plugin.gaussians.constants import ALPHA_MIN, EPS2D_PX2, EXTENT_MAX_SIGMA, LOG_SCALE_LIMIT
from alpasim_plugin.gaussians.gradient_colour import basis_gradient, write_basis
from alpasim_plugin.gaussians.gradient_kernels import (
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
)
from alpasim_plugin.gaussians.layout import (
    CAM_FX,
    CAM_FY,
    CAM_SLOPE_HIGH_X,
    CAM_SLOPE_HIGH_Y,
    CAM_SLOPE_LOW_X,
    CAM_SLOPE_LOW_Y,
    EXPONENT_SCALE,
    GEO_EXTENT,
    GEO_FACTOR,
    GEO_PEAK,
    GEO_REACH,
    GEO_SIZE,
    POSE_CENTRE,
    POSE_ROTATION,
    RECORD,
    B,
    G,
    R,
)

_f = np.float32


@njit(cache=True, nogil=True)
def _rotation(w, x, y, z):
    """Return the rotation matrix of a unit quaternion, row by row."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@njit(cache=True, nogil=True)
def pack(means, log_scales, quaternions, logits, lane_means, geometry):
    """Write parameters into the lanes that `project_kernels.project_node` reads; Gaussians below the alpha cut get means of NaN.

    Returns:
        The first Gaussian that cannot be drawn (a number not finite, a quaternion of length zero, a scale beyond ``exp(20)`` m), or -1.
    """
    n = means.shape[0]
    lane_means[:] = np.nan
    bad = -1
    for i in range(n):
        w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        length = math.sqrt(np.float64(w) * w + np.float64(x) * x + np.float64(y) * y + np.float64(z) * z)
        finite = means[i, 0] + means[i, 1] + means[i, 2] + length + logits[i]
        largest = max(log_scales[i, 0], max(log_scales[i, 1], log_scales[i, 2]))
        finite += log_scales[i, 0] + log_scales[i, 1] + log_scales[i, 2]
        if not (math.isfinite(finite) and length > 0.0 and largest <= LOG_SCALE_LIMIT):
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
        rotation = _rotation(w / length, x / length, y / length, z / length)
        for column in range(3):
            scale = math.exp(np.float64(log_scales[i, column]))
            for row in range(3):
                geometry[at + (GEO_FACTOR + row * 3 + column) * 16] = rotation[row][column] * scale
        geometry[at + GEO_PEAK * 16] = (math.log2(opacity) + 4.0) / 8.0
        geometry[at + GEO_EXTENT * 16] = min(EXTENT_MAX_SIGMA, math.sqrt(2.0 * math.log(opacity / ALPHA_MIN)))
        geometry[at + GEO_REACH * 16] = math.exp(np.float64(largest))
    return bad


@njit(cache=True, nogil=True)
def _sum_pairs(first, end, starts, lists, pairs, sums):
    """Add up the rows of ``pairs`` of ranks ``first`` to ``end`` over all tiles, tile by tile: the order never depends on threads."""
    sums[:] = 0.0
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
                sums[at + k] += pairs[low * PAIR + k]
            low += 1


@njit(cache=True, nogil=True)
def _shape_gradient(m, n, whitened, h_s, h_t, h_ss, h_st, h_tt):
    """Return the gradients of (u, v), of row m and of row n from the moments of h."""
    l11, l12, l22 = whitened
    # W M and then (sum h w w^T) W M.
    s0, s1, s2 = l11 * m[0] + l12 * n[0], l11 * m[1] + l12 * n[1], l11 * m[2] + l12 * n[2]
    t0, t1, t2 = l22 * n[0], l22 * n[1], l22 * n[2]
    a0, a1, a2 = h_ss * s0 + h_st * t0, h_ss * s1 + h_st * t1, h_ss * s2 + h_st * t2
    b0, b1, b2 = h_st * s0 + h_tt * t0, h_st * s1 + h_tt * t1, h_st * s2 + h_tt * t2
    uv = (l11 * h_s, l12 * h_s + l22 * h_t)
    return uv, (l11 * a0, l11 * a1, l11 * a2), (l12 * a0 + l22 * b0, l12 * a1 + l22 * b1, l12 * a2 + l22 * b2)


@njit(cache=True, nogil=True)
def _quaternion_gradient(w, x, y, z, d):
    """Return the gradient of a unit quaternion from that of its rotation matrix, ``(3, 3)``."""
    return (
        2 * (x * (d[2, 1] - d[1, 2]) + y * (d[0, 2] - d[2, 0]) + z * (d[1, 0] - d[0, 1])),
        2 * (y * (d[0, 1] + d[1, 0]) + z * (d[0, 2] + d[2, 0]) + w * (d[2, 1] - d[1, 2]) - 2 * x * (d[1, 1] + d[2, 2])),
        2 * (x * (d[0, 1] + d[1, 0]) + z * (d[1, 2] + d[2, 1]) + w * (d[0, 2] - d[2, 0]) - 2 * y * (d[0, 0] + d[2, 2])),
        2 * (x * (d[0, 2] + d[2, 0]) + y * (d[1, 2] + d[2, 1]) + w * (d[1, 0] - d[0, 1]) - 2 * z * (d[0, 0] + d[1, 1])),
    )


@njit(cache=True, nogil=True)
def _colour_gradient(i, size, direction, red, green, blue, sh, g_sh, basis, weights):
    """Write the gradient of a Gaussian's coefficients and return that of its unit view direction."""
    write_basis(basis, size, direction[0], direction[1], direction[2])
    for k in range(size):
        g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = basis[k] * red, basis[k] * green, basis[k] * blue
        weights[k] = red * sh[i, k, 0] + green * sh[i, k, 1] + blue * sh[i, k, 2]
    return basis_gradient(weights, size, direction[0], direction[1], direction[2])


@njit(cache=True, nogil=True)
def splat_gradients(
    cursor, chunk_size, gaussian, starts, lists, pairs, records, pose, camera, means, log_scales, quaternions, logits, sh,
    g_means, g_log_scales, g_quaternions, g_logits, g_sh, screen,
):  # fmt: skip
    """Sum the pairs of each visible splat and write the gradients of its Gaussian; called by each thread.

    Args:
        cursor: int64 ``(1,)``, the next chunk; shared by all threads.
        chunk_size: Splats taken at once.
        gaussian: int64 ``(M,)``, which Gaussian a rank shows.
        starts: See `binning.tile_offsets`.
        lists: Ranks per tile.
        pairs: From `gradient_kernels.tile_gradients`.
        records: Splats in the order of depth; where a colour is 0 its clamp ended the gradient.
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
        screen: float32 output ``(N,)``, length of the gradient of the mean in pixels; zero at the start.
    """
    sums = np.empty(chunk_size * PAIR)
    basis, weights, d_rotation = np.empty(16), np.empty(16), np.empty((3, 3))
    r = pose[POSE_ROTATION : POSE_ROTATION + 9]
    fx, fy = np.float64(camera[CAM_FX]), np.float64(camera[CAM_FY])
    d_factor, factor = np.empty((3, 3)), np.empty((3, 3))
    scale = np.empty(3)
    while True:
        first = v.fetch_add(cursor, 0, 1) * chunk_size
        if first >= gaussian.shape[0]:
            return
        end = min(first + chunk_size, gaussian.shape[0])
        _sum_pairs(first, end, starts, lists, pairs, sums)
        for rank in range(first, end):
            i = gaussian[rank]
            at = (rank - first) * PAIR
            px, py, pz = means[i, 0] - pose[POSE_CENTRE], means[i, 1] - pose[POSE_CENTRE + 1], means[i, 2] - pose[POSE_CENTRE + 2]
            z = r[6] * px + r[7] * py + r[8] * pz
            inverse_z = 1.0 / z
            slope_x, slope_y = (r[0] * px + r[1] * py + r[2] * pz) * inverse_z, (r[3] * px + r[4] * py + r[5] * pz) * inverse_z
            a = min(max(slope_x, camera[CAM_SLOPE_LOW_X]), camera[CAM_SLOPE_HIGH_X])
            b = min(max(slope_y, camera[CAM_SLOPE_LOW_Y]), camera[CAM_SLOPE_HIGH_Y])
            sx, sy = fx * inverse_z, fy * inverse_z
            j = (sx * (r[0] - a * r[6]), sx * (r[1] - a * r[7]), sx * (r[2] - a * r[8]))
            k = (sy * (r[3] - b * r[6]), sy * (r[4] - b * r[7]), sy * (r[5] - b * r[8]))
            qw, qx, qy, qz = (
                np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1]), np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
            )  # fmt: skip
            inverse_length = 1.0 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
            qw, qx, qy, qz = qw * inverse_length, qx * inverse_length, qy * inverse_length, qz * inverse_length
            rotation = _rotation(qw, qx, qy, qz)
            for column in range(3):
                scale[column] = math.exp(np.float64(log_scales[i, column]))
                for row in range(3):
                    factor[row, column] = rotation[row][column] * scale[column]
            m0, m1, m2 = (
                j[0] * factor[0, 0] + j[1] * factor[1, 0] + j[2] * factor[2, 0],
                j[0] * factor[0, 1] + j[1] * factor[1, 1] + j[2] * factor[2, 1],
                j[0] * factor[0, 2] + j[1] * factor[1, 2] + j[2] * factor[2, 2],
            )
            n0, n1, n2 = (
                k[0] * factor[0, 0] + k[1] * factor[1, 0] + k[2] * factor[2, 0],
                k[0] * factor[0, 1] + k[1] * factor[1, 1] + k[2] * factor[2, 1],
                k[0] * factor[0, 2] + k[1] * factor[1, 2] + k[2] * factor[2, 2],
            )
            mm, nn, mn = m0 * m0 + m1 * m1 + m2 * m2, n0 * n0 + n1 * n1 + n2 * n2, m0 * n0 + m1 * n1 + m2 * n2
            c22 = nn + EPS2D_PX2
            x01, x02, x12 = m0 * n1 - m1 * n0, m0 * n2 - m2 * n0, m1 * n2 - m2 * n1
            det = x01 * x01 + x02 * x02 + x12 * x12 + EPS2D_PX2 * (mm + c22)
            l11 = math.sqrt(c22 / det)
            whitened = (l11, -l11 * mn / c22, 1.0 / math.sqrt(c22))
            # The pairs' moments are over s, t in units of EXPONENT_SCALE.
            h_s, h_t = sums[at + PAIR_S] / EXPONENT_SCALE, sums[at + PAIR_T] / EXPONENT_SCALE
            square = EXPONENT_SCALE * EXPONENT_SCALE
            (du, dv), dm, dn = _shape_gradient(
                (m0, m1, m2), (n0, n1, n2), whitened, h_s, h_t, sums[at + PAIR_SS] / square, sums[at + PAIR_ST] / square,
                sums[at + PAIR_TT] / square,
            )  # fmt: skip
            screen[i] = math.sqrt(du * du + dv * dv)
            g_logits[i] = sums[at + PAIR_H] / (1.0 + math.exp(np.float64(logits[i])))

            # M = (J R_camera) (R_q diag s): rows j, k of the first factor, then the second.
            dj0, dj1, dj2 = (
                factor[0, 0] * dm[0] + factor[0, 1] * dm[1] + factor[0, 2] * dm[2],
                factor[1, 0] * dm[0] + factor[1, 1] * dm[1] + factor[1, 2] * dm[2],
                factor[2, 0] * dm[0] + factor[2, 1] * dm[1] + factor[2, 2] * dm[2],
            )
            dk0, dk1, dk2 = (
                factor[0, 0] * dn[0] + factor[0, 1] * dn[1] + factor[0, 2] * dn[2],
                factor[1, 0] * dn[0] + factor[1, 1] * dn[1] + factor[1, 2] * dn[2],
                factor[2, 0] * dn[0] + factor[2, 1] * dn[1] + factor[2, 2] * dn[2],
            )
            for column in range(3):
                along = 0.0
                for row in range(3):
                    d_factor[row, column] = j[row] * dm[column] + k[row] * dn[column]
                    along += factor[row, column] * d_factor[row, column]
                    d_rotation[row, column] = d_factor[row, column] * scale[column]
                g_log_scales[i, column] = along
            gw, gx, gy, gz = _quaternion_gradient(qw, qx, qy, qz, d_rotation)
            radial = gw * qw + gx * qx + gy * qy + gz * qz
            g_quaternions[i, 0] = (gw - radial * qw) * inverse_length
            g_quaternions[i, 1] = (gx - radial * qx) * inverse_length
            g_quaternions[i, 2] = (gy - radial * qy) * inverse_length
            g_quaternions[i, 3] = (gz - radial * qz) * inverse_length

            # Depth: its own sum, the 1/z of J, and the slopes; a clamped slope passes nothing on.
            dz = sums[at + PAIR_Z] - (dj0 * j[0] + dj1 * j[1] + dj2 * j[2] + dk0 * k[0] + dk1 * k[1] + dk2 * k[2]) * inverse_z
            d_slope_x, d_slope_y = fx * du, fy * dv
            if a == slope_x:
                d_slope_x -= sx * (dj0 * r[6] + dj1 * r[7] + dj2 * r[8])
            if b == slope_y:
                d_slope_y -= sy * (dk0 * r[6] + dk1 * r[7] + dk2 * r[8])
            dx, dy = d_slope_x * inverse_z, d_slope_y * inverse_z
            dz -= dx * slope_x + dy * slope_y

            size = sh.shape[1]
            distance = math.sqrt(px * px + py * py + pz * pz)
            direction = (px / distance, py / distance, pz / distance)
            red = sums[at + PAIR_R] if records[rank * RECORD + R] > _f(0.0) else 0.0
            green = sums[at + PAIR_G] if records[rank * RECORD + G] > _f(0.0) else 0.0
            blue = sums[at + PAIR_B] if records[rank * RECORD + B] > _f(0.0) else 0.0
            ex, ey, ez = _colour_gradient(i, size, direction, red, green, blue, sh, g_sh, basis, weights)
            radial = ex * direction[0] + ey * direction[1] + ez * direction[2]
            g_means[i, 0] = r[0] * dx + r[3] * dy + r[6] * dz + (ex - radial * direction[0]) / distance
            g_means[i, 1] = r[1] * dx + r[4] * dy + r[7] * dz + (ey - radial * direction[1]) / distance
            g_means[i, 2] = r[2] * dx + r[5] * dy + r[8] * dz + (ez - radial * direction[2]) / distance
