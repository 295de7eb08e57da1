"""Frechet distance of two sets of feature vectors, for any number of vectors, and what may be concluded from it.

``|m1 - m2|^2 + tr(S1 + S2 - 2 (S1 S2)^(1/2))`` with covariances over n - 1. The last trace is the nuclear norm of ``A B^T`` for the
centred and scaled matrices ``S1 = A^T A``, ``S2 = B^T B``: exact where covariances are singular, where a matrix square root is not.

With fewer vectors than dimensions the value is mostly bias. A bootstrap of it is wrong (repeated items raise it); differences of two
variants are tested by swapping their clips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.errors import EvaluatorError
from alpasim_plugin.seeding import stream
from alpasim_plugin.types import F64


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
    m1, A = _moments(a)
    m2, B = _moments(b)
    shift = float(((m1 - m2) ** 2).sum())
    traces = float((A * A).sum() + (B * B).sum())
    if ridge:
        extra = np.sqrt(ridge) * np.eye(a.shape[1])
        A, B = np.concatenate([A, extra]), np.concatenate([B, extra])
    return max(shift + traces - 2 * float(np.linalg.svd(A @ B.T, compute_uv=False).sum()), 0.0)


def _moments(x: F64) -> tuple[F64, F64]:
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
    doing, do = "computing a Frechet distance", "give at least two finite vectors (n, d) on each side"
    if a.ndim != 2 or b.ndim != 2 or a.shape[1:] != b.shape[1:] or min(len(a), len(b)) < 2:
        raise EvaluatorError(doing, "two sets of features", f"shapes {a.shape} and {b.shape}", do)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise EvaluatorError(doing, "two sets of features", "a value that is not finite", do)


@dataclass(frozen=True)
class SwapTest:
    """The difference of two variants' distances to one reference.

    Args:
        difference: First minus second; negative: the first is closer.
        p_value: Two-sided, over swaps of whole clips.
        swaps: How many were drawn.
    """

    difference: float
    p_value: float
    swaps: int


def swap_test(first: Sequence[F64], second: Sequence[F64], reference: Sequence[F64], swaps: int = 500, seed: int = 0) -> SwapTest:
    """Test whether two variants of the same clips are equally far from the reference.

    Under the null hypothesis a clip's two versions are exchangeable, so every clip is swapped with probability one half.

    Args:
        first, second, reference: Features ``(n_i, d)`` of every clip, in one order.
        swaps: Number of draws.
        seed: Of the draws.

    Raises:
        EvaluatorError: Other numbers of clips.
    """
    if not len(first) == len(second) == len(reference):
        found = f"{len(first)}, {len(second)}, {len(reference)} clips"
        raise EvaluatorError("testing a Frechet distance", "two variants", found, "give the same clips of both and of the reference")
    truth = np.concatenate(list(reference))

    def difference(a: Sequence[F64], b: Sequence[F64]) -> float:
        return frechet_distance(np.concatenate(list(a)), truth) - frechet_distance(np.concatenate(list(b)), truth)

    measured = difference(first, second)
    rng = stream("judges", seed, "frechet.swap")
    beyond = 0
    for _ in range(swaps):
        swapped = rng.random(len(first)) < 0.5
        a = [y if s else x for x, y, s in zip(first, second, swapped, strict=True)]
        b = [x if s else y for x, y, s in zip(first, second, swapped, strict=True)]
        beyond += abs(difference(a, b)) >= abs(measured) - 1e-12
    return SwapTest(measured, (beyond + 1) / (swaps + 1), swaps)


def halves(clips: Sequence[F64]) -> float | None:
    """Return the distance of every second clip from the others: what two samples of the same videos give. None below four clips."""
    if len(clips) < 4:
        return None
    return frechet_distance(np.concatenate(list(clips[::2])), np.concatenate(list(clips[1::2])))
