"""Where along one parameter of a scene a policy fails: which points of a grid are driven next, and
what the driven points say.

The first points stand evenly apart; wherever two driven neighbours differ in their outcome, points
between them are driven until they are neighbours of the grid. Nothing is assumed about how often the
outcome changes. A claim names driven points and how far apart they stand; between two neighbours that
differ the outcome changes at least once, and what is narrower than the distance of neighbours that do
not differ is not seen.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from alpasim_plugin.core.types import F64
from evaluators.statistics.intervals import median_rank

SPACINGS = 16  # between the first points of a range whose key names no spacing
PARTS = 4  # of a spacing: the distance of neighbours of the grid

Outcomes = Mapping[str, Sequence[Sequence[float]]]  # seed -> driven points, each with its outcome


@dataclass(frozen=True)
class Stretch:
    """Neighbouring driven points of a variant at which no seed, some seeds or all seeds fail.

    Attributes:
        low, high: Values of the parameter at its outermost points.
        points: How many were driven.
        least, most: Seeds that fail at a point, of ``seeds``.
        seeds: Number of seeds.
    """

    low: float
    high: float
    points: int
    least: int
    most: int
    seeds: int


@dataclass(frozen=True)
class Interval:
    """Values between which a median lies."""

    low: float
    high: float


@dataclass(frozen=True)
class Difference:
    """Outcomes of two variants at points that both have driven, paired by point and seed.

    Attributes:
        pairs: Their number.
        gained: Pairs of which the variant alone fails.
        lost: Pairs of which the baseline alone fails.
        anew: Over how much of the range the variant alone fails, each point standing for what is
            nearest to it; along two parameters as a share of the points of the grid. The mean over
            seeds.
        more: The same, less that over which the baseline alone fails.
    """

    pairs: int
    gained: int
    lost: int
    anew: float
    more: float


def next_points(
    failed: Mapping[int, bool], first: Iterable[int], skipped: set[int] | frozenset[int]
) -> list[int]:
    """Return the points of the grid that a seed drives next; none where its search has ended.

    Args:
        failed: Point -> whether the drive failed there.
        first: Points that are driven whatever happens.
        skipped: Points at which the scene cannot be built.
    """
    missing = [point for point in first if point not in failed and point not in skipped]
    return missing or middles_of_changes(failed, skipped)


def middles_of_changes(failed: Mapping[int, bool], skipped: set[int] | frozenset[int]) -> list[int]:
    """Return for each change of outcome the point in the middle of its driven neighbours, where there
    is one that can be built.
    """
    middles = []
    for low, high in changes_of(failed):
        inside = [point for point in range(low + 1, high) if point not in skipped]
        if inside:
            middles.append(min(inside, key=lambda point: (abs(2 * point - low - high), point)))
    return middles


def changes_of(failed: Mapping[int, bool]) -> list[tuple[int, int]]:
    """Return the neighbouring driven points between which the outcome changes."""
    points = sorted(failed)
    return [(low, high) for low, high in pairwise(points) if failed[low] != failed[high]]


def stretches_of(outcomes: Outcomes) -> list[Stretch]:
    """Return the stretches of a variant in order, over the points that every seed has driven.

    Args:
        outcomes: Of each seed its driven points: value of the parameter, whether it failed.
    """
    by_seed = [
        {value: bool(has_failed) for value, has_failed in seed} for seed in outcomes.values()
    ]
    shared = sorted(set.intersection(*(set(seed) for seed in by_seed))) if by_seed else []
    counts = [(value, sum(seed[value] for seed in by_seed)) for value in shared]
    stretches = []
    for _, group in groupby(counts, key=lambda pair: (pair[1] > 0) + (pair[1] == len(by_seed))):
        values, numbers = zip(*group, strict=True)
        stretches.append(
            Stretch(values[0], values[-1], len(values), min(numbers), max(numbers), len(by_seed))
        )
    return stretches


def widest_gap(outcomes: Outcomes) -> float:
    """Return the largest distance between neighbouring driven points of any seed."""
    gaps = [0.0]
    for points in outcomes.values():
        gaps += [high - low for low, high in pairwise(sorted(value for value, _ in points))]
    return max(gaps)


def median_boundary(outcomes: Outcomes) -> Interval | None:
    """Return an interval that holds the median boundary of seeds like these with 95 %, whatever their
    distribution (`evaluators.statistics.intervals.median_rank`); None unless each seed changes once,
    all in the same direction, and there are enough of them.
    """
    brackets = []
    directions = set()
    for points in outcomes.values():
        failed = {value: bool(has_failed) for value, has_failed in points}
        changes = [
            (low, high) for low, high in pairwise(sorted(failed)) if failed[low] != failed[high]
        ]
        if len(changes) != 1:
            return None
        brackets.append(changes[0])
        directions.add(failed[changes[0][0]])
    rank = median_rank(len(brackets))
    if len(directions) != 1 or rank == 0:
        return None
    lows, highs = (sorted(ends) for ends in zip(*brackets, strict=True))
    return Interval(lows[rank - 1], highs[-rank])


def difference_of(
    now: Outcomes, was: Outcomes, first: Sequence[Sequence[float]]
) -> Difference | None:
    """Compare two variants at the points that both have driven; None where they share no point.

    Args:
        now, was: Outcomes of the variant and of its baseline.
        first: Of each parameter its values at the first points. Of two parameters the points of this
            grid alone are counted, so that none stands for more than others.
    """
    gained, lost, pairs = 0, 0, 0
    by_seed = []
    for seed in sorted(set(now) & set(was)):
        sides = [
            {tuple(values): bool(has_failed) for *values, has_failed in side[seed]}
            for side in (now, was)
        ]
        shared = sorted(set(sides[0]) & set(sides[1]))
        if len(first) == 2:
            shared = [point for point in shared if point[0] in first[0] and point[1] in first[1]]
        if not shared:
            continue
        change = np.array([int(sides[0][point]) - int(sides[1][point]) for point in shared])
        pairs += len(shared)
        gained += int(np.sum(change > 0))
        lost += int(np.sum(change < 0))
        lengths = (
            np.full(len(shared), 1.0 / len(shared))
            if len(first) == 2
            else nearest_lengths([value for (value,) in shared])
        )
        by_seed.append([lengths @ np.maximum(change, 0), lengths @ change])
    if not by_seed:
        return None
    anew, more = np.mean(by_seed, axis=0).tolist()
    return Difference(pairs, gained, lost, anew, more)


def nearest_lengths(values: Sequence[float]) -> F64:
    """Return the length of the range that is nearest to each of some sorted values: half the distance
    to each neighbour.
    """
    halves = 0.5 * np.diff(np.asarray(values, dtype=float))
    return np.pad(halves, (0, 1)) + np.pad(halves, (1, 0))
