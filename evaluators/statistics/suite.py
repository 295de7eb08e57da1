"""What changed on a suite. Its scenes are a list and both variants have the same seeds, so that a
difference is a fact and not a sample: an event that is new in one scene is new, and a distance is
compared with its margin.

Only where the policy is not repeatable may a change be chance (`evaluators.statistics.noise`). Then
a distance is judged by the mean of its cells cut at three margins, and what lies beyond is an event
of its own. Whether events are more frequent is tested by the signs of what changed: if the variants
are alike, each is a fair coin. All events are flipped together and the largest statistic counts
(Westfall and Young, Resampling-based multiple testing, 1993); all other metrics share another level
(Holm's method). Both levels make 2.5 %, so that six new events and none gone are just enough.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64, Bool, MetricInfo
from alpasim_plugin.log.run_folder.sides import Side
from evaluators.results import MissingPair, Verdict
from evaluators.statistics.intervals import TAIL, cluster_means, rate_at_most
from evaluators.statistics.noise import (
    CUT_MARGINS,
    Beyond,
    beyond,
    chance_at_margin,
    chance_at_rate,
    chance_within,
    cut,
    rejected_together,
    seeds_for_mean,
    seeds_for_rate,
)
from evaluators.statistics.paired import Pairs
from evaluators.statistics.verdicts import flipped_sums

ROUNDING = 1e-9  # a smaller difference, relative, may come from another processor
LISTED = 50  # cells named of a check; counts are always whole
NOISY_EVENTS = 6  # new ones of a policy that is not repeatable, and none gone, are red
EVENT_LEVEL = 2.0**-NOISY_EVENTS
LEVEL = TAIL - EVENT_LEVEL  # of the other metrics


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
    missing: Sequence[MissingPair]

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
        """Count the scenes that are more than `CUT_MARGINS` margins worse."""
        most = CUT_MARGINS * self.margin + ROUNDING
        return sum(int(np.sum(self.by_scene(harm) > most)) for harm in self.harms)

    @property
    def of_cells(self) -> list[F64]:
        """Give `harms` of the cells that are compared, ``(n,)`` each."""
        return [harm[self.is_pair] for harm in self.harms]

    @property
    def cut_mean(self) -> float:
        """Give the mean of the compared cells, each cut at `CUT_MARGINS` margins, with the sign that
        makes positive worse; 0 where there is none.
        """
        harms = self.of_cells[0]
        return float(np.mean(cut(harms, self.margin))) if len(harms) else 0.0

    @property
    def far_drives(self) -> list[Beyond]:
        """Give what lies beyond the cut, for each of `harms`."""
        return [beyond(harms, self.margin, ROUNDING) for harms in self.of_cells]

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
    is_run = ran(side) & np.append(ran(base), False)[pairs.index]
    is_neither = is_run & np.isnan(pairs.values) & np.isnan(pairs.base_values) & ~is_cut
    lone = [side.cells[i] for i in np.flatnonzero(~(is_pair | is_cut | is_neither)).tolist()]
    lone += [base.cells[i] for i in pairs.only_base.tolist()]
    missing = [pairs.cause(cell, metric.name) for cell in lone]
    n_short = int(np.sum(is_pair & is_stopped & was_stopped)) if not metric.is_flag else 0
    return Change(
        metric,
        margin,
        side,
        pairs.base_values,
        pairs.values,
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


def ran(side: Side) -> Bool:
    """Tell of every cell ``(C,)`` whether all its rollouts ran to their end."""
    return np.bincount(side.cell, weights=~side.ok, minlength=len(side.cells)) == 0


def chances(changes: Sequence[Change]) -> list[float]:
    """Return for each metric of a policy that is not repeatable a p-value: of an event, the chance
    that any event looks this much more frequent if the variants are alike; of another metric,
    against "its cut mean is within the margin".

    Args:
        changes: Of one variant, in all metrics that are tested.
    """
    p = [1.0] * len(changes)
    events = [i for i, change in enumerate(changes) if change.metric.is_flag]
    if events:
        shares = flipped(np.array([changes[i].harms[0] for i in events]))
        for i, chance in zip(events, shares.tolist(), strict=True):
            p[i] = chance
    for i, change in enumerate(changes):
        if not change.metric.is_flag:
            sides = [chance_within(harms, change.margin) for harms in change.of_cells]
            p[i] = min(1.0, len(sides) * min(sides))
    return p


@dataclass(frozen=True)
class Noise:
    """What the drives of a policy that is not repeatable show of one metric.

    Attributes:
        p_value: From `chances`.
        is_worse: The metric is worse.
        cut_mean: Mean of the cells cut at three margins, in the sign of the metric; None of an event.
        beyond: ``worse``, ``better`` and ``of`` count drives beyond the cut; ``at_most`` is the
            largest rate of worse ones that they leave open, one-sided 95 %. None of an event.
    """

    p_value: float
    is_worse: bool
    cut_mean: float | None
    beyond: JsonView | None


def noises_of(changes: Sequence[Change], max_new: Sequence[int]) -> list[Noise]:
    """Return what the drives of a policy that is not repeatable show.

    Args:
        changes: Of one variant, in all metrics that are tested.
        max_new: New events accepted of each.
    """
    p_values = chances(changes)
    others = [i for i, change in enumerate(changes) if not change.metric.is_flag]
    rejected = rejected_together([p_values[i] for i in others], LEVEL)
    is_rejected = dict(zip(others, rejected, strict=True))
    level = LEVEL / max(len(others), 1)
    noises = []
    for i, change in enumerate(changes):
        if change.metric.is_flag:
            is_more = change.n_new - change.n_gone > max_new[i]
            is_worse = p_values[i] <= EVENT_LEVEL and is_more
            noises.append(Noise(p_values[i], is_worse, None, None))
            continue
        drives = change.far_drives
        is_worse = is_rejected[i] or any(one_side.is_red(level) for one_side in drives)
        sign = -1.0 if change.metric.direction == "higher" else 1.0
        counts = {
            "worse": sum(one_side.n_worse for one_side in drives),
            "better": drives[0].n_better if len(drives) == 1 else 0,
            "of": drives[0].n,
        }
        at_most = rate_at_most(counts["worse"], counts["of"])
        noises.append(
            Noise(p_values[i], is_worse, sign * change.cut_mean, counts | {"at_most": at_most})
        )
    return noises


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
    observed = scaled.sum(axis=1)
    out = np.ones(len(rows))
    if is_used.any():
        sums, first = flipped_sums(scaled)
        reached = np.sum(np.max(sums, axis=1)[:, None] >= observed - ROUNDING, axis=0)
        out[is_used] = (first + reached) / (first + len(sums))
    return out


def verdict_of(change: Change, max_new: int, noise: Noise | None) -> Verdict:
    """Decide about a metric on a suite.

    Args:
        change: What changed.
        max_new: New events accepted.
        noise: What drives show; None where the policy is repeatable, so that nothing is chance.
    """
    is_flag = change.metric.is_flag
    if noise is None:
        is_beyond = change.n_new > max_new if is_flag else change.is_beyond or change.n_far
        return "worse" if is_beyond else "non-inferior"
    if noise.is_worse:
        return "worse"
    return "non-inferior" if is_within(change) else "undecided"


def is_within(change: Change) -> bool:
    """Tell whether a metric of a policy that is not repeatable is shown to be within its margin: a
    distance by the mean of its cut cells and without a drive beyond the cut that none answers, an
    event by the exact test of its rate.
    """
    if change.metric.is_flag:
        n = int(np.sum(change.is_pair))
        return chance_at_rate(change.n_new, change.n_gone, n, change.margin) <= TAIL
    if not all(drives.is_answered for drives in change.far_drives):
        return False
    return all(chance_at_margin(harms, change.margin) <= TAIL for harms in change.of_cells)


def seeds_that_decide(change: Change) -> int | None:
    """Return about how many seeds a scene would show that a metric is within its margin, if more of
    them show the same; None where no number that can be asked for does.
    """
    n = int(np.sum(change.is_pair))
    n_scenes = len(change.by_scene(change.now)) if n else 0
    if n == 0:
        return None
    if change.metric.is_flag:
        return seeds_for_rate(change.n_new, change.n_gone, n, change.margin, n_scenes)
    if not all(drives.is_answered for drives in change.far_drives):
        return None
    needed = [seeds_for_mean(harms, change.margin, n_scenes) for harms in change.of_cells]
    numbers = [seeds for seeds in needed if seeds is not None]
    return max(numbers) if len(numbers) == len(needed) else None
