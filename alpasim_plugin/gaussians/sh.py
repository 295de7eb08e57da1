"""Evaluate and rotate real spherical harmonics up to degree 3, in the order and with the signs of
3DGS files.

The basis (order k = 0 | -1, 0, 1 | -2..2 | -3..3) is orthonormal over the unit sphere; its
constants are square roots of rationals over pi.
"""

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64, FloatArray

SH_SIZES = (1, 4, 9, 16)  # (degree + 1)^2

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


def sh_terms(x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    """Return the basis functions of degrees 1 to 3, fifteen of them, at a unit direction: numbers,
    arrays or tensors alike.
    """
    xx = x * x
    yy = y * y
    zz = z * z
    return (
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        -C2[0] * y * z,
        C2[1] * (2 * zz - xx - yy),
        -C2[0] * x * z,
        C2[2] * (xx - yy),
        -C3[0] * y * (3 * xx - yy),
        C3[1] * x * y * z,
        -C3[2] * y * (4 * zz - xx - yy),
        C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
        -C3[2] * x * (4 * zz - xx - yy),
        C3[4] * z * (xx - yy),
        -C3[0] * x * (xx - 3 * yy),
    )


def sh_basis(directions: npt.ArrayLike, size: int = 16) -> F64:
    """Return the ``(..., size)`` basis at unit directions ``(..., 3)``; size is 1, 4, 9 or 16.

    Example:
        >>> sh_basis([0.0, 0.0, 1.0], 4).round(4).tolist()
        [0.2821, -0.0, 0.4886, -0.0]
    """
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    terms = (np.full_like(x, C0), *sh_terms(x, y, z))
    return np.stack(terms[:size], axis=-1)


def sh_colours(sh: FloatArray, directions: npt.ArrayLike) -> F64:
    """Return RGB ``(N, 3)`` of coefficients ``(N, K, 3)`` seen along unit directions ``(N, 3)``:
    clamped at 0 below, not above.
    """
    basis = sh_basis(directions, sh.shape[1])
    return np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, sh.astype(np.float64)), 0.0)


def dc_from_rgb(rgb: npt.ArrayLike) -> F64:
    """Return the constant coefficients that show a colour from every side."""
    return (np.asarray(rgb, dtype=np.float64) - 0.5) / C0


@lru_cache(maxsize=1)
def _sample_directions() -> tuple[F64, tuple[F64, ...]]:
    """Return 64 spread directions (a Fibonacci sphere) and, per degree, the pseudo-inverse of the
    basis there.
    """
    i = np.arange(64) + 0.5
    z = 1 - 2 * i / 64
    phi = np.pi * (1 + np.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    directions = np.column_stack([r * np.cos(phi), r * np.sin(phi), z])
    basis = sh_basis(directions)
    return directions, tuple(
        np.asarray(np.linalg.pinv(basis[:, degree * degree : (degree + 1) ** 2]))
        for degree in range(4)
    )


def sh_rotation(rotation: F64, degree: int) -> F64:
    """Return the real Wigner matrix ``(2l+1, 2l+1)`` that turns the coefficients of one degree with
    an object.

    If an object turns by R its colour seen along d is the old colour along R^T d. The basis of one
    degree spans a space closed under rotation, so the matrix is found exactly (to rounding) by
    matching both sides at more directions than there are unknowns.
    """
    directions, inverses = _sample_directions()
    turned = sh_basis(directions @ rotation)[:, degree * degree : (degree + 1) ** 2]
    return inverses[degree] @ turned


def rotate_sh(sh: FloatArray, rotation: F64) -> FloatArray:
    """Return coefficients ``(N, K, 3)`` of the same objects after turning them by ``rotation``
    ``(3, 3)``; type kept.
    """
    out = sh.copy()
    for degree in range(1, SH_SIZES.index(sh.shape[1]) + 1):
        band = slice(degree * degree, (degree + 1) ** 2)
        out[:, band] = np.einsum(
            "jk,nkc->njc", sh_rotation(rotation, degree), sh[:, band].astype(np.float64)
        ).astype(sh.dtype)
    return out
