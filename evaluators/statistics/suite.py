"""What changed on a suite. Its scenes are a list and both variants have the same seeds, so that a
difference is a fact and not a sample: an event that is new in one scene is new, and a distance is
compared with its margin.

Only where the policy is not repeatable may a change be chance. Then the sign of a cell's
difference is a fair coin if the variants are alike, whatever the distribution (sign-flip test).
All events are flipped together and the largest statistic counts (Westfall and Young,
Resampling-based multiple testing, 1993), and so are all other metrics; the two share 2.5 %, so
that six new events and none gone are just enough.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64, Bool, MetricInfo
from alpasim_plugin.log.run_folder.sides import Side
from evaluators.statistics.intervals import TAIL, cluster_means, exact_rate
from evaluators.statistics.paired import Pairs
from evaluators.statistics.verdicts import Verdict, flipped_sums

ROUNDING = 1e-9  # a smaller difference, relative, may come from another processor
SCENE_MARGINS = 3.0  # that one scene may be worse
LISTED = 50  # cells named of a check; counts are always whole
EVENT_LEVEL = 2.0**-6  # six of six
LEVEL = TAIL - EVENT_LEVEL  # of the other metrics
MOST_SEEDS = 100  # that are asked for


@dataclass(frozen=True)
class Change:
    """One metric of a variant and of its baseline.

    Attributes:
        metric: The metric.
        margin: How much worse is accepted, in its unit.
        side: The variant, whose C cells (scene and seed) the arrays are about.
        was, now: ``(C,)`` values of baseline and variant; NaN where there is none.
        is_pair: ``(C,)`` cells that are compared.
        is_cut: ``(C,)`` cells that an event has ended on one side only, where a value over part of
            a rollout would meet one over the whole.
        n_neither: Cells in which the metric has no value on either side.
        n_short: Compared cells that an event has ended on both sides.
        missing: Cells without a pair, and why.
    """

    metric: MetricInfo
    margin: float
    side: Side
    was: F64
    now: F64
    is_pair: Bool
    is_cut: Bool
    n_neither: int
    n_short: int
    missing: Sequence[JsonView]

    @property
    def harms(self) -> list[F64]:
        """Give the differences ``(C,)`` with the sign that makes positive worse, 0 where there is no
        pair; with either sign where no side is better.
        """
        diff = np.where(self.is_pair, self.now - self.was, 0.0)
        size = np.fmax(1.0, np.fmax(np.abs(self.now), np.abs(self.was)))
        diff[np.abs(diff) <= ROUNDING * size] = 0.0
        if self.metric.direction == "none":
            return [np.abs(diff)] if self.metric.is_flag else [diff, -diff]
        return [-diff if self.metric.direction == "higher" else diff]

    def by_scene(self, values: F64) -> F64:
        """Return the means ``(G,)`` of values ``(C,)`` over the compared seeds of each scene."""
        return cluster_means(values[self.is_pair], self.side.scene[self.is_pair])[0]

    @property
    def mean(self) -> float:
        """Give the mean of the first of `harms` over scenes; 0 where there is no pair."""
        return float(np.mean(self.by_scene(self.harms[0]))) if self.is_pair.any() else 0.0

    @property
    def is_beyond(self) -> bool:
        """Tell whether the mean over scenes is worse than the margin."""
        size = abs(self.mean) if len(self.harms) == 2 else self.mean
        return size > self.margin + ROUNDING

    @property
    def n_far(self) -> int:
        """Count the scenes that are more than `SCENE_MARGINS` margins worse."""
        most = SCENE_MARGINS * self.margin + ROUNDING
        return sum(int(np.sum(self.by_scene(harm) > most)) for harm in self.harms)

    def beyond(self, margin: float) -> Bool:
        """Return the cells ``(C,)`` that are worse by more than a margin."""
        return np.any([harm > margin + ROUNDING for harm in self.harms], axis=0)

    @property
    def n_new(self) -> int:
        """Count new events."""
        return int(np.sum(self.beyond(0.0)))

    @property
    def n_gone(self) -> int:
        """Count the events that the baseline had alone."""
        return int(np.sum(self.harms[0] < 0.0))

    def worst(self) -> list[JsonObject]:
        """Name the cells that are worse, the worst first."""
        harm = np.max(self.harms, axis=0)
        order = np.argsort(-harm, kind="stable")[: int(np.sum(harm > 0.0))]
        return [self._named(i) for i in order[:LISTED].tolist()]

    def _named(self, i: int) -> JsonObject:
        _, scene, seed = self.side.cells[i]
        return {"scene": scene, "seed": seed, "was": self.was[i], "now": self.now[i]}


def change_of(
    side: Side, base: Side, metric: MetricInfo, margin: float, stops: Sequence[str]
) -> Change:
    """Return how a metric changed from a baseline.

    Args:
        side, base: Rollouts of the variant and of its baseline.
        metric: The metric.
        margin: How much worse is accepted.
        stops: Events after which the preset scores nothing.
    """
    pairs = Pairs(side, base, metric.name)
    is_shared = pairs.index >= 0
    was_stopped = np.append(_any_of(base, stops), False)[pairs.index]
    is_stopped = _any_of(side, stops)
    is_cut = is_shared & (is_stopped != was_stopped) & (not metric.is_flag)
    is_pair = pairs.both & ~is_cut
    ran = _ran(side) & np.append(_ran(base), False)[pairs.index]
    is_neither = ran & np.isnan(pairs.here) & np.isnan(pairs.there) & ~is_cut
    lone = [side.cells[i] for i in np.flatnonzero(~(is_pair | is_cut | is_neither)).tolist()]
    lone += [base.cells[i] for i in pairs.only_base.tolist()]
    missing = [pairs.cause(cell, metric.name) for cell in lone]
    n_short = int(np.sum(is_pair & is_stopped & was_stopped)) if not metric.is_flag else 0
    return Change(
        metric,
        margin,
        side,
        pairs.there,
        pairs.here,
        is_pair,
        is_cut,
        int(np.sum(is_neither)),
        n_short,
        missing,
    )


def _any_of(side: Side, events: Sequence[str]) -> Bool:
    """Tell of every cell ``(C,)`` whether one of the events happened."""
    values = [np.zeros(len(side.cells)), *(side.values(event) for event in events)]
    return np.any(np.array(values) > 0.0, axis=0)


def _ran(side: Side) -> Bool:
    """Tell of every cell ``(C,)`` whether all its rollouts ran to their end."""
    return np.bincount(side.cell, weights=~side.ok, minlength=len(side.cells)) == 0


def chances(changes: Sequence[Change]) -> list[float]:
    """Return for each metric the chance that any of its family (events, or other metrics) looks this
    much worse if the variants are alike; of a distance: if it is no worse than its margin.

    Args:
        changes: Of one variant, in all metrics that are tested.
    """
    p = [1.0] * len(changes)
    for is_flag in (True, False):
        family = [
            (i, np.where(change.is_pair, harm - (0.0 if is_flag else change.margin), 0.0))
            for i, change in enumerate(changes)
            for harm in change.harms
            if change.metric.is_flag == is_flag
        ]
        if family:
            found = flipped(np.array([row for _, row in family]))
            for (i, _), chance in zip(family, found.tolist(), strict=True):
                p[i] = min(p[i], chance)
    return p


def flipped(rows: F64) -> F64:
    """Return the chance ``(M,)`` that the largest of M sums, each as a share of its norm, is as
    large as each one's if the columns' signs are fair coins.

    Args:
        rows: ``(M, N)`` differences of N cells in M metrics.

    Example:
        >>> float(flipped(np.ones((1, 6)))[0])  # six of six: 1 / 64
        0.015625
    """
    changed = rows[:, np.any(rows != 0.0, axis=0)]
    norms = np.sqrt(np.sum(changed**2, axis=1))
    is_used = norms > 0.0
    scaled = changed[is_used] / norms[is_used, None]
    seen = scaled.sum(axis=1)
    out = np.ones(len(rows))
    if is_used.any():
        sums, first = flipped_sums(scaled)
        reached = np.sum(np.max(sums, axis=1)[:, None] >= seen - ROUNDING, axis=0)
        out[is_used] = (first + reached) / (first + len(sums))
    return out


def verdict_of(change: Change, p: float | None, max_new: int) -> Verdict:
    """Decide about a metric on a suite.

    Args:
        change: What changed.
        p: From `chances`; None where the policy is repeatable, so that nothing is chance.
        max_new: New events accepted.
    """
    is_flag = change.metric.is_flag
    if p is None:
        is_worse = change.n_new > max_new if is_flag else change.is_beyond or change.n_far
        return "worse" if is_worse else "non-inferior"
    more = change.n_new - change.n_gone
    if p <= EVENT_LEVEL and more > max_new if is_flag else p <= LEVEL:
        return "worse"
    return "non-inferior" if is_within(change) and not change.n_far else "undecided"


def is_within(change: Change) -> bool:
    """Tell whether a metric of a policy that is not repeatable is shown to be within its margin: a
    distance by the sign-flip test against it, a rate by `rate_bound`.
    """
    if change.metric.is_flag:
        n = int(np.sum(change.is_pair))
        return rate_bound(change.n_new, change.n_gone, n) < change.margin
    rows = [np.where(change.is_pair, change.margin - harm, 0.0)[None] for harm in change.harms]
    return all(flipped(row)[0] <= TAIL for row in rows)


def rate_bound(new: float, gone: float, n: int) -> float:
    """Return an upper bound of a rate's increase from new and gone events in n cells, by the bounds
    of Clopper and Pearson, which also hold where scenes have other chances.

    Example:
        >>> round(rate_bound(0, 0, 36), 3)
        0.097
    """
    return exact_rate(new, n)[1] - exact_rate(gone, n)[0] if n else 1.0


def seeds_that_decide(change: Change) -> int | None:
    """Return about how many seeds a scene would show that a metric is within its margin, if more of
    them show the same; None where that is more than `MOST_SEEDS`.
    """
    n = int(np.sum(change.is_pair))
    n_scenes = len(change.by_scene(change.now))
    if n < 2:
        return None
    for seeds in range(1, MOST_SEEDS + 1):
        cells = seeds * n_scenes
        more = cells / n
        if change.metric.is_flag:
            is_shown = rate_bound(more * change.n_new, more * change.n_gone, cells) < change.margin
        else:
            error = float(np.std(change.harms[0][change.is_pair], ddof=1)) / math.sqrt(cells)
            is_shown = abs(change.mean) + 2.0 * error < change.margin and 2.0**-cells <= TAIL
        if is_shown:
            return seeds
    return None
