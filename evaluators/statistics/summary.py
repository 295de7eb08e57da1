"""The blocks of summary.json: means with intervals, paired differences, and what each rule removed,
with the bounds that this allows.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64
from alpasim_plugin.log.run_folder.schema import cell_name
from alpasim_plugin.log.run_folder.sides import (
    RolloutTable,
    Row,
    Side,
    by_renderer,
    failure_of,
    metric_names,
    reason_of,
)
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.statistics.bounded import mean_interval, rate_interval
from evaluators.statistics.intervals import (
    cluster_means,
    mean_of,
    n_clusters,
    normal_half_width,
)
from evaluators.statistics.paired import Table, compare_pairs, pairs_within


def aggregate(rows: Sequence[Row], known: MetricTable = METRICS) -> Table:
    """Average rollouts per renderer and metric, with the paper's and the scene-clustered 95 %
    interval.

    Args:
        rows: One mapping per rollout with ``renderer``, ``policy``, ``scene``, ``seed``, ``status``
            and the metrics, either flat (``METRIC``, ``METRIC_valid``) or under ``metrics``. Rows
            whose status is not "ok" and invalid values do not enter.
        known: What the metrics are.

    Returns:
        RENDERER -> METRIC -> ``mean``, ``ci95`` (half-width 1.96 s / sqrt(N)), ``ci95_clustered``
        ([low, high], scenes as clusters) and its ``ci95_clustered_method``,
        ``n_rollouts``, ``n_scenes``, ``n_invalid``, ``unit``, ``direction``; for rates also
        ``n_events``. What does not exist is None, with ``reason`` (no mean) or ``ci95_reason`` /
        ``ci95_clustered_reason``; ``note`` qualifies the clustered interval.
    """
    return aggregate_sides(by_renderer(rows), metric_names(rows), known)


def aggregate_sides(sides: Mapping[str, Side], metrics: Sequence[str], known: MetricTable) -> Table:
    """Average rollouts per renderer and metric; see `aggregate`.

    Args:
        sides: RENDERER -> its rollouts.
        metrics: Which metrics.
        known: What they are.
    """
    # Metric by metric: renderers share its column and its draws.
    entries = {
        name: {renderer: _entry(side, known.info(name)) for renderer, side in sides.items()}
        for name in metrics
    }
    return {renderer: {name: entries[name][renderer] for name in metrics} for renderer in sides}


def _entry(side: Side, metric: MetricInfo) -> JsonObject:
    by_cell = side.values(metric.name)
    known = np.isfinite(by_cell)
    values = by_cell[known]
    scenes = side.scene[known]
    n = len(values)
    n_ran = int(side.ok.sum())
    entry: JsonObject = {
        "mean": None,
        "ci95": None,
        "ci95_clustered": None,
        "ci95_clustered_method": None,
        "n_rollouts": n,
        "n_scenes": n_clusters(scenes),
        "n_invalid": max(n_ran - n, 0),
        "unit": metric.unit,
        "direction": metric.direction,
    }
    if n == 0:
        return entry | {
            "reason": "no rollout finished" if n_ran == 0 else f"valid in none of {n_ran} rollouts"
        }
    entry["mean"] = mean_of(values)
    entry["ci95"], why = normal_half_width(values)
    if why:
        entry["ci95_reason"] = why
    interval = mean_interval(cluster_means(values, scenes)[0], metric)
    entry["ci95_clustered"], entry["ci95_clustered_method"] = (
        interval.bounds,
        interval.method or None,
    )
    if interval.reason:
        entry["ci95_clustered_reason"] = interval.reason
    notes = [interval.note] if interval.note else []
    if abs(interval.centre - entry["mean"]) > 1e-9 * max(1.0, abs(entry["mean"])):
        notes.append(
            f"scenes have different numbers of values: the interval is about the mean over scenes, {interval.centre:.4g}"
        )
    if notes:
        entry["note"] = "; ".join(notes)
    if metric.is_flag:
        entry["n_events"] = int(np.sum(values > 0))
    return entry


STEP_RULES = (
    "steps_total",
    "steps_warmup",
    "steps_after_event",
    "steps_after_drift",
    "steps_scored",
)
CUT_RULES = (
    "steps_after_event",
    "steps_after_drift",
)  # the policy drove there, but what happened does not count
FIXER_GUARD = "fixer-"  # frame events of this kind: the fixer's frame was replaced by the raw one


def censoring(rows: Sequence[Row], known: MetricTable = METRICS) -> dict[str, JsonObject]:
    """Count what did not enter the table, per renderer and cause.

    Args:
        rows: Rollout rows or manifests as for `aggregate`, with ``censored`` (a `Ledger` as dict),
            ``frames`` and ``frame_events`` where a rollout was scored, and ``failure_class`` or
            ``error`` where it failed.
        known: What the metrics are.

    Returns:
        RENDERER -> ``rollouts`` (planned), ``failed`` (by failure class), ``dropped`` (by reason),
        the step counts of the ledger summed over rollouts, ``frames`` (rendered in rollouts that
        ran to their end), ``frame_events`` (by kind: ``black``, ``fixer-nan``, ...),
        ``frames_passed_raw`` (the fixer's guard took the raw frame), ``invalid`` (METRIC -> number
        of rollouts and their reasons), and for every rate METRIC -> [least, greatest]:
        ``bounds_rollouts`` (every missing rollout without, and with, the event),
        ``bounds_rollouts_ci95`` (the same with sampling error: the low end of the 95 % interval
        over scenes of the one, the high end of the other; None with one scene) and ``bounds`` (also
        every step that was cut from a scored rollout without, and with, the event), with ``cut``
        (METRIC -> rollouts that were cut before the event was seen).
    """
    names = metric_names(rows)
    return {name: _of_renderer(side, names, known) for name, side in by_renderer(rows).items()}


def _of_renderer(side: Side, names: Sequence[str], known: MetricTable) -> JsonObject:
    done = [row for row, ok in zip(side.rows, side.ok, strict=True) if ok]
    ledgers = [row["censored"] for row in done if row.get("censored")]
    events: Counter[str] = Counter()
    for row in done:
        events.update(row.get("frame_events") or {})
    out: JsonObject = {
        "rollouts": len(side.rows),
        "failed": dict(
            Counter(failure_of(row) for row, ok in zip(side.rows, side.ok, strict=True) if not ok)
        ),
        "dropped": dict(Counter(ledger["dropped"] for ledger in ledgers if ledger["dropped"])),
        **{rule: sum(int(ledger[rule]) for ledger in ledgers) for rule in STEP_RULES},
        "frames": sum(int(row.get("frames") or 0) for row in done),
        "frame_events": dict(events),
        "frames_passed_raw": sum(n for event, n in events.items() if event.startswith(FIXER_GUARD)),
        "invalid": {},
        "bounds": {},
        "bounds_rollouts": {},
        "bounds_rollouts_ci95": {},
        "cut": {},
    }
    steps = [row.get("censored") or {} for row in side.rows]
    cut = np.array(
        [sum(int(ledger.get(rule) or 0) for rule in CUT_RULES) for ledger in steps],
        np.float64,
    )
    scored = np.array([int(ledger.get("steps_scored") or 0) for ledger in steps], np.float64)
    for name in names:
        values = side.raw(name)
        absent = np.flatnonzero(side.ok & ~np.isfinite(values))
        if len(absent):
            reasons = Counter(reason_of(side.rows[i], name) for i in absent)
            out["invalid"][name] = {"rollouts": len(absent), "reasons": dict(reasons)}
        metric = known.info(name)
        if metric.is_flag:
            is_share = metric.aggregation == "mean"
            out["bounds_rollouts"][name], out["bounds"][name], out["cut"][name] = rate_bounds(
                values, cut, scored, is_share
            )
            scenes = side.scene[side.cell]
            ends = [
                rate_interval(cluster_means(np.nan_to_num(values, nan=fill), scenes)[0])
                for fill in (0.0, 1.0)
            ]
            out["bounds_rollouts_ci95"][name] = [ends[0].low, ends[1].high]
    return out


def rate_bounds(
    values: F64, cut: F64, scored: F64, is_share: bool
) -> tuple[list[float], list[float], int]:
    """Return the least and greatest that a rate could be, given what is missing.

    Args:
        values: ``(R,)`` the flag of each planned rollout, NaN where missing; at least one.
        cut: ``(R,)`` steps that a rule cut from each rollout after the policy took over.
        scored: ``(R,)`` steps that were scored.
        is_share: The flag of a rollout is the share of its steps that fired, not whether any did.

    Returns:
        Bounds over missing rollouts; bounds over missing rollouts and cut steps; how many rollouts
        were cut before the event was seen.
    """
    known = np.isfinite(values)
    seen = values[known]
    n = len(values)
    missing = int(np.sum(~known))
    cut = cut[known]
    scored = scored[known]
    least = seen
    greatest = np.where(cut > 0, 1.0, seen)
    if is_share:
        steps = np.maximum(scored + cut, 1.0)
        least = np.where(cut > 0, seen * scored / steps, seen)
        greatest = np.where(cut > 0, (seen * scored + cut) / steps, seen)
    over_rollouts = [float(seen.sum()) / n, (float(seen.sum()) + missing) / n]
    return (
        over_rollouts,
        [float(least.sum()) / n, (float(greatest.sum()) + missing) / n],
        int(np.sum(greatest > seen)),
    )


NO_BASES: Mapping[str, str] = {}


def numbers(
    table: RolloutTable,
    baseline: str | None = None,
    bases: Mapping[str, str] = NO_BASES,
    known: MetricTable = METRICS,
) -> JsonObject:
    """Return the blocks ``metrics``, ``paired``, ``paired_with_base`` and ``paired_policies`` of
    ``summary.json`` (docs/statistics.md).

    Args:
        table: The rollouts.
        baseline: RENDERER, POLICY or RENDERER/POLICY that the others are compared with; what it
            does not name, or a policy did not meet, is the first of its kind.
        bases: Renderer with a fixer -> the renderer below it; where both were driven and it is not
            the baseline, the two are paired too.
        known: What the metrics are.
    """
    metrics = {
        policy: aggregate_sides(table.sides(policy), table.metrics, known)
        for policy in table.policies
    }
    paired, with_base, policies = (
        compare_pairs(table, pairs, known) for pairs in pairs_within(table, baseline, bases)
    )
    return {
        "metrics": by_policy(metrics, dict),
        "paired": paired,
        "paired_with_base": with_base,
        "paired_policies": policies,
    }


def by_policy(parts: JsonView, table: Callable[[Any], JsonView]) -> JsonObject:
    """Make a table per policy. With one policy its keys are RENDERER, with several RENDERER/POLICY:
    policies are never averaged.

    Args:
        parts: POLICY -> what the table is made of.
        table: Gives RENDERER -> entry.
    """
    out: JsonObject = {}
    for policy, some in parts.items():
        part = table(some)
        out |= (
            part
            if len(parts) == 1
            else {cell_name(renderer, policy): entry for renderer, entry in part.items()}
        )
    return out
