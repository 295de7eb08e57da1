"""What was measured of every arm on the same clips, and the paired difference of any two arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.special

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.learned_metrics.frechet import frechet_distance
from alpasim_plugin.lab.learned_metrics.swapping import SwapTest, swap_test
from alpasim_plugin.lab.video_metrics.facts import KNOWN
from evaluators.statistics.intervals import Interval, t_interval

ALPHA = 0.05
SWAPS = 2000  # of whole clips, where not all of them are taken; no p-value is below 1 / (SWAPS + 1)
Values = Mapping[str, Mapping[str, Mapping[str, float]]]  # ARM -> CLIP -> METRIC -> value
Features = Mapping[str, Mapping[str, Mapping[str, F64]]]  # ARM -> CLIP -> METRIC -> vectors (n, d)


@dataclass(frozen=True)
class Difference:
    """Of two arms on the clips that both have.

    Args:
        metric: Which.
        first, second: Arms.
        difference: First minus second.
        low, high: 95 % t interval over clips; None for a metric of whole sets.
        p_value: Two-sided: of the t test over clips, or by swapping whole clips for a metric of
            whole sets; None with one clip.
        n: Clips.
        favours: Whether the first is shown to be better (1) or worse (-1), or neither (0).
    """

    metric: str
    first: str
    second: str
    difference: float
    low: float | None
    high: float | None
    p_value: float | None
    n: int
    favours: int

    @property
    def bounds(self) -> tuple[float, float] | None:
        """95 % bounds; of whole sets those of the normal distribution that has the p-value of the
        swaps; None where nothing says so.
        """
        if self.low is not None and self.high is not None:
            return self.low, self.high
        if self.p_value is None or not 0.0 < self.p_value < 1.0 or self.difference == 0.0:
            return None
        half = abs(self.difference) * float(
            scipy.special.ndtri(1 - ALPHA / 2) / scipy.special.ndtri(1 - self.p_value / 2)
        )
        return self.difference - half, self.difference + half


class Measured:
    """Values of clips and features of clips, by arm.

    Args:
        values: Of clips; a value that is undefined on a clip is not there.
        features: For metrics of whole sets (Frechet distances): METRIC -> vectors; the arm
            ``reference`` holds the clean frames.
        reference: Name of the clean frames.
        seed: Of the swaps.
    """

    def __init__(
        self,
        values: Values,
        features: Features | None = None,
        reference: str = "truth",
        seed: int = 0,
    ) -> None:
        self.values, self.features, self.reference, self.seed = (
            values,
            features or {},
            reference,
            seed,
        )
        self._tests: dict[tuple[str, str, str], SwapTest] = {}

    def only(self, arms: Sequence[str]) -> Measured:
        """Return the measurements of some of the arms, in this order, beside the clean frames;
        tests that were made are not made again.
        """
        features = {
            arm: self.features[arm]
            for arm in dict.fromkeys((*arms, self.reference))
            if arm in self.features
        }
        chosen = Measured(
            {arm: self.values[arm] for arm in arms}, features, self.reference, self.seed
        )
        chosen._tests = self._tests
        return chosen

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the arms, without the clean frames."""
        return tuple(name for name in self.values if name != self.reference)

    @cached_property
    def set_metrics(self) -> frozenset[str]:
        """Metrics of whole sets."""
        return frozenset(
            metric for clips in self.features.get(self.reference, {}).values() for metric in clips
        )

    def clips(self, arm: str, metric: str) -> list[str]:
        """Return the clips on which an arm has a metric."""
        if metric in self.set_metrics:
            mine, truth = self.features.get(arm, {}), self.features[self.reference]
            return [
                clip for clip in truth if metric in truth[clip] and metric in mine.get(clip, {})
            ]
        return [clip for clip, found in self.values.get(arm, {}).items() if metric in found]

    def has(self, arm: str, metric: str) -> bool:
        """Whether an arm has a metric on at least two clips."""
        return len(self.clips(arm, metric)) >= 2

    def mean(self, arm: str, metric: str) -> Interval:
        """Return the mean over clips with its 95 % t interval, or the distance of a whole set,
        which has none.

        Raises:
            EvaluatorError: Fewer than two clips.
        """
        clips = self._shared(metric, arm)
        if metric in self.set_metrics:
            made, true = self._sides(metric, clips, arm)
            return Interval(frechet_distance(np.concatenate(made), np.concatenate(true)))
        return t_interval([self.values[arm][clip][metric] for clip in clips], "clips")

    def compares(self, metric: str, first: str, second: str) -> bool:
        """Whether two arms have a metric on at least two common clips."""
        return len(set(self.clips(first, metric)) & set(self.clips(second, metric))) >= 2

    def difference(self, metric: str, first: str, second: str, share: float = 0.0) -> Difference:
        """Return the paired difference of two arms.

        Args:
            metric: Which; of whole sets only without a share.
            first, second: Arms.
            share: Of the second's value, 0 to 1, that is taken off before.

        Raises:
            EvaluatorError: They share fewer than two clips.
        """
        clips = self._shared(metric, first, second)
        better = {"higher": 1, "lower": -1}.get(KNOWN.info(metric).direction, 0)
        if metric in self.set_metrics:
            test = self._swap_test(metric, clips, *sorted((first, second)))
            difference = test.difference if first <= second else -test.difference
            favours = better * int(np.sign(difference)) if test.p_value < ALPHA else 0
            return Difference(
                metric, first, second, difference, None, None, test.p_value, len(clips), favours
            )
        left = 1.0 - share
        found = t_interval(
            [
                self.values[first][clip][metric] - left * self.values[second][clip][metric]
                for clip in clips
            ],
            "clips",
        )
        favours = 0
        if found.low is not None and found.high is not None and not found.low <= 0.0 <= found.high:
            favours = better * int(np.sign(found.centre))
        p_value = beyond(found, 0.0, len(clips))
        return Difference(
            metric, first, second, found.centre, found.low, found.high, p_value, len(clips), favours
        )

    def _swap_test(self, metric: str, clips: Sequence[str], first: str, second: str) -> SwapTest:
        """Return the test of two arms, made once: tables and verdicts ask for the same ones, in
        either order.
        """
        if (metric, first, second) not in self._tests:
            a, true = self._sides(metric, clips, first)
            b, _ = self._sides(metric, clips, second)
            self._tests[metric, first, second] = swap_test(a, b, true, SWAPS, self.seed)
        return self._tests[metric, first, second]

    def margin(self, metric: str, arm: str, bound: float) -> Difference:
        """Return by how much an arm exceeds a bound on average, as a difference from it.

        Raises:
            EvaluatorError: Fewer than two clips.
        """
        clips = self._shared(metric, arm)
        found = t_interval([self.values[arm][clip][metric] - bound for clip in clips], "clips")
        better = {"higher": 1, "lower": -1}.get(KNOWN.info(metric).direction, 0)
        decided = (
            found.low is not None and found.high is not None and not found.low < 0.0 < found.high
        )
        favours = better * (1 if found.centre >= 0 else -1) if decided else 0
        return Difference(
            metric,
            arm,
            f"{bound:g}",
            found.centre,
            found.low,
            found.high,
            beyond(found, 0.0, len(clips)),
            len(clips),
            favours,
        )

    def _shared(self, metric: str, *arms: str) -> list[str]:
        sides = [self.clips(arm, metric) for arm in arms]
        shared = [clip for clip in sides[0] if all(clip in side for side in sides[1:])]
        if len(shared) < 2:
            raise EvaluatorError(
                f"{metric} of {', '.join(arms)}: {len(shared)} clips in common",
                "measure at least two clips of each",
            )
        return shared

    def _sides(self, metric: str, clips: Sequence[str], arm: str) -> tuple[list[F64], list[F64]]:
        return [self.features[arm][c][metric] for c in clips], [
            self.features[self.reference][c][metric] for c in clips
        ]


def beyond(found: Interval, width: float, n: int) -> float | None:
    """Return the two-sided p-value of the t test that a mean of ``n`` values is beyond ``width``
    from zero; None without an interval.
    """
    if found.low is None or found.high is None:
        return None
    excess, half = abs(found.centre) - width, (found.high - found.low) / 2
    if half == 0.0:
        return 0.0 if excess > 0.0 else 1.0
    standard_error = half / float(scipy.special.stdtrit(n - 1, 1 - ALPHA / 2))
    return min(2.0 * float(scipy.special.stdtr(n - 1, -excess / standard_error)), 1.0)


def from_rows(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Return values of clips from rows as `alpasim_plugin.lab.video_metrics.summary` takes them;
    the time is the median over blocks.
    """
    out: dict[str, dict[str, dict[str, float]]] = {}
    for row in rows:
        values = {name: float(value) for name, value in row["values"].items() if value is not None}
        if row.get("ms_per_frame"):
            values["ms_per_frame"] = float(np.median(row["ms_per_frame"]))
        out.setdefault(str(row["arm"]), {})[str(row["clip"])] = values
    return out
