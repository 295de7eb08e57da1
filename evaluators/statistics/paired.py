"""Paired differences between renderers on shared scenes and seeds.

Two renderers meet the same scenes, seeds and noise, so the difference per cell is far less spread
than either value. Cells of one scene are not independent: differences are averaged per scene, and
the scene is the unit of interval and test.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.log.run_folder.sides import (
    Cell,
    RolloutTable,
    Row,
    Side,
    by_renderer,
    flat_row,
    metric_names,
)
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.results import (
    Bounds,
    CellCounts,
    Difference,
    DifferenceTable,
    MissingPair,
    SceneCounts,
    Verdict,
)
from evaluators.statistics.differences import (
    beyond_of,
    claim_of,
    difference_bounds,
    reach_of,
)
from evaluators.statistics.intervals import (
    LEAST_SCENES,
    ROUNDING,
    TOO_LARGE,
    cluster_means,
    mean_of,
    n_clusters,
    scaled,
    t_half_width,
    within,
)
from evaluators.statistics.variants import Variant, axis_bases, variants_in
from evaluators.statistics.verdicts import (
    MOST_SCENES,
    corrected,
    difference,
    harm,
    more_than,
    scenes_to_decide,
    scenes_to_differ,
    scenes_without_event,
    sign_flip,
    sign_test,
    verdict,
)

BLOCKS = ("paired", "paired_with_base", "paired_policies")  # tables of a summary
LISTED = 50  # missing cells named per metric; the count is always whole
NO_PAIR = "no scene and seed has this metric on both sides"


class Pair(NamedTuple):
    """A variant, the one that it is compared with, and what tables call the two."""

    key: str
    variant: Variant
    other: Variant
    baseline: str


def paired(
    rows: Sequence[Row],
    baseline: str,
    listed: int = LISTED,
) -> DifferenceTable:
    """Compare every renderer with a baseline, cell by cell; verdicts are corrected for the number
    of comparisons (`evaluators.statistics.verdicts.corrected`).

    Args:
        rows: As for `aggregate`.
        baseline: Renderer that the others are compared with.
        listed: How many missing cells to name per metric.

    Returns:
        RENDERER -> METRIC -> difference.

    Raises:
        InputError: No row has the baseline.
    """
    rows = [flat_row(row) for row in rows]
    sides = by_renderer(rows)
    if baseline not in sides:
        raise InputError(
            f"baseline {baseline!r}: no rollout has it",
            f"choose one of {', '.join(sides)}",
        )
    table = {
        renderer: {
            name: measure(side, sides[baseline], METRICS.info(name), baseline, listed=listed)
            for name in metric_names(rows)
        }
        for renderer, side in sides.items()
        if renderer != baseline
    }
    return decided_together({"paired": table}, METRICS)["paired"]


def pairs_within(
    table: RolloutTable, baseline: str | None, bases: Mapping[str, str]
) -> dict[str, list[Pair]]:
    """Return what is compared within a run, by the names of `BLOCKS`: renderers with a baseline,
    fixers with the renderer below them, and policies with one policy.

    Args:
        table: The rollouts.
        baseline: RENDERER, POLICY or RENDERER/POLICY that the others are compared with; what it
            does not name, or a policy did not meet, is the first of its kind.
        bases: Renderer with a fixer -> the renderer below it; where both were driven and neither is
            the baseline, the two are paired too.
    """
    variants = variants_in(table)
    by_renderer_base, by_policy_base = axis_bases(variants, baseline)
    of_renderers: list[Pair] = []
    of_fixers: list[Pair] = []
    of_policies: list[Pair] = []
    for policy in table.policies:
        of_policy = {variant.renderer: variant for variant in variants if variant.policy == policy}
        base = next(iter(of_policy))
        if by_renderer_base is not None and by_renderer_base.renderer in of_policy:
            base = by_renderer_base.renderer
        others = {name: base for name in of_policy if name != base}
        below = {
            name: other
            for name, other in bases.items()
            if {name, other} <= of_policy.keys() and base not in (name, other)
        }
        for pairs, partners in ((of_renderers, others), (of_fixers, below)):
            for name, other in partners.items():
                key = name if len(table.policies) == 1 else of_policy[name].name
                pairs.append(Pair(key, of_policy[name], of_policy[other], other))
    if by_policy_base is not None:
        of_policies += [
            Pair(variant.name, variant, partner, partner.name)
            for variant, partner in by_policy_base.pairs(variants)
        ]
    return dict(zip(BLOCKS, (of_renderers, of_fixers, of_policies), strict=True))


def compare_pairs(
    table: RolloutTable,
    blocks: Mapping[str, Sequence[Pair]],
    metric_table: MetricTable,
    base: RolloutTable | None = None,
    listed: int = LISTED,
) -> dict[str, DifferenceTable]:
    """Compare variants with variants, scene by scene and seed by seed; their policies may differ.
    Verdicts are corrected for the number of comparisons in all blocks.

    Args:
        table: The rollouts of the first variant of each pair.
        blocks: What is compared.
        metric_table: What the metrics are.
        base: The rollouts of the second variant of each pair; None: the same table.
        listed: How many missing cells to name per metric.

    Returns:
        BLOCK -> the pair's key -> METRIC -> difference.
    """
    sides = cache(table.sides)
    base_sides = sides if base is None else cache(base.sides)
    names = dict.fromkeys([*table.metrics, *(base or table).metrics])
    measured: dict[str, DifferenceTable] = {}
    for block, pairs in blocks.items():
        measured[block] = {}
        for key, variant, other, baseline in pairs:
            side = sides(variant.policy, variant.policy)[variant.renderer]
            base_side = base_sides(other.policy, variant.policy)[other.renderer]
            measured[block][key] = {
                name: measure(side, base_side, metric_table.info(name), baseline, listed=listed)
                for name in names
            }
    return decided_together(measured, metric_table)


def decided_together(
    measured: Mapping[str, DifferenceTable], metric_table: MetricTable
) -> dict[str, DifferenceTable]:
    """Decide about differences that are read together, with Holm's correction for their number.

    Args:
        measured: BLOCK -> VARIANT -> METRIC -> what `measure` gave.
        metric_table: What the metrics are.
    """
    p_values = {
        (block, variant, name): entry.p_value
        for block, table in measured.items()
        for variant, entries in table.items()
        for name, entry in entries.items()
    }
    p_corrected = corrected(p_values, metric_table.primary)
    n_tests = {
        is_primary: sum(
            p_value is not None and (name == metric_table.primary) == is_primary
            for (_, _, name), p_value in p_values.items()
        )
        for is_primary in (True, False)
    }
    return {
        block: {
            variant: {
                name: decide(
                    entry,
                    metric_table.info(name),
                    p_corrected[block, variant, name],
                    n_tests[name == metric_table.primary],
                )
                for name, entry in entries.items()
            }
            for variant, entries in table.items()
        }
        for block, table in measured.items()
    }


def compare(
    side: Side,
    base: Side,
    metric: MetricInfo,
    baseline: str,
    margin: float | None = None,
    listed: int = LISTED,
) -> Difference:
    """Compare one metric of two renderers on their shared cells, as the only question; the arguments
    are those of `measure`.
    """
    entry = measure(side, base, metric, baseline, margin, listed)
    return decide(entry, metric, entry.p_value)


def measure(
    side: Side,
    base: Side,
    metric: MetricInfo,
    baseline: str,
    margin: float | None = None,
    listed: int = LISTED,
) -> Difference:
    """Measure the difference of one metric between two renderers on their shared cells, with its
    test and its bounds; `decide` gives the verdict.

    Args:
        side, base: Their rollouts.
        metric: What is compared.
        baseline: What to call ``base``.
        margin: How much worse is accepted, in the metric's unit; None: its own margin.
        listed: How many missing cells to name.
    """
    margin = metric.accepted if margin is None else margin
    pairs = Pairs(side, base, metric.name)
    entry = Difference(
        baseline=baseline,
        unit=metric.unit,
        direction=metric.direction,
        margin=margin,
        n_cells=len(pairs.mine),
        n_scenes=n_clusters(pairs.scenes),
        n_missing=pairs.n_missing,
        missing=tuple(pairs.missing(metric.name, listed)),
    )
    if not len(pairs.mine):
        return replace(entry, reason=NO_PAIR)
    with np.errstate(over="ignore"):
        delta = pairs.mine - pairs.base
    if not np.isfinite(delta).all():
        return replace(entry, reason=TOO_LARGE)
    means = _scene_means(pairs, delta)
    entry = replace(
        entry,
        diff=mean_of(means),
        scenes=_scene_counts(means),
        cells=_cell_counts(pairs) if metric.is_flag else None,
    )
    if len(means) < 2:
        return replace(entry, reason=f"needs at least two scenes, found {len(means)}")
    return _bounded(_tested(entry, means, metric), delta, means, pairs.scenes, metric)


def _tested(entry: Difference, means: F64, metric: MetricInfo) -> Difference:
    """Add the test of a difference of zero over scenes, what it claims, and how far the means
    ``(G,)`` spread; where values are cut at a reach, mean and spread are those of the cut ones.
    """
    p_value, test = sign_flip(means)
    claim = claim_of(metric, entry.margin)
    counted = means
    if claim is not None:
        reach = reach_of(metric, entry.margin)
        counted = np.clip(means, -reach, reach)
    small, scale = scaled(counted)
    return replace(
        entry,
        p_value=p_value,
        test=test,
        claim=claim,
        cut_mean=None if claim is None else mean_of(counted),
        spread=scale * float(np.std(small, ddof=1)),
        beyond=beyond_of(means, metric, entry.margin),
    )


def _bounded(
    entry: Difference, delta: F64, means: F64, scenes: I64, metric: MetricInfo
) -> Difference:
    """Add the interval of a difference, or the reason why it has none.

    Args:
        entry: The difference.
        delta: ``(n,)`` differences of the cells.
        means: ``(G,)`` their means over each scene.
        scenes: ``(n,)`` numbers of the cells' scenes.
        metric: What is compared.
    """
    interval, guarded = difference_bounds(delta, means, scenes, metric, entry.margin)
    bounds = within(interval, *metric.difference_range).bounds
    entry = replace(
        entry,
        ci95=_pair_of(bounds),
        method=interval.method or None,
        guarded=_pair_of(guarded),
        note=interval.note or None,
    )
    if bounds is None:
        return replace(entry, reason=interval.reason, note=None)
    return entry


def decide(
    entry: Difference, metric: MetricInfo, p_corrected: float | None, n_tests: int = 1
) -> Difference:
    """Decide about a difference: what is shown on its scenes, and the verdict about others.

    Args:
        entry: What `measure` gave.
        metric: What was compared.
        p_corrected: Its p-value, corrected for what else is tested; None where there is no test.
        n_tests: How many differences are tested together.
    """
    if entry.diff is None or p_corrected is None:
        return entry
    entry = replace(
        entry,
        p_corrected=p_corrected,
        difference=difference(entry.diff, p_corrected, metric.direction),
    )
    if entry.difference is None and metric.direction != "none":
        entry = replace(entry, more_scenes_to_differ=_more_to_differ(entry, n_tests))
    if entry.ci95 is None:
        return entry
    answer, reasons = _verdict_about_others(entry, metric, p_corrected)
    notes = [*([entry.note] if entry.note else []), *reasons]
    entry = replace(entry, verdict=answer, note="; ".join(notes) or None)
    if answer != "undecided" or (metric.direction == "none" and entry.margin == 0.0):
        return entry
    return replace(entry, more_scenes=_more_scenes(entry, metric, n_tests))


def _verdict_about_others(
    entry: Difference, metric: MetricInfo, p_corrected: float
) -> tuple[Verdict, list[str]]:
    """Return the verdict about scenes that were not drawn, and what kept it from being another."""
    n, margin, guarded = entry.n_scenes, entry.margin, entry.guarded
    if n < LEAST_SCENES:
        return "undecided", [f"{n} scenes: a verdict needs at least {LEAST_SCENES}"]
    unguarded_bounds = _unguarded_bounds(entry, metric)
    bounds = guarded
    if metric.is_flag and guarded is not None and unguarded_bounds is not None:
        bounds = (min(unguarded_bounds[0], guarded[0]), max(unguarded_bounds[1], guarded[1]))
    answer = verdict(bounds, p_corrected, margin, metric.direction)
    unguarded = verdict(unguarded_bounds, p_corrected, margin, metric.direction)
    reasons = []
    if unguarded not in (answer, "undecided"):
        turned = "worse" if unguarded == "non-inferior" else "better"
        by = f"{reach_of(metric, margin):g} {metric.unit}".rstrip()
        reasons.append(f"{n} scenes cannot exclude that a few others are {turned} by up to {by}")
    return answer, reasons


def _unguarded_bounds(entry: Difference, metric: MetricInfo) -> Bounds | None:
    """Return the bounds that go by the spread of these scenes alone; None where they have none."""
    if metric.is_flag:
        return entry.ci95
    if entry.cut_mean is None or not entry.spread:
        return None
    half = t_half_width(entry.spread, entry.n_scenes)
    return entry.cut_mean - half, entry.cut_mean + half


def _more_to_differ(entry: Difference, n_tests: int) -> int | None:
    """Return how many more scenes would show a difference; None where none would."""
    if entry.diff is None or entry.spread is None:
        return None
    return more_than(scenes_to_differ(entry.diff, entry.spread, n_tests), entry.n_scenes)


def _more_scenes(entry: Difference, metric: MetricInfo, n_tests: int) -> int | None:
    """Return how many more scenes would decide an undecided difference; None where none would."""
    if entry.cut_mean is None or entry.spread is None:
        return None
    worse = abs(entry.cut_mean)
    if metric.direction != "none":
        worse, _ = harm((entry.cut_mean, entry.cut_mean), metric.direction)
    reach = reach_of(metric, entry.margin)
    needed = scenes_to_decide(worse, entry.spread, entry.margin, reach, n_tests)
    return more_than(needed, entry.n_scenes)


def _scene_means(pairs: Pairs, delta: F64) -> F64:
    """Return the mean difference of each scene ``(G,)`` from those of the cells ``(N,)``; what is
    only rounding is 0.
    """
    means, _ = cluster_means(delta, pairs.scenes)
    sizes, _ = cluster_means(np.abs(pairs.mine) + np.abs(pairs.base), pairs.scenes)
    means[np.abs(means) <= ROUNDING * sizes] = 0.0
    return means


def _scene_counts(means: F64) -> SceneCounts:
    up = int(np.sum(means > 0))
    down = int(np.sum(means < 0))
    return SceneCounts(up, down, len(means) - up - down, sign_test(up, down))


def _cell_counts(pairs: Pairs) -> CellCounts:
    gained = int(np.sum((pairs.mine > 0) & (pairs.base == 0)))
    lost = int(np.sum((pairs.mine == 0) & (pairs.base > 0)))
    return CellCounts(gained, lost, sign_test(gained, lost))


def _pair_of(bounds: Sequence[float] | None) -> Bounds | None:
    return None if bounds is None else (bounds[0], bounds[1])


def least_scenes(metric: MetricInfo, margin: float) -> int | None:
    """Return how many scenes without any difference `non-inferior` takes; None where none do."""
    needed = scenes_without_event(margin, reach_of(metric, margin) or math.inf)
    needed = max(needed, LEAST_SCENES)
    return int(needed) if needed <= MOST_SCENES else None


class Pairs:
    """Cells with a value on both sides, and those without."""

    def __init__(self, side: Side, base: Side, metric: str) -> None:
        values = side.values(metric)
        base_values = base.values(metric)
        self.index = side.place_in(base)
        self.values = values
        # The last value stands for cells that the base does not have: index -1.
        self.base_values = np.append(base_values, np.nan)[self.index]
        self.both: Bool = np.isfinite(self.values) & np.isfinite(self.base_values)
        self.mine = self.values[self.both]
        self.base = self.base_values[self.both]
        self.scenes = side.scene[self.both]
        self._sides = {"here": (side, values), "baseline": (base, base_values)}
        self.only_base = np.flatnonzero(base.place_in(side) < 0)
        self.n_missing = int(np.sum(~self.both)) + len(self.only_base)

    def missing(self, metric: str, listed: int) -> list[MissingPair]:
        """Name the first cells without a pair, with side and cause."""
        (side, _), (base, _) = self._sides.values()
        # Both sides are sorted already.
        cells = [side.cells[i] for i in np.flatnonzero(~self.both)[:listed].tolist()]
        cells += [base.cells[i] for i in self.only_base[:listed].tolist()]
        return [self.cause(cell, metric) for cell in sorted(cells)[:listed]]

    def cause(self, cell: Cell, metric: str) -> MissingPair:
        """Name a cell without a pair, with side and cause."""
        policy, scene, seed = cell
        (side, values), (base, base_values) = self._sides.values()
        reason = side.why_missing(cell, metric, values)
        base_reason = base.why_missing(cell, metric, base_values)
        if not base_reason:
            return MissingPair(policy, scene, seed, "here", f"here: {reason}")
        if not reason:
            return MissingPair(policy, scene, seed, "baseline", f"baseline: {base_reason}")
        why = f"here: {reason}; baseline: {base_reason}"
        if reason == base_reason:
            why = f"both: {reason}"
        return MissingPair(policy, scene, seed, "both", why)
