"""Score one rollout from its log and flatten the result for the tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.geometry import inverse, offset_trajectory, yaw_from_quat
from alpasim_plugin.core.json_types import JsonObject, JsonView
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
from alpasim_plugin.log.run_folder.records import Contact, DriveEvent, Ledger, Manifest, MetricValue
from evaluators import Preset, Reduction, contact_events, reduce_rollout, score
from evaluators import preset as find_preset
from evaluators.alpasim import scene_score
from evaluators.alpasim.settings import SceneScoreSettings
from evaluators.metrics import METRICS
from evaluators.metrics.route import lateral_bias

# Of a speculative fixer: distance of the camera pose of the shown frame, and of the forecast pose,
# from the true pose.
FIXER_FACTS = ("pose_error_m", "forecast_error_m", RECORDED_SHARE, GUESSED_SHARE)


@dataclass(frozen=True)
class Scores:
    """What scoring adds to a manifest; see `alpasim_plugin.log.run_folder.records.Manifest`."""

    metrics: dict[str, MetricValue]
    events: tuple[DriveEvent, ...]
    contacts: tuple[Contact, ...]
    censored: Ledger

    def stated_in(self, manifest: Manifest) -> Manifest:
        """Return a manifest with the scores."""
        return replace(
            manifest,
            metrics=self.metrics,
            events=self.events,
            contacts=self.contacts,
            censored=self.censored,
        )


def score_log(
    log: Path,
    frames: Path,
    scenario: Scenario,
    preset: str,
    evaluators: Sequence[PartSpec] | None = None,
) -> tuple[list[JsonObject], Scores]:
    """Read a log and score it as `tabulate` does; the scores depend on the written log alone.

    Raises:
        EvaluatorError: An evaluator could not compute a required value.
    """
    rollout = read_asl(log)
    series = score(rollout, scenario.scene, preset, evaluators)
    return tabulate(rollout, series, preset, read_facts(frames))


def tabulate(
    rollout: RolloutLog,
    series: Sequence[MetricSeries],
    preset: str | Preset,
    frames: Sequence[JsonView] = (),
) -> tuple[list[JsonObject], Scores]:
    """Flatten a scored rollout for the tables.

    Args:
        rollout: The log.
        series: Result of `evaluators.score`.
        preset: By which they are reduced.
        frames: Facts per camera frame, if known.

    Returns:
        Rows of ``steps.parquet`` without the rollout's key; and what the manifest says.
    """
    reduction = reduce_rollout(series, preset)
    chosen = find_preset(preset)
    contacts = contact_events(rollout, chosen) if chosen.contact == "between_steps" else ()
    # Reports draw the distance from the recorded path also of runs whose preset does not score it.
    tabled = [*series]
    if not any(metric_series.name == "lateral_bias_m" for metric_series in series):
        tabled.append(lateral_bias(rollout))
    rows = []
    for metric_series in tabled:
        reason = metric_series.reason
        for t_us, value, valid in zip(
            metric_series.t_us.tolist(),
            metric_series.value.tolist(),
            metric_series.valid.tolist(),
            strict=True,
        ):
            row = _row(t_us, metric_series.name, None if np.isnan(value) else value)
            rows.append(row | {"valid": valid, "reason": "" if valid else reason})
    rows += _ego_rows(rollout)
    for facts in frames:
        opacity = facts["opacity_mean"]
        rows.append(_row(facts["t_us"], "opacity_mean", opacity, "the renderer gives no opacity"))
    for name in FIXER_FACTS:
        rows += [_row(facts["t_us"], name, facts[name]) for facts in frames if name in facts]
    scores = Scores(
        metrics={**reduction.values, **_scene_score(reduction.values, chosen)},
        events=_placed(rollout, reduction),
        contacts=tuple(contact.rounded() for contact in contacts),
        censored=reduction.ledger,
    )
    return rows, scores


def _scene_score(values: Mapping[str, MetricValue], preset: Preset) -> dict[str, MetricValue]:
    """Return AlpaSim's score of a rollout under its presets, with its usual settings; nothing under
    others, and a reason where a metric that it needs is missing.
    """
    if not preset.has_scene_score:
        return {}
    metric = METRICS["scene_score"]
    numbers = {name: entry.value for name, entry in values.items()}
    try:
        score = scene_score(numbers, SceneScoreSettings()).score
    except EvaluatorError as error:
        return {
            "scene_score": MetricValue(None, False, error.message, metric.unit, metric.direction)
        }
    return {"scene_score": MetricValue(score, True, "", metric.unit, metric.direction)}


def _ego_rows(rollout: RolloutLog) -> list[JsonObject]:
    """Return rows of the ego's state, for plots and stratified results."""
    rig = offset_trajectory(rollout.ego, inverse(rollout.T_rig_box))
    state: Mapping[str, F64] = {
        "ego_x_m": rig.xyz[:, 0],
        "ego_y_m": rig.xyz[:, 1],
        "ego_yaw_rad": yaw_from_quat(rig.quat),
        "ego_speed_mps": _speeds(rig.t_us, rig.xyz),
    }
    return [
        _row(t, name, float(value))
        for name, values in state.items()
        for t, value in zip(rig.t_us.tolist(), values, strict=True)
    ]


def _row(t_us: int | None, metric: str, value: Any, why_missing: str = "") -> JsonObject:
    is_missing = value is None
    return {
        "t_us": t_us or 0,
        "metric": metric,
        "value": value,
        "valid": not is_missing,
        "reason": why_missing if is_missing else "",
    }


def _speeds(t_us: I64, xyz: F64) -> F64:
    if len(t_us) < 2:
        return np.zeros(len(t_us))
    seconds = (t_us - t_us[0]).astype(np.float64) * 1e-6
    return np.linalg.norm(np.gradient(xyz[:, :2], seconds, axis=0), axis=1)


def _placed(rollout: RolloutLog, reduction: Reduction) -> tuple[DriveEvent, ...]:
    """Return the events with the position of the ego's box centre."""
    placed = []
    for event in reduction.events:
        position = rollout.ego.xyz[int(np.searchsorted(rollout.ego.t_us, event["t_us"]))]
        after_s = round((int(event["t_us"]) - rollout.render_start_us) * 1e-6, 3)
        placed.append(
            DriveEvent(
                metric=event["metric"],
                t_us=event["t_us"],
                t_s=after_s,
                x_m=round(float(position[0]), 3),
                y_m=round(float(position[1]), 3),
            )
        )
    return tuple(sorted(placed, key=lambda event: (event.t_us, event.metric)))
