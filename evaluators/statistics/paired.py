"""Paired differences between renderers on shared scene-seed cells.

Two renderers meet the same scenes, seeds and noise, so the difference per cell is far less spread
than either value. Cells of one scene are not independent: differences are averaged per scene, and
the scene is the unit of interval and test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from alpasim_plugin.core.errors import InputError
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
from evaluators.statistics.bounded import mean_bounds
from evaluators.statistics.intervals import (
    TOO_LARGE,
    Interval,
    are_alike,
    cluster_means,
    logit_t_bounds,
    n_clusters,
    scaled,
    t_interval,
    within,
)
from evaluators.statistics.variants import Variant, axis_bases, variants_in
from evaluators.statistics.verdicts import (
    LEAST_SCENES,
    REACH,
    difference,
    harm,
    more_scenes,
    p_value,
    sign_test,
    verdict,
)

Table = dict[str, dict[str, dict[str, Any]]]  # RENDERER -> METRIC -> numbers

LISTED = 50  # missing cells named per metric; the count is always whole
UNDONE_BY = {
    "non-inferior": "worse",
    "better": "worse",
    "worse": "better",
}  # what is seen -> what scenes that were not drawn may be
NO_PAIR = "no scene-seed cell has this metric on both sides"


class Pair(NamedTuple):
    """A variant, the one that it is compared with, and what tables call the two."""

    key: str
    variant: Variant
    other: Variant
    baseline: str


def paired(
    rows: Sequence[Row],
    baseline: str,
    metrics: Sequence[str] | None = None,
    margins: Mapping[str, float] | None = None,
    listed: int = LISTED,
    known: MetricTable = METRICS,
) -> Table:
    """Compare every renderer with a baseline, cell by cell.

    Args:
        rows: As for `aggregate`.
        baseline: Renderer that the others are compared with.
        metrics: Which metrics; all that any row has by default.
        margins: How much worse is accepted, by metric, in its unit; the metric's own margin for the
            others.
        listed: How many missing cells to name per metric.
        known: What the metrics are.

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
    names = metric_names(rows) if metrics is None else metrics
    return {
        renderer: {
            name: compare(
                side, sides[baseline], known.info(name), baseline, (margins or {}).get(name), listed
            )
            for name in names
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
    margins: Mapping[str, float] | None = None,
    listed: int = LISTED,
) -> Table:
    """Compare variants with variants, scene by scene and seed by seed; their policies may differ.

    Args:
        table: The rollouts of the first variant of each pair.
        pairs: What is compared.
        known: What the metrics are.
        base: The rollouts of the second variant of each pair; None: the same table.
        margins, listed: As for `paired`.

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
            name: compare(
                side, base_side, known.info(name), baseline, (margins or {}).get(name), listed
            )
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
    sampled: bool = True,
) -> dict[str, Any]:
    """Compare one metric of two renderers on their shared cells.

    Args:
        side, base: Their rollouts.
        metric: What is compared.
        baseline: What to call ``base``.
        margin: How much worse is accepted, in the metric's unit; None: its own margin.
        listed: How many missing cells to name.
        sampled: Scenes are draws from a population. False: they are all that is asked about, and no
            unseen one needs a guard.

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
    entry: dict[str, Any] = {
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
    n = len(means)
    up, down = int(np.sum(means > 0)), int(np.sum(means < 0))
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
    interval, guarded = difference_bounds(delta, pairs.scenes, metric, margin)
    interval = within(interval, *metric.difference_range)
    bounds = interval.bounds
    entry |= {"diff": interval.centre, "ci95": bounds, "method": interval.method or None}
    if interval.reason:
        return entry | {"reason": interval.reason}
    small, scale = scaled(means)
    p, test = p_value(means, metric.is_flag)
    spread = scale * float(np.std(small, ddof=1))
    entry |= {"guarded": guarded, "spread": spread, "p_value": p, "test": test}
    both = _both(bounds, guarded) if sampled else bounds
    # A flag's sign test needs no bound of what was not drawn.
    shown = bounds if metric.is_flag else both
    answers = {
        "verdict": verdict(both, p, margin, metric.direction),
        "difference": difference(shown, p, metric.direction),
    }
    notes = [interval.note] if interval.note else []
    if n < LEAST_SCENES:
        notes.append(f"{n} scenes: a verdict needs at least {LEAST_SCENES}")
    elif guarded is None and sampled:
        notes.append(
            "nothing says how much a scene can differ, so that nothing is decided without a margin"
        )
    else:
        entry |= answers
    if guarded is not None:
        unguarded = {
            "verdict": verdict(bounds, p, margin, metric.direction),
            "difference": difference(bounds, p, metric.direction),
        }
        unseen = {UNDONE_BY[unguarded[key]] for key in answers if unguarded[key] != answers[key]}
        if unseen:
            others = f"a few others are {' or '.join(sorted(unseen))}"
            reach = f"{reach_of(metric, margin):g} {metric.unit}".rstrip()
            notes.append(f"{n} scenes cannot exclude that {others} by up to {reach}")
    if notes:
        entry["note"] = "; ".join(notes)
    if entry["verdict"] == "undecided" and (metric.direction != "none" or margin > 0.0):
        worse = abs(interval.centre)
        if metric.direction != "none":
            worse, _ = harm([interval.centre] * 2, metric.direction)
        most = reach_of(metric, margin) or None
        entry["more_scenes"] = more_scenes(worse, spread, n, margin, most)
    return entry


def difference_bounds(
    delta: F64, scenes: I64, metric: MetricInfo, margin: float
) -> tuple[Interval, list[float] | None]:
    """Return the interval of a mean difference, and the guarded bounds that a verdict must hold for
    too; None where there are none.

    Rates take the interval of `flag_interval`, other quantities with bounds that of
    `evaluators.statistics.bounded`, all others t. The guarded bounds allow for scenes at the worst
    possible value that were not drawn; without bounds, differences are cut to `reach_of`.

    Args:
        delta: ``(N,)`` differences per cell.
        scenes: Scene of each cell.
        metric: What it is.
        margin: How much worse is accepted.
    """
    means, _ = cluster_means(delta, scenes)
    n, reach = len(means), reach_of(metric, margin)
    if n < 2:
        return Interval(float(np.mean(means)), reason=f"needs at least two scenes, found {n}"), None
    guarded = list(mean_bounds(means, -reach, reach)) if reach else None
    if metric.is_flag:
        return flag_interval(delta, scenes), guarded
    plain = t_interval(means, "scenes")
    if (
        guarded is None
        or plain.bounds is None
        or not (are_alike(means) or np.isfinite(metric.difference_range).all())
    ):
        return plain, guarded
    note = (
        f"all {n} scenes are equal, so that they have no spread to go by"
        if are_alike(means)
        else ""
    )
    method = f"mean of scenes that differ by at most {reach:g} {metric.unit}".rstrip()
    return Interval(plain.centre, guarded[0], guarded[1], note=note, method=method), guarded


def _both(bounds: list[float] | None, guarded: list[float] | None) -> list[float] | None:
    """Return the bounds that hold both."""
    if bounds is None or guarded is None:
        return bounds or guarded
    return [min(bounds[0], guarded[0]), max(bounds[1], guarded[1])]


def flag_interval(delta: F64, scenes: I64) -> Interval:
    """Return the interval of a difference of rates from ``(N,)`` differences per cell, in [-1, 1],
    and their scenes; see `flag_bounds`.
    """
    gained, _ = cluster_means(np.maximum(delta, 0.0), scenes)
    lost, _ = cluster_means(np.maximum(-delta, 0.0), scenes)
    low, high = (float(b) for b in flag_bounds(gained, lost))
    changed = int(np.sum((gained > 0) | (lost > 0)))
    note = f"{changed} of {len(gained)} scenes changed" if changed < LEAST_SCENES else ""
    return Interval(
        float(np.mean(gained - lost)), low, high, note=note, method="gained and lost rates joined"
    )


def flag_bounds(gained: F64, lost: F64) -> tuple[F64, F64]:
    """Return bounds ``(...,)`` of a difference of rates; never without width.

    The rates of cells that gained and that lost the event get their own intervals
    (`logit_t_bounds`), which are joined by the method of variance estimates recovery (Zou and
    Donner, Statistics in Medicine 27, 2008).

    Args:
        gained: ``(..., G)`` share of a scene's cells in which only the renderer has the event.
        lost: ``(..., G)`` share in which only the baseline has it.
    """
    up, down = gained.mean(axis=-1), lost.mean(axis=-1)
    (up_low, up_high), (down_low, down_high) = logit_t_bounds(gained), logit_t_bounds(lost)
    low = np.maximum(up - down - np.hypot(up - up_low, down_high - down), -1.0)
    high = np.minimum(up - down + np.hypot(up_high - up, down - down_low), 1.0)
    return np.asarray(low), np.asarray(high)


def reach_of(metric: MetricInfo, margin: float) -> float:
    """Return how much worse a scene can be, in the metric's unit; 0 where nothing says so.

    Where differences have no bounds it is `REACH` times the metric's own margin, or the given one
    where it has none.
    """
    most = max(metric.difference_range)
    return float(most) if np.isfinite(most) else REACH * (metric.accepted or margin)


class Pairs:
    """Cells with a value on both sides, and those without."""

    def __init__(self, side: Side, base: Side, metric: str) -> None:
        own_values, base_values = side.values(metric), base.values(metric)
        index = side.place_in(base)
        # The last value stands for cells that the base does not have: index -1.
        partner = np.append(base_values, np.nan)[index]
        both: Bool = np.isfinite(own_values) & np.isfinite(partner)
        self.mine = own_values[both]
        self.base = partner[both]
        self.scenes = side.scene[both]
        self._sides = {"here": (side, own_values), "baseline": (base, base_values)}
        only_base = np.flatnonzero(base.place_in(side) < 0)
        self._lone = ((side, np.flatnonzero(~both)), (base, only_base))
        self.n_missing = int(np.sum(~both)) + len(only_base)

    def missing(self, metric: str, listed: int) -> list[dict[str, Any]]:
        """Name the first cells without a pair, with side and cause."""
        # Both sides are sorted already.
        cells = [side.cells[i] for side, places in self._lone for i in places[:listed].tolist()]
        return [self._cause(cell, metric) for cell in sorted(cells)[:listed]]

    def _cause(self, cell: Cell, metric: str) -> dict[str, Any]:
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
