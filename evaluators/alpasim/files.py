"""AlpaSim's result files as tables and plain data: the same names, columns and keys."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from evaluators.alpasim.reduction import ReducedRollout, ScoredRollout
from evaluators.alpasim.scene_score import SceneScore
from evaluators.alpasim.settings import SceneScoreSettings

SCHEMA_VERSION = 1
SCORE_METRICS = (
    "progress_clipped_rel", "progress_rel", "progress_score", "collision_at_fault", "offroad", "dist_to_gt_trajectory",
    "gt_dist_traveled_m",
)  # fmt: skip
LATER_SCORE_METRICS = (*SCORE_METRICS, "lateral_dist_to_gt_trajectory", "left_corridor_laterally")


def combined_run_uuid(rollouts: Sequence[ScoredRollout]) -> str:
    """Return the id under which runs are put together: the SHA-256 of their sorted ids."""
    ids = sorted({one.run_uuid for one in rollouts if one.run_uuid is not None})
    return hashlib.sha256("\x1f".join(ids).encode()).hexdigest()


def metrics_unprocessed_table(rollouts: Sequence[ScoredRollout]) -> pa.Table:
    """Return every step of every metric, long; a metric without values has one row without a time."""
    columns: dict[str, list[Any]] = {name: [] for name in ("name", "timestamps_us", "values", "valid", "time_aggregation")}
    ids: dict[str, list[Any]] = {name: [] for name in ("clipgt_id", "rollout_id", "run_uuid", "run_name")}
    for rollout in rollouts:
        for one in rollout.series:
            n = max(len(one.t_us), 1)
            columns["name"] += [one.name] * n
            columns["timestamps_us"] += one.t_us.tolist() or [None]
            columns["values"] += one.value.tolist() or [None]
            columns["valid"] += one.valid.tolist() or [None]
            columns["time_aggregation"] += [one.metric.aggregation] * n
            for name, value in zip(ids, (rollout.scene, rollout.rollout, rollout.run_uuid, rollout.run_name), strict=True):
                ids[name] += [value] * n
    types = [pa.string(), pa.int64(), pa.float64(), pa.bool_(), pa.string(), *[pa.string()] * 4]
    data = {**columns, **ids}
    return pa.table({name: pa.array(values, type=kind) for (name, values), kind in zip(data.items(), types, strict=True)})


def metrics_results_table(row: Mapping[str, float | int | None], rollouts: Sequence[ScoredRollout]) -> pa.Table:
    """Return the one-row table over sweeps."""
    columns: dict[str, pa.Array] = {"run_uuid": pa.array([combined_run_uuid(rollouts)], pa.string())}
    columns |= {name: pa.array([value], pa.int64() if name == "n_rollouts" else pa.float64()) for name, value in row.items()}
    columns["run_name"] = pa.array([rollouts[0].run_name if rollouts else None], pa.string())
    return pa.table(columns)


def results_summary(
    rollouts: Sequence[ReducedRollout],
    scores: Mapping[int, SceneScore],
    failed: Sequence[Mapping[str, Any]],
    sweeps: Mapping[str, float | int | None],
    settings: SceneScoreSettings,
) -> dict[str, Any]:
    """Return ``results-summary.json``: one entry per counted rollout, failed ones after them, then the row over sweeps.

    Args:
        rollouts: All reduced rollouts; dropped ones have no entry.
        scores: Scene score by index into ``rollouts``; empty where the score is off.
        failed: ``clipgt_id``, ``rollout_id``, ``run_uuid``, ``run_name`` and ``error`` of rollouts that failed.
        sweeps: What `over_sweeps` gave.
        settings: Of the scene score.
    """
    run_uuid = combined_run_uuid([one.of for one in rollouts])
    later = any("left_corridor_laterally" in one.values for one in rollouts)
    shown = LATER_SCORE_METRICS if later else SCORE_METRICS
    counted = [(i, one) for i, one in enumerate(rollouts) if not one.dropped]
    entries = [
        _entry(one, scores.get(i), run_uuid, shown) for i, one in sorted(counted, key=lambda item: (item[1].of.scene, item[1].of.rollout))
    ]
    entries += [_failed_entry(one, settings.enabled, shown) for one in failed]
    name = rollouts[0].of.run_name if rollouts else None
    saturation, least = settings.progress_saturation_threshold, settings.min_gt_distance_for_full_score_m
    overall: dict[str, Any] = {key: _number(value) for key, value in sweeps.items()}
    out: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "scene_score_enabled": settings.enabled,
        "rollouts": entries,
        "metrics_results": [overall | {"run_uuid": run_uuid, "run_name": name}] if sweeps else [],
    }
    if settings.enabled:
        out["score_criteria"] = {
            "collision_at_fault": "== 0",
            "offroad": "== 0",
            "progress_score": f"min(clamp(progress_clipped_rel, 0, 1) / {saturation}, 1.0)",
            "short_gt_distance_override": f"progress_score = 1.0 when gt_dist_traveled_m < {least}",
        }
        if later:
            out["score_criteria"]["left_corridor_laterally"] = "== 0"
    return out


def _entry(one: ReducedRollout, score: SceneScore | None, run_uuid: str, shown: Sequence[str]) -> dict[str, Any]:
    ids = {"run_uuid": run_uuid, "run_name": one.of.run_name, "clipgt_id": one.of.scene, "rollout_id": one.of.rollout}
    values = {name: _number(value) for name, value in one.values.items()}
    status = "unscored" if score is None else "pass" if score.passed else "fail"
    own = {} if score is None else {"progress_score": score.progress_score}
    return ids | {
        "status": status,
        "passed": None if score is None else score.passed,
        "score": None if score is None else score.score,
        "failure_reason": None if score is None else score.failure_reason,
        "score_metrics": None if score is None else {name: (values | own).get(name) for name in shown},
        "metrics": values | ids,
    }


def _failed_entry(failure: Mapping[str, Any], scored: bool, shown: Sequence[str]) -> dict[str, Any]:
    ids = {key: failure.get(key) for key in ("run_uuid", "run_name", "clipgt_id", "rollout_id")}
    entry = ids | {"status": "fail", "passed": False, "failure_reason": failure.get("error")}
    entry["metrics"] = ids | {"error": failure.get("error")}
    if scored:
        entry |= {"score": 0.0, "score_metrics": {name: 0.0 if name == "progress_score" else None for name in shown}}
    return entry


def _number(value: float | int | None) -> float | int | None:
    return value if value is None or isinstance(value, int) or np.isfinite(value) else None
