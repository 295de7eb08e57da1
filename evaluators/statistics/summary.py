"""The blocks of summary.json: means with intervals, paired differences, and what each rule removed,
with the bounds that this allows.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.log.run_folder.records import Ledger, Manifest
from alpasim_plugin.log.run_folder.schema import cell_name
from alpasim_plugin.log.run_folder.sides import (
    RolloutTable,
    RolloutValues,
    Row,
    Side,
    by_renderer,
    flat_row,
    metric_names,
)
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.results import (
    Bounds,
    Censoring,
    DifferenceTable,
    InvalidValues,
    Mean,
    MeanTable,
)
from evaluators.statistics.bounded import mean_interval, rate_interval
from evaluators.statistics.intervals import (
    cluster_means,
    mean_of,
    n_clusters,
    normal_half_width,
)
from evaluators.statistics.paired import compare_pairs, pairs_within


def aggregate(rows: Sequence[Row], metric_table: MetricTable = METRICS) -> MeanTable:
    """Average rollouts per renderer and metric, with the paper's and the scene-clustered 95 %
    interval.

    Args:
        rows: One mapping per rollout with ``renderer``, ``policy``, ``scene``, ``seed``, ``status``
            and the metrics, either flat (``METRIC``, ``METRIC_valid``) or under ``metrics``. Rows
            whose status is not "ok" and invalid values do not enter.
        metric_table: What the metrics are.

    Returns:
        RENDERER -> METRIC -> mean.
    """
    flat_rows = [flat_row(row) for row in rows]
    return aggregate_sides(by_renderer(flat_rows), metric_names(flat_rows), metric_table)


def aggregate_sides(
    sides: Mapping[str, Side], metrics: Sequence[str], metric_table: MetricTable
) -> MeanTable:
    """Average rollouts per renderer and metric; see `aggregate`.

    Args:
        sides: RENDERER -> its rollouts.
        metrics: Which metrics.
        metric_table: What they are.
    """
    # Metric by metric: renderers share its column and its draws.
    entries = {
        name: {renderer: _mean(side, metric_table.info(name)) for renderer, side in sides.items()}
        for name in metrics
    }
    return {renderer: {name: entries[name][renderer] for name in metrics} for renderer in sides}


def _mean(side: Side, metric: MetricInfo) -> Mean:
    by_cell = side.values(metric.name)
    is_known = np.isfinite(by_cell)
    values = by_cell[is_known]
    scenes = side.scene[is_known]
    n = len(values)
    n_ran = int(side.ok.sum())
    entry = Mean(
        unit=metric.unit,
        direction=metric.direction,
        n_rollouts=n,
        n_scenes=n_clusters(scenes),
        n_invalid=max(n_ran - n, 0),
    )
    if n == 0:
        reason = "no rollout finished" if n_ran == 0 else f"valid in none of {n_ran} rollouts"
        return replace(entry, reason=reason)
    mean = mean_of(values)
    half_width, no_half_width = normal_half_width(values)
    interval = mean_interval(cluster_means(values, scenes)[0], metric)
    bounds = interval.bounds
    notes = [interval.note] if interval.note else []
    if abs(interval.centre - mean) > 1e-9 * max(1.0, abs(mean)):
        notes.append(
            "scenes have different numbers of values: "
            f"the interval is about the mean over scenes, {interval.centre:.4g}"
        )
    return replace(
        entry,
        mean=mean,
        ci95=half_width,
        ci95_reason=no_half_width or None,
        ci95_clustered=None if bounds is None else (bounds[0], bounds[1]),
        ci95_clustered_method=interval.method or None,
        ci95_clustered_reason=interval.reason or None,
        note="; ".join(notes) or None,
        n_events=int(np.sum(values > 0)) if metric.is_flag else None,
    )


# The policy drove there, but what happened does not count.
COUNTS = (  # of `Censoring`, which add up over runs
    "rollouts",
    "steps_total",
    "steps_warmup",
    "steps_after_event",
    "steps_after_drift",
    "steps_scored",
    "frames",
    "frames_passed_raw",
)
# Of a rollout that was not scored.
NOTHING_SCORED = Ledger(0, 0, 0, 0, 0, "")
FIXER_GUARD = "fixer-"  # frame events of this kind: the fixer's frame was replaced by the raw one


def censoring(
    manifests: Sequence[Manifest], metric_table: MetricTable = METRICS
) -> dict[str, Censoring]:
    """Count what did not enter the table, per renderer and cause.

    Args:
        manifests: Of all rollouts.
        metric_table: What the metrics are.

    Returns:
        RENDERER -> what was removed, and the bounds of rates that this allows.
    """
    names = list(dict.fromkeys(name for manifest in manifests for name in manifest.metrics))
    by_name: dict[str, list[Manifest]] = {}
    for manifest in manifests:
        by_name.setdefault(manifest.renderer, []).append(manifest)
    return {
        renderer: _of_renderer(of_renderer, names, metric_table)
        for renderer, of_renderer in by_name.items()
    }


def _of_renderer(
    manifests: Sequence[Manifest], names: Sequence[str], metric_table: MetricTable
) -> Censoring:
    side = Side.of([RolloutValues.of_manifest(manifest) for manifest in manifests])
    finished = [manifest for manifest in manifests if manifest.ok]
    ledgers = [manifest.censored for manifest in finished if manifest.censored is not None]
    steps = _summed(ledgers)
    events: Counter[str] = Counter()
    for manifest in finished:
        events.update(manifest.frame_events)
    rates = {
        name: _rate_limits(manifests, side, metric_table.info(name))
        for name in names
        if metric_table.info(name).is_flag
    }
    return Censoring(
        rollouts=len(manifests),
        failed=dict(Counter(manifest.failure_class for manifest in manifests if not manifest.ok)),
        dropped=dict(Counter(ledger.dropped for ledger in ledgers if ledger.dropped)),
        steps_total=steps.steps_total,
        steps_warmup=steps.steps_warmup,
        steps_after_event=steps.steps_after_event,
        steps_after_drift=steps.steps_after_drift,
        steps_scored=steps.steps_scored,
        frames=sum(manifest.frames or 0 for manifest in finished),
        frame_events=dict(events),
        frames_passed_raw=sum(n for event, n in events.items() if event.startswith(FIXER_GUARD)),
        invalid=_invalid_values(side, names),
        bounds={name: limits.bounds for name, limits in rates.items()},
        bounds_rollouts={name: limits.bounds_rollouts for name, limits in rates.items()},
        bounds_rollouts_ci95={name: limits.bounds_rollouts_ci95 for name, limits in rates.items()},
        cut={name: limits.n_cut for name, limits in rates.items()},
    )


def _summed(ledgers: Sequence[Ledger]) -> Ledger:
    """Return the steps of all ledgers together."""
    return Ledger(
        steps_total=sum(ledger.steps_total for ledger in ledgers),
        steps_warmup=sum(ledger.steps_warmup for ledger in ledgers),
        steps_after_event=sum(ledger.steps_after_event for ledger in ledgers),
        steps_after_drift=sum(ledger.steps_after_drift for ledger in ledgers),
        steps_scored=sum(ledger.steps_scored for ledger in ledgers),
        dropped="",
    )


def _invalid_values(side: Side, names: Sequence[str]) -> dict[str, InvalidValues]:
    """Count the finished rollouts without a valid value of a metric, by reason."""
    invalid: dict[str, InvalidValues] = {}
    for name in names:
        absent = np.flatnonzero(side.ok & ~np.isfinite(side.raw(name))).tolist()
        if absent:
            reasons = Counter(side.reason(rollout, name) for rollout in absent)
            invalid[name] = InvalidValues(len(absent), dict(reasons))
    return invalid


class RateLimits(NamedTuple):
    """What a rate could be, given what is missing; the members are those of `Censoring`."""

    bounds: Bounds
    bounds_rollouts: Bounds
    bounds_rollouts_ci95: tuple[float | None, float | None]
    n_cut: int


def _rate_limits(manifests: Sequence[Manifest], side: Side, metric: MetricInfo) -> RateLimits:
    values = side.raw(metric.name)
    ledgers = [manifest.censored or NOTHING_SCORED for manifest in manifests]
    cut = np.array(
        [ledger.steps_after_event + ledger.steps_after_drift for ledger in ledgers],
        dtype=np.float64,
    )
    scored = np.array([ledger.steps_scored for ledger in ledgers], dtype=np.float64)
    over_rollouts, over_steps, n_cut = rate_bounds(
        values, cut, scored, is_share=metric.aggregation == "mean"
    )
    scenes = side.scene[side.cell]
    lowest, highest = (
        rate_interval(cluster_means(np.nan_to_num(values, nan=fill), scenes)[0])
        for fill in (0.0, 1.0)
    )
    return RateLimits(over_steps, over_rollouts, (lowest.low, highest.high), n_cut)


def rate_bounds(values: F64, cut: F64, scored: F64, is_share: bool) -> tuple[Bounds, Bounds, int]:
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
    is_valid = np.isfinite(values)
    valid_values = values[is_valid]
    n = len(values)
    missing = int(np.sum(~is_valid))
    cut = cut[is_valid]
    scored = scored[is_valid]
    least = valid_values
    greatest = np.where(cut > 0, 1.0, valid_values)
    if is_share:
        steps = np.maximum(scored + cut, 1.0)
        least = np.where(cut > 0, valid_values * scored / steps, valid_values)
        greatest = np.where(cut > 0, (valid_values * scored + cut) / steps, valid_values)
    over_rollouts = (float(valid_values.sum()) / n, (float(valid_values.sum()) + missing) / n)
    over_steps = (float(least.sum()) / n, (float(greatest.sum()) + missing) / n)
    return over_rollouts, over_steps, int(np.sum(greatest > valid_values))


NO_BASES: Mapping[str, str] = {}


@dataclass(frozen=True)
class Numbers:
    """The tables of means and differences of a summary; the members are those of
    `evaluators.results.Summary`.
    """

    metrics: MeanTable
    paired: DifferenceTable
    paired_with_base: DifferenceTable
    paired_policies: DifferenceTable


def numbers(
    table: RolloutTable,
    baseline: str | None = None,
    bases: Mapping[str, str] = NO_BASES,
    metric_table: MetricTable = METRICS,
) -> Numbers:
    """Return the means and the paired differences of a run (docs/statistics.md).

    Args:
        table: The rollouts.
        baseline: RENDERER, POLICY or RENDERER/POLICY that the others are compared with; what it
            does not name, or a policy did not meet, is the first of its kind.
        bases: Renderer with a fixer -> the renderer below it; where both were driven and it is not
            the baseline, the two are paired too.
        metric_table: What the metrics are.
    """
    metrics = {
        policy: aggregate_sides(table.sides(policy), table.metrics, metric_table)
        for policy in table.policies
    }
    blocks = compare_pairs(table, pairs_within(table, baseline, bases), metric_table)
    return Numbers(metrics=by_policy(metrics), **blocks)


T = TypeVar("T")


def by_policy(tables: Mapping[str, Mapping[str, T]]) -> dict[str, T]:
    """Join tables of policies into one. With one policy its keys are RENDERER, with several
    RENDERER/POLICY: policies are never averaged.

    Args:
        tables: POLICY -> RENDERER -> entry.
    """
    if len(tables) == 1:
        return dict(*tables.values())
    return {
        cell_name(renderer, policy): entry
        for policy, table in tables.items()
        for renderer, entry in table.items()
    }


def joined_censoring(parts: Sequence[Censoring]) -> Censoring:
    """Return what was removed from the rollouts of several runs together, such as the shards of
    one; bounds of rates are those of no single run and are left out.
    """

    def total(name: str) -> int:
        return sum(getattr(part, name) for part in parts)

    def counted(name: str) -> dict[str, int]:
        counts: Counter[str] = Counter()
        for part in parts:
            counts.update(getattr(part, name))
        return dict(counts)

    invalid: dict[str, InvalidValues] = {}
    for part in parts:
        for metric, values in part.invalid.items():
            before = invalid.get(metric, InvalidValues(0, {}))
            reasons = Counter(before.reasons) + Counter(values.reasons)
            invalid[metric] = InvalidValues(before.rollouts + values.rollouts, dict(reasons))
    numbers_of = {name: total(name) for name in COUNTS}
    return Censoring(
        **numbers_of,
        failed=counted("failed"),
        dropped=counted("dropped"),
        frame_events=counted("frame_events"),
        invalid=invalid,
        bounds={},
        bounds_rollouts={},
        bounds_rollouts_ci95={},
        cut=counted("cut"),
    )
