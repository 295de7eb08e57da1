"""The ``metrics`` block of summary.json: mean and intervals per renderer and metric."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.run_folder.sides import Row, Side, by_renderer, metric_names
from evaluators.aggregate.bootstrap import cluster_bootstrap, redraws
from evaluators.aggregate.intervals import clustered, design_effect, exact_rate, n_clusters, normal_half_width, wilson_rate, within
from evaluators.metrics import METRICS, MetricInfo, MetricTable

BOOTSTRAP_SCENES = 1000  # beyond, the bootstrap costs seconds and says what the t interval says


def aggregate(
    rows: Sequence[Row], metrics: Sequence[str] | None = None, known: MetricTable = METRICS
) -> dict[str, dict[str, dict[str, Any]]]:
    """Average rollouts per renderer and metric, with the paper's and the scene-clustered 95 % interval.

    Args:
        rows: One mapping per rollout with ``renderer``, ``policy``, ``scene``, ``seed``, ``status`` and the metrics, either flat
            (``METRIC``, ``METRIC_valid``) or under ``metrics``. Rows whose status is not "ok" and invalid values do not enter.
        metrics: Which metrics; all that any row has by default.
        known: What they are.

    Returns:
        RENDERER -> METRIC -> ``mean``, ``ci95`` (half-width 1.96 s / sqrt(N)), ``ci95_clustered`` ([low, high], scenes as clusters) and
        its ``ci95_clustered_method``, ``ci95_bootstrap`` ([low, high], scenes redrawn), ``design_effect``, ``n_rollouts``, ``n_scenes``,
        ``n_invalid``, ``unit``, ``direction``; for rates also ``n_events``, ``ci95_wilson`` and ``ci95_exact`` (both as if rollouts were
        independent). What does not exist is None, with ``reason`` (no mean) or ``ci95_reason`` / ``ci95_clustered_reason`` /
        ``ci95_bootstrap_reason``; ``note`` qualifies the clustered interval.
    """
    return aggregate_sides(by_renderer(rows), metric_names(rows) if metrics is None else metrics, known)


def aggregate_sides(
    sides: Mapping[str, Side], metrics: Sequence[str], known: MetricTable = METRICS
) -> dict[str, dict[str, dict[str, Any]]]:
    """Average rollouts per renderer and metric; see `aggregate`.

    Args:
        sides: RENDERER -> its rollouts.
        metrics: Which metrics.
        known: What they are.
    """
    # Metric by metric: renderers share its column and its draws.
    found = {name: {renderer: _entry(side, known.info(name)) for renderer, side in sides.items()} for name in metrics}
    return {renderer: {name: found[name][renderer] for name in metrics} for renderer in sides}


def _entry(side: Side, metric: MetricInfo) -> dict[str, Any]:
    by_cell = side.values(metric.name)
    known = np.isfinite(by_cell)
    values, scenes = by_cell[known], side.scene[known]
    n, n_ran = len(values), int(side.ok.sum())
    entry: dict[str, Any] = {
        "mean": None,
        "ci95": None,
        "ci95_clustered": None,
        "ci95_clustered_method": None,
        "ci95_bootstrap": None,
        "design_effect": None,
        "n_rollouts": n,
        "n_scenes": n_clusters(scenes),
        "n_invalid": max(n_ran - n, 0),
        "unit": metric.unit,
        "direction": metric.direction,
    }
    if n == 0:
        return entry | {"reason": "no rollout finished" if n_ran == 0 else f"valid in none of {n_ran} rollouts"}
    entry["mean"] = float(np.mean(values))
    entry["ci95"], why = normal_half_width(values)
    if why:
        entry["ci95_reason"] = why
    interval = within(clustered(values, scenes, metric.is_flag), *metric.value_range)
    entry["ci95_clustered"], entry["ci95_clustered_method"] = interval.bounds, interval.method or None
    entry["design_effect"] = design_effect(values, scenes)
    if interval.reason:
        entry["ci95_clustered_reason"] = interval.reason
    if interval.note:
        entry["note"] = interval.note
    entry |= _bootstrap(metric.name, values, scenes, entry["n_scenes"])
    if metric.is_flag:
        entry |= _counts(values)
    return entry


def _bootstrap(metric: str, values: F64, scenes: I64, n_scenes: int) -> dict[str, Any]:
    if n_scenes > BOOTSTRAP_SCENES:
        return {"ci95_bootstrap_reason": f"not drawn for more than {BOOTSTRAP_SCENES} scenes; ci95_clustered needs no second opinion there"}
    found = cluster_bootstrap(values, scenes, partial(_redraws, metric))
    return {"ci95_bootstrap": found.bounds} | ({"ci95_bootstrap_reason": found.reason} if found.reason else {})


@lru_cache(maxsize=1)
def _redraws(metric: str, scenes: int) -> I64:
    """Return the draws of a metric's scenes; keyed by the metric alone, so that renderers meet the same ones."""
    return redraws(scenes, stream(metric, 0, "aggregate/bootstrap"))


def _counts(values: F64) -> dict[str, Any]:
    """Return the count of events and, where every cell is 0 or 1, the bounds for independent trials."""
    out: dict[str, Any] = {"n_events": int(np.sum(values > 0)), "ci95_wilson": None, "ci95_exact": None}
    if bool(np.all((values == 0.0) | (values == 1.0))):
        k, n = out["n_events"], len(values)
        out["ci95_wilson"], out["ci95_exact"] = list(wilson_rate(k, n)), list(exact_rate(k, n))
    return out
