"""Paired differences between renderers on shared scenes and seeds.

Two renderers meet the same scenes, seeds and noise, so the difference per cell is far less spread
than either value. Cells of one scene are not independent: differences are averaged per scene, and
the scene is the unit of interval and test.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.log.run_folder.sides import (
    Cell,
    RolloutTable,
    Row,
    Side,
    by_renderer,
    metric_names,
)
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.statistics.bounded import mean_bounds, upper_bound
from evaluators.statistics.intervals import (
    FEW_SCENES,
    ROUNDING,
    TOO_LARGE,
    Interval,
    are_alike,
    cluster_means,
    mean_of,
    n_clusters,
    paired_rate,
    scaled,
    t_interval,
    within,
)
from evaluators.statistics.variants import Variant, axis_bases, variants_in
from evaluators.statistics.verdicts import (
    BEYOND,
    LEAST_SCENES,
    MOST_SCENES,
    REACH,
    difference,
    harm,
    more_scenes,
    scenes_without_event,
    sign_flip,
    sign_test,
    verdict,
)

Table = dict[str, dict[str, JsonObject]]  # RENDERER -> METRIC -> numbers

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
) -> Table:
    """Compare every renderer with a baseline, cell by cell.

    Args:
        rows: As for `aggregate`.
        baseline: Renderer that the others are compared with.
        listed: How many missing cells to name per metric.

    Returns:
        RENDERER -> METRIC -> what `compare` gives.

    Raises:
        InputError: No row has the baseline.
    """
    sides = by_renderer(rows)
    if baseline not in sides:
        raise InputError(
            f"baseline {baseline!r}: no rollout has it",
            f"choose one of {', '.join(sides)}",
        )
    return {
        renderer: {
            name: compare(side, sides[baseline], METRICS.info(name), baseline, listed=listed)
            for name in metric_names(rows)
        }
        for renderer, side in sides.items()
        if renderer != baseline
    }


def pairs_within(
    table: RolloutTable, baseline: str | None, bases: Mapping[str, str]
) -> list[list[Pair]]:
    """Return what is compared within a run: renderers with a baseline, fixers with the renderer
    below them, and policies with one policy.

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
        own = {variant.renderer: variant for variant in variants if variant.policy == policy}
        base = next(iter(own))
        if by_renderer_base is not None and by_renderer_base.renderer in own:
            base = by_renderer_base.renderer
        others = {name: base for name in own if name != base}
        below = {
            name: other
            for name, other in bases.items()
            if {name, other} <= own.keys() and base not in (name, other)
        }
        for pairs, partners in ((of_renderers, others), (of_fixers, below)):
            for name, other in partners.items():
                key = name if len(table.policies) == 1 else own[name].name
                pairs.append(Pair(key, own[name], own[other], other))
    if by_policy_base is not None:
        of_policies += [
            Pair(variant.name, variant, partner, partner.name)
            for variant, partner in by_policy_base.pairs(variants)
        ]
    return [of_renderers, of_fixers, of_policies]


def compare_pairs(
    table: RolloutTable,
    pairs: Sequence[Pair],
    known: MetricTable,
    base: RolloutTable | None = None,
    listed: int = LISTED,
) -> Table:
    """Compare variants with variants, scene by scene and seed by seed; their policies may differ.

    Args:
        table: The rollouts of the first variant of each pair.
        pairs: What is compared.
        known: What the metrics are.
        base: The rollouts of the second variant of each pair; None: the same table.
        listed: How many missing cells to name per metric.

    Returns:
        The pair's key -> METRIC -> what `compare` gives.
    """
    sides = cache(table.sides)
    base_sides = sides if base is None else cache(base.sides)
    names = dict.fromkeys([*table.metrics, *(base or table).metrics])
    out: Table = {}
    for key, variant, other, baseline in pairs:
        side = sides(variant.policy, variant.policy)[variant.renderer]
        base_side = base_sides(other.policy, variant.policy)[other.renderer]
        out[key] = {
            name: compare(side, base_side, known.info(name), baseline, listed=listed)
            for name in names
        }
    return out


