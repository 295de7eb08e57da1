"""Score one rollout from its log and flatten the result for the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.geometry import inverse, offset_trajectory, yaw_from_quat
from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.core.types import (
    F64,
    GUESSED_SHARE,
    I64,
    RECORDED_SHARE,
    MetricSeries,
    RolloutLog,
    Scenario,
)
from alpasim_plugin.log import read_asl, read_facts
from evaluators import ContactEvent, Preset, Reduction, contact_events, reduce_rollout, score
from evaluators import preset as find_preset
from evaluators.metrics.route import lateral_bias

# Of a speculative fixer: distance of the camera pose of the shown frame, and of the forecast pose,
# from the true pose.
FIXER_FACTS = ("pose_error_m", "forecast_error_m", RECORDED_SHARE, GUESSED_SHARE)


@dataclass(frozen=True)
class TabulatedScores:
    """Scores of one rollout, as rows and JSON."""

    steps: list[dict[str, Any]]  # rows of steps.parquet without the rollout's key
    metrics: dict[str, dict[str, Any]]  # metric -> value, valid, reason, unit, direction
    events: list[
        dict[str, Any]
    ]  # when outcomes began: metric, t_us, t_s (after the first frame), x_m, y_m
    censored: dict[str, Any]  # number of steps that each rule removed
    contacts: list[
        dict[str, Any]
    ]  # contact onsets, if contact is searched between steps: actor_id, t_s, side, x_m, y_m (rig frame)


def score_log(
    log: Path,
    frames: Path,
    scenario: Scenario,
    preset: str,
    evaluators: Sequence[PartSpec] | None = None,
) -> TabulatedScores:
    """Read a log and score it; the scores depend on the written log alone.

    Raises:
        EvaluatorError: An evaluator could not compute a required value.
    """
    rollout = read_asl(log)
    series = score(rollout, scenario.scene, preset, evaluators)
    return tabulate(
        rollout,
        series,
        reduce_rollout(series, preset),
        read_facts(frames),
        contacts_of(rollout, preset),
    )


def tabulate(
    rollout: RolloutLog,
    series: Sequence[MetricSeries],
    reduction: Reduction,
    frames: Sequence[Mapping[str, Any]] = (),
    contacts: Sequence[ContactEvent] = (),
) -> TabulatedScores:
    """Flatten a scored rollout for the tables.

    Args:
        rollout: The log.
        series: Result of `evaluators.score`.
        reduction: Their reduction.
        frames: Facts per camera frame, if known.
        contacts: Result of `contacts_of`.
    """
    # Reports draw the distance from the recorded path also of runs whose preset does not score it.
    drawn = [] if any(one.name == "lateral_bias_m" for one in series) else [lateral_bias(rollout)]
    rows = []
    for one in (*series, *drawn):
        for t, value, valid in zip(
            one.t_us.tolist(), one.value.tolist(), one.valid.tolist(), strict=True
        ):
            number = (
                None if np.isnan(value) else value
            )  # an infinite one stays, as in AlpaSim's tables
            rows.append(
                {
                    "t_us": t,
                    "metric": one.name,
                    "value": number,
                    "valid": valid,
                    "reason": "" if valid else one.reason,
                }
            )
    rows += _state_rows(rollout)
    rows += [
        _row(
            int(f["t_us"] or 0), "opacity_mean", f["opacity_mean"], "the renderer gives no opacity"
        )
        for f in frames
    ]
    rows += [
        _row(int(f["t_us"] or 0), name, f[name])
        for name in FIXER_FACTS
        for f in frames
        if name in f
    ]
    begun = [one.as_dict() for one in contacts]
    return TabulatedScores(
        rows, reduction.as_dict(), _placed(rollout, reduction), reduction.ledger.as_dict(), begun
    )


def contacts_of(rollout: RolloutLog, preset: str | Preset) -> tuple[ContactEvent, ...]:
    """Return the contact onsets of the ego if the preset searches contact between steps; else
    none.
    """
    chosen = find_preset(preset)
    return contact_events(rollout, chosen) if chosen.contact == "between_steps" else ()


def _row(t_us: int, metric: str, value: Any, why_missing: str = "") -> dict[str, Any]:
    missing = value is None
    return {
        "t_us": t_us,
        "metric": metric,
        "value": value,
        "valid": not missing,
        "reason": why_missing if missing else "",
    }


def _state_rows(rollout: RolloutLog) -> list[dict[str, Any]]:
    """Return rows of the ego's state, for plots and stratified results."""
    rig = offset_trajectory(rollout.ego, inverse(rollout.T_rig_box))
    state: Mapping[str, F64] = {
        "ego_x_m": rig.xyz[:, 0],
        "ego_y_m": rig.xyz[:, 1],
        "ego_yaw_rad": yaw_from_quat(rig.quat),
        "ego_speed_mps": _speeds(rig.t_us, rig.xyz),
    }
    return [
        _row(t, name, float(v))
        for name, values in state.items()
        for t, v in zip(rig.t_us.tolist(), values, strict=True)
    ]


def _speeds(t_us: I64, xyz: F64) -> F64:
    if len(t_us) < 2:
        return np.zeros(len(t_us))
    seconds = (t_us - t_us[0]).astype(np.float64) * 1e-6
    return np.asarray(np.linalg.norm(np.gradient(xyz[:, :2], seconds, axis=0), axis=1))


def _placed(rollout: RolloutLog, reduction: Reduction) -> list[dict[str, Any]]:
    """Return the events with the position of the ego's box centre."""
    placed = []
    for event in reduction.events:
        at = rollout.ego.xyz[int(np.searchsorted(rollout.ego.t_us, event["t_us"]))]
        after_s = round((int(event["t_us"]) - rollout.render_start_us) * 1e-6, 3)
        placed.append(
            dict(event)
            | {"t_s": after_s, "x_m": round(float(at[0]), 3), "y_m": round(float(at[1]), 3)}
        )
    return sorted(placed, key=lambda event: (event["t_us"], event["metric"]))
