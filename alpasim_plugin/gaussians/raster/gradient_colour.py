"""Evaluate the colours of visible splats and take their gradients back to coefficients and view directions.

`alpasim_plugin.gaussians.sh` is the reference implementation of the basis.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np
from numba import njit

from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.layout import RECORD, B, G, R
from alpasim_plugin.gaussians.sh import C0, C1, C2, C3


@njit(cache=True, nogil=True, error_model="numpy")
def write_basis(basis, size, x, y, z):
    """Write ``size`` harmonics of a unit direction."""
    basis[0] = C0
    if size > 1:
        basis[1], basis[2], basis[3] = -C1 * y, C1 * z, -C1 * x
    if size > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis[4], basis[5], basis[6] = C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy)
        basis[7], basis[8] = -C2[0] * x * z, C2[2] * (xx - yy)
        if size > 9:
            basis[9], basis[10], basis[11] = -C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, -C3[2] * y * (4 * zz - xx - yy)
            basis[12], basis[13] = C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -C3[2] * x * (4 * zz - xx - yy)
            basis[14], basis[15] = C3[4] * z * (xx - yy), -C3[0] * x * (xx - 3 * yy)


@njit(cache=True, nogil=True, error_model="numpy")
def basis_gradient(weights, size, x, y, z):
    """Return the gradient with respect to x, y and z of the harmonics' sum weighted by ``weights``."""
    gx, gy, gz = 0.0, 0.0, 0.0
    w = weights
    if size > 1:
        gx, gy, gz = -C1 * w[3], -C1 * w[1], C1 * w[2]
    if size > 4:
        gx += C2[0] * (y * w[4] - z * w[7]) + 2 * x * (C2[2] * w[8] - C2[1] * w[6])
        gy += C2[0] * (x * w[4] - z * w[5]) - 2 * y * (C2[2] * w[8] + C2[1] * w[6])
        gz += -C2[0] * (y * w[5] + x * w[7]) + 4 * C2[1] * z * w[6]
    if size > 9:
        xx, yy, zz = x * x, y * y, z * z
        gx += -6 * C3[0] * x * y * w[9] + C3[1] * y * z * w[10] + 2 * C3[2] * x * y * w[11] - 6 * C3[3] * x * z * w[12]
        gx += -C3[2] * (4 * zz - 3 * xx - yy) * w[13] + 2 * C3[4] * x * z * w[14] - 3 * C3[0] * (xx - yy) * w[15]
        gy += -3 * C3[0] * (xx - yy) * w[9] + C3[1] * x * z * w[10] - C3[2] * (4 * zz - xx - 3 * yy) * w[11]
        gy += -6 * C3[3] * y * z * w[12] + 2 * C3[2] * x * y * w[13] - 2 * C3[4] * y * z * w[14] + 6 * C3[0] * x * y * w[15]
        gz += C3[1] * x * y * w[10] - 8 * C3[2] * (y * z * w[11] + x * z * w[13]) + C3[3] * (6 * zz - 3 * xx - 3 * yy) * w[12]
        gz += C3[4] * (xx - yy) * w[14]
    return gx, gy, gz


@njit(cache=True, nogil=True, error_model="numpy")
def colour_splats(cursor, chunk_size, count, ids, means, centre, sh, records):
    """Write the colours of projected splats; called by each thread.

    Args:
        cursor: int64 ``(2,)``: the next chunk, and 1 where a colour was not finite; shared by all threads.
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
            x, y, z = means[i, 0] - centre[0], means[i, 1] - centre[1], means[i, 2] - centre[2]
            length = 1.0 / np.sqrt(x * x + y * y + z * z)
            write_basis(basis, size, x * length, y * length, z * length)
            red, green, blue = 0.5, 0.5, 0.5
            for k in range(size):
                red += basis[k] * sh[i, k, 0]
                green += basis[k] * sh[i, k, 1]
                blue += basis[k] * sh[i, k, 2]
            if not np.isfinite(red + green + blue):
                cursor[1] = 1
            at = place * RECORD
            records[at + R], records[at + G], records[at + B] = max(red, 0.0), max(green, 0.0), max(blue, 0.0)
