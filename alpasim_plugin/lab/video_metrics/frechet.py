"""The Frechet distance of two sets of feature vectors, each taken as a Gaussian.

Dowson and Landau, "The Frechet distance between multivariate normal distributions", 1982, Eq. 16:
``|m1 - m2|^2 + tr(S1 + S2 - 2 (S1 S2)^(1/2))``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import F64


@dataclass(frozen=True)
class SetDistance:
    """A Frechet distance with the size of what it was estimated from.

    Attributes:
        value: None where a covariance is rank-deficient.
        vectors: Of the smaller of the two sets.
        dimensions: Of a vector.
        reason: Why there is no value.
    """

    value: float | None
    vectors: int
    dimensions: int
    reason: str | None = None


def set_distance(a: F64, b: F64) -> SetDistance:
    """Return the distance of two sets ``(n1, d)`` and ``(n2, d)``, without a value where a set has
    no more vectors than dimensions: its covariance then has no full rank, and the distance tells
    more of the number of vectors than of the sets.

    Raises:
        EvaluatorError: Sets that do not belong together.
    """
    value = frechet_distance(a, b)
    vectors = min(len(a), len(b))
    dimensions = a.shape[1]
    if vectors > dimensions:
        return SetDistance(value, vectors, dimensions)
    reason = f"needs more than {dimensions} vectors, found {vectors}"
    return SetDistance(None, vectors, dimensions, reason)


def frechet_distance(a: F64, b: F64) -> float:
    """Return the Frechet distance of two sets ``(n1, d)`` and ``(n2, d)`` of at least two vectors,
    covariances divided by n - 1.

    With centred rows ``A = (a - m1) / sqrt(n1 - 1)`` and ``B`` alike, the trace of the root is the
    sum of the singular values of ``A B^T``: no root of a matrix that may be singular is taken.

    Raises:
        EvaluatorError: Sets that do not belong together.

    Example:
        >>> a = np.array([[0.0], [2.0]])
        >>> frechet_distance(a, a + 3.0)
        9.0
    """
    shapes = f"{a.shape} and {b.shape}"
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1] or min(len(a), len(b)) < 2:
        raise EvaluatorError(
            f"two sets of vectors: shapes {shapes}", "give (n, d) each, of at least two vectors"
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise EvaluatorError(
            f"two sets of vectors, {shapes}: values that are not finite",
            "look at the videos and at the weights of the metric",
        )
    centred_a, centred_b = (
        (x - x.mean(axis=0)) / np.sqrt(len(x) - 1)
        for x in (a.astype(np.float64), b.astype(np.float64))
    )
    shift = float(np.sum((a.mean(axis=0) - b.mean(axis=0)) ** 2))
    spreads = float(np.sum(centred_a**2) + np.sum(centred_b**2))
    root = float(np.linalg.svd(_smallest_product(centred_a, centred_b), compute_uv=False).sum())
    return shift + spreads - 2 * root


def _smallest_product(a: F64, b: F64) -> F64:
    """Return a matrix with the singular values of ``A B^T`` that is no larger than d x d."""
    return np.asarray(_shortened(a) @ _shortened(b).T)


def _shortened(a: F64) -> F64:
    """Return at most d rows with the scalar products of the columns of ``a``, ``(n, d)``."""
    return np.asarray(np.linalg.qr(a, mode="r")) if len(a) > a.shape[1] else a