def compare(
    side: Side,
    base: Side,
    metric: MetricInfo,
    baseline: str,
    margin: float | None = None,
    listed: int = LISTED,
) -> JsonObject:
    """Compare one metric of two renderers on their shared cells.

    Args:
        side, base: Their rollouts.
        metric: What is compared.
        baseline: What to call ``base``.
        margin: How much worse is accepted, in the metric's unit; None: its own margin.
        listed: How many missing cells to name.

    Returns:
        ``baseline``; ``diff`` (``side`` minus ``base``: mean over scenes of the scene's mean difference);
        ``ci95`` ([low, high], scenes as unit) and its ``method``; ``guarded`` (the bounds that a
        verdict and a difference must hold for as well, or None, with which nothing is decided:
        `difference_bounds`); ``p_value`` and ``test``; ``margin`` and ``verdict`` (non-inferior,
        worse, undecided); ``difference`` (better, worse, none shown; independent of the margin);
        ``more_scenes`` (how many would decide an undecided verdict, else None); ``spread``
        (standard deviation of the difference between scenes); ``scenes`` (``up``, ``down``,
        ``same``, and ``p_value`` of their exact sign test); for flags ``cells`` (``only_here``,
        ``only_baseline``, and the exact McNemar ``p_value``, as if cells were independent);
        ``n_cells``, ``n_scenes``, ``n_missing`` and ``missing`` (planned cells without a pair:
        cell, side, why); ``unit``, ``direction``; ``reason`` where numbers are None, ``note`` where
        they need care.
    """
    margin = metric.accepted if margin is None else margin
    pairs = Pairs(side, base, metric.name)
    entry: JsonObject = {
        "baseline": baseline,
        "diff": None,
        "ci95": None,
        "method": None,
        "guarded": None,
        "p_value": None,
        "test": None,
        "margin": margin,
        "verdict": "undecided",
        "difference": "none shown",
        "more_scenes": None,
        "n_cells": len(pairs.mine),
        "n_scenes": n_clusters(pairs.scenes),
        "n_missing": pairs.n_missing,
        "missing": pairs.missing(metric.name, listed),
        "unit": metric.unit,
        "direction": metric.direction,
    }
    if not len(pairs.mine):
        return entry | {"reason": NO_PAIR}
    with np.errstate(over="ignore"):
        delta = pairs.mine - pairs.base
    if not np.isfinite(delta).all():
        return entry | {"reason": TOO_LARGE}
    means, _ = cluster_means(delta, pairs.scenes)
    sizes, _ = cluster_means(np.abs(pairs.mine) + np.abs(pairs.base), pairs.scenes)
    means[np.abs(means) <= ROUNDING * sizes] = 0.0
    n = len(means)
    up = int(np.sum(means > 0))
    down = int(np.sum(means < 0))
    entry["scenes"] = {
        "up": up,
        "down": down,
        "same": n - up - down,
        "p_value": sign_test(up, down),
    }
    if metric.is_flag:
        gained = int(np.sum((pairs.mine > 0) & (pairs.base == 0)))
        lost = int(np.sum((pairs.mine == 0) & (pairs.base > 0)))
        entry["cells"] = {
            "only_here": gained,
            "only_baseline": lost,
            "p_value": sign_test(gained, lost),
        }
    entry["diff"] = mean_of(means)
    if n < 2:
        return entry | {"reason": f"needs at least two scenes, found {n}"}
    p, test = sign_flip(means)
    small, scale = scaled(means)
    spread = scale * float(np.std(small, ddof=1))
    shown = difference(entry["diff"], p, metric.direction)
    entry |= {"spread": spread, "p_value": p, "test": test, "difference": shown}
    interval, guarded = difference_bounds(delta, means, pairs.scenes, metric, margin)
    bounds = within(interval, *metric.difference_range).bounds
    entry |= {"ci95": bounds, "method": interval.method or None, "guarded": guarded}
    if bounds is None:
        return entry | {"reason": interval.reason}
    reach = reach_of(metric, margin)
    rare = beyond_share(metric, margin)
    notes = [interval.note] if interval.note else []
    both = bounds
    if guarded is not None:
        both = [min(bounds[0], guarded[0]), max(bounds[1], guarded[1])]
    if rare:
        entry["beyond"] = _beyond(pairs, Pairs(side, base, metric.event), metric, reach)
        entry["beyond"]["margin"] = rare
    if n < LEAST_SCENES:
        notes.append(f"{n} scenes: a verdict needs at least {LEAST_SCENES}")
    elif guarded is None:
        notes.append(
            "nothing says how much a scene can differ, so that nothing is decided without a margin"
        )
    else:
        entry["verdict"] = verdict(both, p, margin, metric.direction)
        seen = verdict(bounds, p, margin, metric.direction)
        if seen != entry["verdict"]:
            turned = "worse" if seen == "non-inferior" else "better"
            by = f"{reach:g} {metric.unit}".rstrip()
            notes.append(f"{n} scenes cannot exclude that a few others are {turned} by up to {by}")
        if entry["verdict"] == "non-inferior" and rare and entry["beyond"]["at_most"] >= rare:
            entry["verdict"] = "undecided"
            what = f"{entry['beyond']['event']} in more than {100 * rare:.3g} % of others"
            notes.append(f"{n} scenes cannot exclude {what}")
    if notes:
        entry["note"] = "; ".join(notes)
    if entry["verdict"] == "undecided" and (metric.direction != "none" or margin > 0.0):
        worse = abs(entry["diff"])
        if metric.direction != "none":
            worse, _ = harm([entry["diff"]] * 2, metric.direction)
        entry["more_scenes"] = more_scenes(worse, spread, n, margin, reach or None, rare)
    return entry


