"""Whether two variants of the same clips are equally far from the reference: a permutation test
that swaps whole clips.

Thousands of Frechet distances to one reference are needed, of sets put together from the same few
clips. `SubsetDistances` computes once what they share;
`alpasim_plugin.lab.learned_metrics.frechet.frechet_distance` of the joined vectors is its readable
form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Bool
from alpasim_plugin.lab.learned_metrics.frechet import check_features, frechet_distance, moments

AS_EXTREME = 20  # swaps as extreme as the measured difference after which no more are drawn
ROUNDING = (
    1e-6  # of the sum of variances: what the square roots of eigenvalues near zero can be off by
)


@dataclass(frozen=True)
class SwapTest:
    """The difference of two variants' distances to one reference.

    Args:
        difference: First minus second; negative: the first is closer.
        p_value: Two-sided, over swaps of whole clips.
        swaps: How many were drawn, or all that there are.
    """

    difference: float
    p_value: float
    swaps: int


def swap_test(
    first: Sequence[F64],
    second: Sequence[F64],
    reference: Sequence[F64],
    swaps: int = 500,
    seed: int = 0,
) -> SwapTest:
    """Test whether two variants of the same clips are equally far from the reference.

    Under the null hypothesis a clip's two versions are exchangeable, so every clip is swapped with
    probability one half. Of few clips all swaps are taken, and the test is exact: ``2 ** (n - 1)``
    of them, as the difference of a swap and of its opposite differ in sign alone. Of more clips
    swaps are drawn, which ends early once `AS_EXTREME` of them are as extreme; the p-value is then
    their share (Besag and Clifford, Biometrika 1991).

    Args:
        first, second, reference: Features ``(n_i, d)`` of every clip, in one order.
        swaps: Most swaps; no p-value is below ``1 / (swaps + 1)``, or ``2 / 2 ** n`` where all are
            taken.
        seed: Of the draws.

    Raises:
        EvaluatorError: Other numbers of clips.
    """
    n = len(first)
    if not n == len(second) == len(reference):
        raise EvaluatorError(
            f"two variants: {n}, {len(second)}, {len(reference)} clips",
            "give the same clips of both and of the reference",
        )
    truth = np.concatenate(list(reference))
    measured = frechet_distance(np.concatenate(list(first)), truth) - frechet_distance(
        np.concatenate(list(second)), truth
    )
    distances = SubsetDistances([*first, *second], truth)
    clips = np.arange(n)
    bound = abs(distances(clips) - distances(clips + n)) - distances.rounding

    def as_extreme(swapped: Bool) -> bool:
        return abs(distances(clips + n * swapped) - distances(clips + n * ~swapped)) >= bound

    if 2 ** (n - 1) <= swaps:
        every = [
            as_extreme(np.array((False, *others)))
            for others in product((False, True), repeat=n - 1)
        ]
        return SwapTest(measured, sum(every) / len(every), len(every))
    rng = stream("judges", seed, "frechet.swap")
    extreme = 0
    for drawn in range(1, swaps + 1):
        extreme += as_extreme(rng.random(n) < 0.5)
        if extreme == AS_EXTREME:
            return SwapTest(measured, extreme / drawn, drawn)
    return SwapTest(measured, (extreme + 1) / (swaps + 1), swaps)


class SubsetDistances:
    """Frechet distances from one reference, of any selection of the given clips.

    With the reference's covariance ``B^T B`` and a selection's rows ``X``, the trace of the square
    root is the sum of the roots of the eigenvalues of ``B S B^T`` or, with fewer rows than rows of
    ``B``, of the rows' centred Gram matrix ``X B^T B X^T / (n - 1)``. The parts of either are kept
    for every clip.

    Args:
        clips: Features ``(n_i, d)``.
        reference: ``(n, d)``.

    Raises:
        EvaluatorError: As `frechet_distance`.
    """

    def __init__(self, clips: Sequence[F64], reference: F64) -> None:
        rows = np.concatenate(list(clips)).astype(np.float64)
        check_features(rows, reference)
        mean, B = moments(reference)
        rows = (
            rows - mean
        )  # A distance does not change with the origin; products lose less to rounding near it.
        self._counts = np.array([len(clip) for clip in clips])
        self._ends = np.cumsum(self._counts)
        self._sums = np.add.reduceat(rows, self._ends - self._counts, axis=0)
        self._squares = np.add.reduceat((rows * rows).sum(axis=1), self._ends - self._counts)
        self._variance = float((B * B).sum())
        self.rounding = ROUNDING * (self._variance + float(rows.var(axis=0).sum()))
        projected = rows @ B.T
        self._by_rows = len(rows) / 2 < len(B)
        if self._by_rows:
            self._gram = projected @ projected.T
        else:
            parts = np.split(projected, self._ends[:-1])
            self._parts = np.stack([part.T @ part for part in parts])
            self._projected_sums = np.stack([part.sum(axis=0) for part in parts])

    def __call__(self, chosen: np.ndarray) -> float:
        """Return the distance of the chosen clips, given by their places, from the reference."""
        n = int(self._counts[chosen].sum())
        mean = self._sums[chosen].sum(axis=0) / n
        shift = float(mean @ mean)
        variance = (float(self._squares[chosen].sum()) - n * shift) / (n - 1)
        if self._by_rows:
            places = np.concatenate(
                [np.arange(self._ends[c] - self._counts[c], self._ends[c]) for c in chosen]
            )
            product = self._gram[np.ix_(places, places)]
            product = (
                product - product.mean(axis=0) - product.mean(axis=1)[:, None] + product.mean()
            )
        else:
            total = self._projected_sums[chosen].sum(axis=0)
            product = self._parts[chosen].sum(axis=0) - np.outer(total, total / n)
        roots = np.sqrt(np.clip(np.linalg.eigvalsh(product / (n - 1)), 0.0, None))
        return max(shift + variance + self._variance - 2.0 * float(roots.sum()), 0.0)
