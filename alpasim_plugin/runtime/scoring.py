"""Score one rollout from its log file and flatten the result for the tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.geometry import inverse, offset_trajectory, project, yaw_from_quat
from alpasim_plugin.log import read_asl, read_facts
from alpasim_plugin.types import MetricSeries, RolloutLog, Scenario
from evaluators import Reduction, reduce_rollout, score


@dataclass(frozen=True)
class Scored:
    """What a log came to."""

    steps: list[dict[str, Any]]  # rows of steps.parquet less the rollout's key
    metrics: dict[str, dict[str, Any]]  # metric -> value, valid, reason, unit, direction
    events: list[dict[str, Any]]  # first scored collision and off-road: metric, t_us, x_m, y_m
    censored: dict[str, Any]  # how many steps which rule removed


def score_log(log: Path, frames: Path, scenario: Scenario, preset: str) -> Scored:
    """Read a log back and score it, so that what is tabulated is what any reader of the log would find.

    Raises:
        EvaluatorError: An evaluator could not give a value where one is due.
    """
    rollout = read_asl(log)
    series = score(rollout, scenario.scene, preset)
    reduction = reduce_rollout(series, preset)
    rows = [row for one in series for row in _rows(one)]
    rows += _state_rows(rollout)
    rows += [
        _row(int(fact["t_us"] or 0), "opacity_mean", fact["opacity_mean"], "the renderer gives no opacity")
        for fact in read_facts(frames)
    ]
    return Scored(rows, reduction.as_dict(), _placed(rollout, reduction), reduction.ledger.as_dict())


def _rows(series: MetricSeries) -> list[dict[str, Any]]:
    return [
        {"t_us": int(t), "metric": series.name, "value": _number(v), "valid": bool(ok), "reason": "" if ok else series.reason}
        for t, v, ok in zip(series.t_us, series.value, series.valid, strict=True)
    ]


def _row(t_us: int, metric: str, value: Any, why_missing: str = "") -> dict[str, Any]:
    missing = value is None
    return {"t_us": t_us, "metric": metric, "value": value, "valid": not missing, "reason": why_missing if missing else ""}


def _state_rows(rollout: RolloutLog) -> list[dict[str, Any]]:
    """Return where the ego was: not metrics, but what plots and stratified results need."""
    rig = offset_trajectory(rollout.ego, inverse(rollout.T_rig_box))
    yaw = yaw_from_quat(rig.quat)
    speed = _speeds(rig.t_us, rig.xyz)
    rows = []
    for i, t in enumerate(rig.t_us.tolist()):
        state: Mapping[str, float] = {
            "ego_x_m": float(rig.xyz[i, 0]),
            "ego_y_m": float(rig.xyz[i, 1]),
            "ego_yaw_rad": float(yaw[i]),
            "ego_speed_mps": float(speed[i]),
            "lateral_offset_m": project(rollout.ego_log.xyz, rig.xyz[i])[1] if len(rollout.ego_log) > 1 else 0.0,
        }
        rows += [_row(t, name, value) for name, value in state.items()]
    return rows


def _speeds(t_us: np.ndarray[Any, Any], xyz: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    if len(t_us) < 2:
        return np.zeros(len(t_us))
    seconds = (t_us - t_us[0]).astype(np.float64) * 1e-6
    return np.asarray(np.linalg.norm(np.gradient(xyz[:, :2], seconds, axis=0), axis=1))


def _placed(rollout: RolloutLog, reduction: Reduction) -> list[dict[str, Any]]:
    """Return the events with the place of the ego's box centre when they happened."""
    placed = []
    for event in reduction.events:
        at = rollout.ego.xyz[int(np.searchsorted(rollout.ego.t_us, event["t_us"]))]
        placed.append(dict(event) | {"x_m": round(float(at[0]), 3), "y_m": round(float(at[1]), 3)})
    return sorted(placed, key=lambda event: (event["t_us"], event["metric"]))


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
