"""What changed on a suite. Its scenes are a list and both variants have the same seeds, so that a
difference is a fact and not a sample: an event that is new in one scene is new, and a distance is
compared with its margin.

Only where the policy is not repeatable may a change be chance. Then the sign of a cell's
difference is a fair coin if the variants are alike, whatever the distribution (sign-flip test).
All events are flipped together and the largest statistic counts (Westfall and Young,
Resampling-based multiple testing, 1993), and so are all other metrics; the two share 2.5 %, so
that six new events and none gone are just enough.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.types import F64, Bool, MetricInfo
from alpasim_plugin.log.run_folder.sides import Cell, Side
from evaluators.statistics.intervals import TAIL, cluster_means
from evaluators.statistics.verdicts import Verdict, flipped_sums, scenes_needed

ROUNDING = 1e-9  # a smaller difference, relative, may come from another processor
SCENE_MARGINS = 3.0  # that one scene may be worse
LISTED = 50  # cells named of a check; counts are always whole
EVENT_LEVEL = 2.0**-6  # six of six
LEVEL = TAIL - EVENT_LEVEL  # of the other metrics
MOST_SEEDS = 200


@dataclass(frozen=True)
class Change:
    """One metric in the cells of two variants.

    Attributes:
        metric: The metric.
        margin: How much worse is accepted, in its unit.
        cells: ``(N,)`` cells with a value on both sides.
        diff: ``(N,)`` variant minus baseline there, 0 where they are equal but for rounding.
        cut: Cells that an event has ended on one side only, where a value over part of a rollout
            would meet one over the whole.
        n_neither: Cells in which the metric has no value on either side.
        missing: Cells without a pair -> why.
    """

    metric: MetricInfo
    margin: float
    cells: tuple[Cell, ...]
    diff: F64
    cut: tuple[Cell, ...]
    n_neither: int
    missing: Mapping[Cell, str]

    @property
    def harm(self) -> F64:
        """Give the differences ``(N,)`` with the sign that makes positive worse; their size where
        any change of a flag without a better side counts.
        """
        if self.metric.direction == "none" and self.metric.is_flag:
            return np.abs(self.diff)
        return -self.diff if self.metric.direction == "higher" else self.diff

    @property
    def scenes(self) -> tuple[list[str], F64]:
        """Give the scenes and the mean harm ``(G,)`` of each over its seeds."""
        names = [scene for _, scene, _ in self.cells]
        if not names:
            return [], np.zeros(0)
        return sorted(set(names)), cluster_means(self.harm, names)[0]

    @property
    def mean(self) -> float:
        """Give the mean harm over scenes; 0 where no cell can be compared."""
        _, means = self.scenes
        return float(np.mean(means)) if len(means) else 0.0

    @property
    def is_beyond(self) -> bool:
        """Tell whether the mean over scenes is beyond the margin."""
        return self._size(self.mean) > self.margin + ROUNDING

    @property
    def far_scenes(self) -> list[str]:
        """Name the scenes that are more than `SCENE_MARGINS` margins worse, the worst first."""
        names, means = self.scenes
        sizes = self._size(means)
        worst = np.argsort(-sizes, kind="stable").tolist()
        return [names[i] for i in worst if sizes[i] > SCENE_MARGINS * self.margin + ROUNDING]

    def _size(self, harm: Any) -> Any:
        return np.abs(harm) if self.metric.direction == "none" else harm

    @property
    def new(self) -> list[Cell]:
        """Give the cells of a flag that have the event now and had not before; none of others."""
        if not self.metric.is_flag:
            return []
        return [self.cells[i] for i in np.flatnonzero(self.harm > 0).tolist()]

    @property
    def n_gone(self) -> int:
        """Count the cells of a flag that had the event and have it no more."""
        return int(np.sum(self.harm < 0))

    def counts(self) -> dict[str, int]:
        """Count cells: equal, and of a flag new and gone events, else worse and better by more than
        the margin.
        """
        equal = {"equal": int(np.sum(self.diff == 0))}
        if self.metric.is_flag:
            return equal | {"new": len(self.new), "gone": self.n_gone}
        worse = int(np.sum(self._size(self.harm) > self.margin + ROUNDING))
        better = self.harm < -self.margin - ROUNDING
        return equal | {
            "worse": worse,
            "better": 0 if self.metric.direction == "none" else int(np.sum(better)),
        }

    def worst(self) -> list[dict[str, Any]]:
        """Name the cells with a new event, or the scenes that are worse with their mean difference,
        the worst first.
        """
        if self.metric.is_flag:
            return [{"scene": scene, "seed": seed} for _, scene, seed in self.new[:LISTED]]
        names, means = self.scenes
        sizes = self._size(means)
        order = np.argsort(-sizes, kind="stable").tolist()
        sign = -1.0 if self.metric.direction == "higher" else 1.0
        return [
            {"scene": names[i], "diff": sign * float(means[i])}
            for i in order[:LISTED]
            if sizes[i] > 0.0
        ]


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
    here, there = side.values(metric.name), base.values(metric.name)
    index = side.place_in(base)
    is_shared = index >= 0
    # The last value stands for cells that the baseline does not have: index -1.
    partner = np.append(there, np.nan)[index]
    was_stopped = np.append(_any_of(base, stops), False)[index]
    is_cut = is_shared & (_any_of(side, stops) != was_stopped) & (not metric.is_flag)
    both = np.isfinite(here) & np.isfinite(partner) & ~is_cut
    ran = _ran(side) & np.append(_ran(base), False)[index]
    is_neither = ran & np.isnan(here) & np.isnan(partner) & ~is_cut
    missing = {}
    for i in np.flatnonzero(~(both | is_cut | is_neither)).tolist():
        missing[side.cells[i]] = _why(side.cells[i], metric.name, side, here, base, there)
    for i in np.flatnonzero(base.place_in(side) < 0).tolist():
        missing[base.cells[i]] = _why(base.cells[i], metric.name, side, here, base, there)
    diff = here[both] - partner[both]
    scale = np.maximum(1.0, np.maximum(np.abs(here[both]), np.abs(partner[both])))
    return Change(
        metric,
        margin,
        tuple(cell for cell, is_kept in zip(side.cells, both, strict=True) if is_kept),
        np.where(np.abs(diff) <= ROUNDING * scale, 0.0, diff),
        tuple(cell for cell, is_one in zip(side.cells, is_cut, strict=True) if is_one),
        int(np.sum(is_neither)),
        missing,
    )


def _any_of(side: Side, events: Sequence[str]) -> Bool:
    """Tell of every cell ``(C,)`` whether one of the events happened."""
    fired = np.zeros(len(side.cells), dtype=bool)
    for event in events:
        fired |= side.values(event) > 0  # a comparison with NaN is false
    return fired


def _ran(side: Side) -> Bool:
    """Tell of every cell ``(C,)`` whether all its rollouts ran to their end."""
    return np.bincount(side.cell, weights=~side.ok, minlength=len(side.cells)) == 0


def _why(cell: Cell, metric: str, side: Side, here: F64, base: Side, there: F64) -> str:
    reasons = {
        "the run": side.why_missing(cell, metric, here),
        "the baseline": base.why_missing(cell, metric, there),
    }
    return "; ".join(f"{name}: {why}" for name, why in reasons.items() if why)


def chances(changes: Sequence[Change]) -> list[float]:
    """Return for each metric the chance that any of its family (events, or other metrics) looks this
    much worse if the variants are alike; of a distance: if it is no worse than its margin.

    Args:
        changes: Of one variant, in all metrics that are tested.
    """
    numbers = {cell: i for i, cell in enumerate(sorted({c for one in changes for c in one.cells}))}
    p = [1.0] * len(changes)
    for is_flag in (True, False):
        rows, owners = [], []
        for owner, change in enumerate(changes):
            if change.metric.is_flag != is_flag:
                continue
            is_either = change.metric.direction == "none" and not is_flag
            for sign in (1.0, -1.0) if is_either else (1.0,):
                row = np.zeros(len(numbers))
                places = [numbers[cell] for cell in change.cells]
                row[places] = sign * change.harm - (0.0 if is_flag else change.margin)
                rows.append(row)
                owners.append(owner)
        found = flipped(np.array(rows).reshape(len(rows), len(numbers)))
        for owner, chance in zip(owners, found.tolist(), strict=True):
            p[owner] = min(p[owner], chance)
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
    """Judge a metric on a suite.

    Args:
        change: What changed.
        p: From `chances`; None where the policy is repeatable, so that nothing is chance.
        max_new: New events accepted.
    """
    is_flag = change.metric.is_flag
    if p is None:
        is_worse = len(change.new) > max_new if is_flag else change.is_beyond or change.far_scenes
        return "worse" if is_worse else "non-inferior"
    more = len(change.new) - change.n_gone
    if p <= EVENT_LEVEL and more > max_new if is_flag else p <= LEVEL:
        return "worse"
    return "non-inferior" if is_within(change) and not change.far_scenes else "undecided"


def is_within(change: Change) -> bool:
    """Tell whether a metric of a policy that is not repeatable is shown to be within its margin: its
    upper 97.5 % bound is.

    A distance takes the sign-flip test against its margin. The rate of a flag takes the bounds of
    Clopper and Pearson of new and of gone events, which also hold where scenes have other
    chances.
    """
    if change.metric.is_flag:
        return rate_bound(len(change.new), change.n_gone, len(change.cells)) < change.margin
    sides = [change.harm, -change.harm] if change.metric.direction == "none" else [change.harm]
    return all(flipped((change.margin - harm)[None])[0] <= TAIL for harm in sides)


def rate_bound(new: float, gone: float, n: float) -> float:
    """Return the upper 97.5 % bound of a rate's increase from new and gone events in n cells.

    Example:
        >>> round(rate_bound(0, 0, 42), 3)
        0.099
    """
    if n == 0:
        return 1.0
    tail = TAIL / 2
    upper = 1.0 if new >= n else float(scipy.special.betaincinv(new + 1, n - new, 1 - tail))
    lower = 0.0 if gone <= 0 else float(scipy.special.betaincinv(gone, n - gone + 1, tail))
    return upper - lower


def seeds_that_decide(change: Change) -> int | None:
    """Return about how many seeds a scene would decide, if more of them show the same; None where
    that is more than `MOST_SEEDS`.
    """
    n_scenes, n = len(change.scenes[0]), len(change.cells)
    if n == 0:
        return None
    if change.metric.is_flag:
        new, gone = len(change.new), change.n_gone
        for seeds in range(1, MOST_SEEDS + 1):
            more = seeds * n_scenes / n
            changed = round(more * (new + gone))
            chance = float(scipy.special.bdtr(round(more * gone), changed, 0.5))
            within = rate_bound(more * new, more * gone, more * n) < change.margin
            if within or (new > gone and chance <= EVENT_LEVEL):
                return seeds
        return None
    spread = float(np.std(change.harm, ddof=1)) if n > 1 else 0.0
    cells = scenes_needed(abs(change.margin - change.mean), spread)
    least = math.ceil(math.log2(1 / LEVEL))  # signs that can refute anything
    seeds = None if cells is None else math.ceil(max(cells, least) / n_scenes)
    return seeds if seeds is not None and seeds <= MOST_SEEDS else None
