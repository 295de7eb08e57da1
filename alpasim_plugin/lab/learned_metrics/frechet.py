"""Frechet distance of two sets of feature vectors, for any number of vectors, and what may be
concluded from it.

``|m1 - m2|^2 + tr(S1 + S2 - 2 (S1 S2)^(1/2))`` with covariances over n - 1. The last trace is the
nuclear norm of ``A B^T`` for the centred and scaled matrices ``S1 = A^T A``, ``S2 = B^T B``: exact
where covariances are singular, where a matrix square root is not.

With fewer vectors than dimensions the value is mostly bias. A bootstrap of it is wrong (repeated
items raise it); differences of two variants are tested by swapping their clips
(`alpasim_plugin.lab.learned_metrics.swapping`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import F64


def frechet_distance(a: F64, b: F64, ridge: float = 0.0) -> float:
    """Return the Frechet distance of two sets ``(n1, d)`` and ``(n2, d)``.

    Args:
        a, b: At least two vectors each.
        ridge: Added to both diagonals inside the square root only, as FVMD's code does.

    Raises:
        EvaluatorError: Other shapes, a single vector, or a value that is not finite.

    Example:
        >>> x = np.array([[0.0], [2.0]])
        >>> frechet_distance(x, x + 3.0)
        9.0
    """
    check_features(a, b)
    m1, A = moments(a)
    m2, B = moments(b)
    shift = float(((m1 - m2) ** 2).sum())
    traces = float((A * A).sum() + (B * B).sum())
    if ridge:
        extra = np.sqrt(ridge) * np.eye(a.shape[1])
        A, B = np.concatenate([A, extra]), np.concatenate([B, extra])
    return max(shift + traces - 2 * float(np.linalg.svd(A @ B.T, compute_uv=False).sum()), 0.0)


def moments(x: F64) -> tuple[F64, F64]:
    """Return the mean ``(d,)`` of vectors ``(n, d)`` and a factor ``(min(n, d), d)`` whose ``A^T
    A`` is their covariance over n - 1.
    """
    x = np.asarray(x, dtype=np.float64)
    mean = x.mean(axis=0)
    A = (x - mean) / np.sqrt(len(x) - 1)
    # A = Q R has the singular values of R in every product with it: d rows are enough.
    return mean, A if len(A) <= A.shape[1] else np.asarray(np.linalg.qr(A, mode="r"))


def check_features(a: F64, b: F64) -> None:
    """Refuse anything but two sets of at least two finite vectors of one length.

    Raises:
        EvaluatorError: With what was found.
    """
    _, do = (
        "computing a Frechet distance",
        "give at least two finite vectors (n, d) on each side",
    )
    if a.ndim != 2 or b.ndim != 2 or a.shape[1:] != b.shape[1:] or min(len(a), len(b)) < 2:
        raise EvaluatorError(f"two sets of features: shapes {a.shape} and {b.shape}", do)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise EvaluatorError("two sets of features: a value that is not finite", do)


def halves(clips: Sequence[F64]) -> float | None:
    """Return the distance of every second clip from the others: what two samples of the same videos
    give. None below four clips.
    """
    if len(clips) < 4:
        return None
    return frechet_distance(np.concatenate(list(clips[::2])), np.concatenate(list(clips[1::2])))