def _beyond(pairs: Pairs, left: Pairs, metric: MetricInfo, reach: float) -> JsonObject:
    """Return the companion of a distance: how much more often something happens that it does not
    count, by the metric's event where a preset has it, else by differences beyond ``reach``.

    Returns:
        ``event`` in words, ``diff`` (share of scenes, positive is worse), ``at_most`` (its upper
        guarded bound).
    """
    what, scenes, change = metric.event, left.scenes, left.mine - left.base
    if not len(change):
        what = f"more than {reach:g} {metric.unit}".rstrip()
        scenes = pairs.scenes
        far = pairs.mine - pairs.base
        worse = {"none": np.abs(far), "lower": far, "higher": -far}[metric.direction]
        change = np.where(worse > reach, 1.0, 0.0) - np.where(worse < -reach, 1.0, 0.0)
    means, _ = cluster_means(change, scenes)
    return {"event": what, "diff": mean_of(means), "at_most": upper_bound(means, 1.0)}


def difference_bounds(
    delta: F64, means: F64, scenes: I64, metric: MetricInfo, margin: float
) -> tuple[Interval, list[float] | None]:
    """Return the interval of a mean difference, and the guarded bounds that a verdict must hold for
    too; None where there are none.

    Rates take the interval of `flag_interval`, other quantities with bounds that of
    `evaluators.statistics.bounded`, all others t. The guarded bounds allow for scenes at the worst
    possible value that were not drawn; without bounds, differences are cut to `reach_of`.

    Args:
        delta: ``(N,)`` differences per cell.
        means: ``(G,)`` their means per scene, at least two.
        scenes: Scene of each cell.
        metric: What it is.
        margin: How much worse is accepted.
    """
    n = len(means)
    reach = reach_of(metric, margin)
    guarded = list(mean_bounds(means, -reach, reach)) if reach else None
    if metric.is_flag:
        return flag_interval(delta, scenes), guarded
    plain = t_interval(means, "scenes")
    if guarded is None or not (are_alike(means) or np.isfinite(metric.difference_range).all()):
        return plain, guarded
    note = (
        f"all {n} scenes are equal, so that they have no spread to go by"
        if are_alike(means)
        else ""
    )
    method = f"mean of scenes that differ by at most {reach:g} {metric.unit}".rstrip()
    return Interval(plain.centre, guarded[0], guarded[1], note=note, method=method), guarded


