"""The ``metrics`` block of summary.json: mean and intervals per renderer and metric."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from evaluators.aggregate.intervals import clustered, normal_half_width
from evaluators.aggregate.rows import Row, column, is_ok, metric_names, renderers
from evaluators.metrics import info


def aggregate(rows: Sequence[Row], metrics: Sequence[str] | None = None) -> dict[str, dict[str, dict[str, Any]]]:
    """Average rollouts per renderer and metric, with the paper's and the scene-clustered 95 % interval.

    Args:
        rows: One mapping per rollout with ``renderer``, ``policy``, ``scene``, ``seed``, ``status`` and the metrics, either flat
            (``METRIC``, ``METRIC_valid``) or under ``metrics``. Rows whose status is not "ok" and invalid values do not enter.
        metrics: Which metrics; all that any row has by default.

    Returns:
        RENDERER -> METRIC -> ``mean``, ``ci95`` (half-width 1.96 s / sqrt(N)), ``ci95_clustered`` ([low, high], t interval on scene
        means), ``n_rollouts``, ``n_scenes``, ``n_invalid``, ``unit``, ``direction``; for rates also ``n_events``. What does not exist is
        None, with ``reason`` (no mean) or ``ci95_reason`` / ``ci95_clustered_reason``; ``note`` qualifies the clustered interval.
    """
    names = list(metrics) if metrics is not None else metric_names(rows)
    out: dict[str, dict[str, dict[str, Any]]] = {}
    for renderer in renderers(rows):
        mine = [row for row in rows if row["renderer"] == renderer]
        out[renderer] = {name: _entry(mine, name) for name in names}
    return out


def _entry(rows: Sequence[Row], metric: str) -> dict[str, Any]:
    facts = info(metric)
    found = column(rows, metric)
    n, n_ran = len(found.values), sum(is_ok(row) for row in rows)
    entry: dict[str, Any] = {
        "mean": None,
        "ci95": None,
        "ci95_clustered": None,
        "n_rollouts": n,
        "n_scenes": len(set(found.scenes)),
        "n_invalid": max(n_ran - n, 0),
        "unit": facts.unit,
        "direction": facts.direction,
    }
    if n == 0:
        return entry | {"reason": "no rollout was run to its end" if n_ran == 0 else f"valid in none of {n_ran} rollouts"}
    entry["mean"] = float(np.mean(found.values))
    entry["ci95"], why = normal_half_width(found.values)
    if why:
        entry["ci95_reason"] = why
    interval = clustered(found.values, found.scenes, facts.is_flag)
    entry["ci95_clustered"] = interval.bounds
    if interval.reason:
        entry["ci95_clustered_reason"] = interval.reason
    if interval.note:
        entry["note"] = interval.note
    if facts.is_flag:
        entry["n_events"] = int(np.sum(found.values > 0))
    return entry
