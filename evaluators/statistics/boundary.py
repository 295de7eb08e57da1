"""Where along one parameter of a scene a policy starts to fail: which points of a grid are driven
next, the boundary of each seed, and their mean with its interval.

A seed is a repeatable policy. Bisection encloses a change of its outcome between two neighbouring
points of the grid; then points beside it are driven, and where the outcome changes again the bracket
reaches from the first change to the last. Over seeds the boundary is the mean of the middles, with
Student's interval widened by half a bracket.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy  # its submodules load on first use; scipy.stats would take a second

STEPS = 64  # of the grid between both ends of the range
FIRST = range(0, STEPS + 1, STEPS // 4)  # driven before the bisection; they show a second change
BESIDE = (2, 4)  # steps from the outermost changes that are driven too
MOST_POINTS = 24  # that a seed drives: after 20 no more are asked for
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """Values between which what is sought of one seed lies."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """Give the middle of both values."""
        return 0.5 * (self.low + self.high)

    @property
    def half_width(self) -> float:
        """Give half of their distance."""
        return 0.5 * (self.high - self.low)


@dataclass(frozen=True)
class Bracket(Interval):
    """The change of outcome of one seed.

    Attributes:
        low, high: Values of the parameter between which the outcome changes.
        fails_below: The drive fails at ``low`` and not at ``high``.
        changes: How often the outcome changes between them.
    """

    fails_below: bool
    changes: int = 1


@dataclass(frozen=True)
class Estimate:
    """A boundary, or a difference of two, with its interval of 95 %."""

    value: float
    low: float
    high: float


def next_points(failed: Mapping[int, bool], skipped: set[int]) -> list[int]:
    """Return the points of the grid that a seed drives next; none where its search has ended.

    Args:
        failed: Point -> whether the drive failed there.
        skipped: Points at which the scene cannot be built.
    """
    asked = [point for point in FIRST if point not in skipped]
    if missing := [point for point in asked if point not in failed]:
        return missing
    if len(changes_of({point: failed[point] for point in asked})) != 1:
        return []
    if len(failed) > MOST_POINTS - 2 * len(BESIDE):
        return []
    changes = changes_of(failed)
    middles: list[int] = []
    for low, high in {changes[0], changes[-1]}:
        inside = [point for point in range(low + 1, high) if point not in skipped]
        middles += sorted(inside, key=lambda point: (abs(2 * point - low - high), point))[:1]
    if middles:
        return sorted(middles)
    low = changes[0][0]
    high = changes[-1][1]
    beside = [point for step in BESIDE for point in (low - step, high + step)]
    return [p for p in beside if 0 < p < STEPS and p not in {*failed, *skipped}]


def changes_of(failed: Mapping[int, bool]) -> list[tuple[int, int]]:
    """Return the neighbouring driven points between which the outcome changes."""
    points = sorted(failed)
    return [(low, high) for low, high in pairwise(points) if failed[low] != failed[high]]


def bracket_of(failed: Mapping[int, bool], values: Mapping[int, float]) -> Bracket | str:
    """Return the bracket of a seed whose search has ended, or why there is none.

    Args:
        failed: Point -> whether the drive failed there.
        values: Point -> value of the parameter.
    """
    if len(changes_of({point: failed[point] for point in FIRST if point in failed})) > 1:
        return "not monotone"
    changes = changes_of(failed)
    if not changes:
        return "fails everywhere" if any(failed.values()) else "no failure"
    low = changes[0][0]
    high = changes[-1][1]
    return Bracket(values[low], values[high], failed[low], len(changes))


def boundary_of(brackets: Sequence[Interval]) -> Estimate:
    """Return the mean boundary of several seeds with its interval; of one seed its bracket.

    Args:
        brackets: One a seed, all of which fail on the same side.
    """
    return _mean(
        [one.middle for one in brackets],
        max(one.half_width for one in brackets),
    )


def difference_of(brackets: Sequence[Interval], base: Sequence[Interval]) -> Estimate:
    """Return the mean difference of the boundaries of two variants, paired by seed.

    Args:
        brackets: One a seed.
        base: Those of the baseline, in the same order of seeds.
    """
    pairs = list(zip(brackets, base, strict=True))
    return _mean(
        [one.middle - other.middle for one, other in pairs],
        max(one.half_width + other.half_width for one, other in pairs),
    )


def _mean(values: Sequence[float], half_width: float) -> Estimate:
    """Return a mean with Student's interval, widened by what the brackets leave open."""
    mean = float(np.mean(values))
    margin = half_width
    if len(values) > 1:
        quantile = scipy.special.stdtrit(len(values) - 1, 0.5 + 0.5 * CONFIDENCE)
        margin += float(quantile * np.std(values, ddof=1) / np.sqrt(len(values)))
    return Estimate(mean, mean - margin, mean + margin)