def flag_interval(delta: F64, scenes: I64) -> Interval:
    """Return the interval of a difference of rates from ``(N,)`` differences per cell, in [-1, 1],
    and their scenes; never without width.

    The rates of cells that gained and that lost the event get their own intervals
    (`mean_bounds`), which are joined by the method of variance estimates recovery (Zou and
    Donner, Statistics in Medicine 27, 2008). Below `FEW_SCENES` scenes it is Tango's interval, with
    scenes as pairs.
    """
    gained, _ = cluster_means(np.maximum(delta, 0.0), scenes)
    lost, _ = cluster_means(np.maximum(-delta, 0.0), scenes)
    n, up, down = len(gained), float(np.mean(gained)), float(np.mean(lost))
    changed = int(np.sum((gained > 0) | (lost > 0)))
    note = f"{changed} of {n} scenes changed" if changed < LEAST_SCENES else ""
    if n < FEW_SCENES:
        bounds = paired_rate(n * up, n * down, n)
        return Interval(up - down, *bounds, note=note, method="Tango, scenes as pairs")
    (up_low, up_high), (down_low, down_high) = (
        mean_bounds(rates, 0.0, 1.0) for rates in (gained, lost)
    )
    low = max(up - down - math.hypot(up - up_low, down_high - down), -1.0)
    high = min(up - down + math.hypot(up_high - up, down - down_low), 1.0)
    return Interval(up - down, low, high, note=note, method="gained and lost rates joined")


def reach_of(metric: MetricInfo, margin: float) -> float:
    """Return how much worse a scene can be, in the metric's unit; 0 where nothing says so.

    Where differences have no bounds it is the metric's cap, else `REACH` times its own margin, or
    the given one where it has none.
    """
    most = max(metric.difference_range)
    if math.isfinite(most):
        return float(most)
    return REACH * (metric.accepted or margin) if metric.cap is None else metric.cap


def beyond_share(metric: MetricInfo, margin: float) -> float:
    """Return in how many more scenes a metric may differ by more than `reach_of` and still be
    non-inferior: if these are worse by `BEYOND` times as much, the margin holds. 0 where none can.
    """
    reach = reach_of(metric, margin)
    if reach == 0.0 or math.isfinite(max(metric.difference_range)):
        return 0.0
    return max(margin, metric.accepted) / (BEYOND * reach)


def least_scenes(metric: MetricInfo, margin: float) -> int | None:
    """Return how many scenes without any difference `non-inferior` takes; None where none do."""
    rare = beyond_share(metric, margin)
    needed = scenes_without_event(margin, reach_of(metric, margin) or math.inf)
    needed = max(needed, scenes_without_event(rare) if rare else 0, LEAST_SCENES)
    return int(needed) if needed <= MOST_SCENES else None


class Pairs:
    """Cells with a value on both sides, and those without."""

    def __init__(self, side: Side, base: Side, metric: str) -> None:
        here = side.values(metric)
        there = base.values(metric)
        self.index = side.place_in(base)
        self.here = here
        # The last value stands for cells that the base does not have: index -1.
        self.there = np.append(there, np.nan)[self.index]
        self.both: Bool = np.isfinite(self.here) & np.isfinite(self.there)
        self.mine = self.here[self.both]
        self.base = self.there[self.both]
        self.scenes = side.scene[self.both]
        self._sides = {"here": (side, here), "baseline": (base, there)}
        self.only_base = np.flatnonzero(base.place_in(side) < 0)
        self.n_missing = int(np.sum(~self.both)) + len(self.only_base)

    def missing(self, metric: str, listed: int) -> list[JsonObject]:
        """Name the first cells without a pair, with side and cause."""
        (side, _), (base, _) = self._sides.values()
        # Both sides are sorted already.
        cells = [side.cells[i] for i in np.flatnonzero(~self.both)[:listed].tolist()]
        cells += [base.cells[i] for i in self.only_base[:listed].tolist()]
        return [self.cause(cell, metric) for cell in sorted(cells)[:listed]]

    def cause(self, cell: Cell, metric: str) -> JsonObject:
        """Name a cell without a pair, with side and cause."""
        policy, scene, seed = cell
        causes = {
            name: side.why_missing(cell, metric, values)
            for name, (side, values) in self._sides.items()
        }
        reasons = {name: text for name, text in causes.items() if text}
        why = "; ".join(f"{name}: {text}" for name, text in reasons.items())
        if causes["here"] == causes["baseline"]:
            why = f"both: {causes['here']}"
        return {
            "policy": policy,
            "scene": scene,
            "seed": seed,
            "missing": "both" if len(reasons) == 2 else next(iter(reasons)),
            "why": why,
        }
