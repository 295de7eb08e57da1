"""What AlpaSim makes of scored rollouts: values of a whole run, means over sweeps, the scene score,
and its result files.

Which metrics exist depends on all rollouts of a run. Rollouts of different scenes are paired by
rank: the first in the order of their names of every scene make one sweep, the second ones the next.
A metric is averaged over the scenes of a sweep, then mean and sample standard deviation are taken
over sweeps. That spread is neither a scene-to-scene spread nor a confidence interval;
`evaluators.statistics` gives those. A rollout's score is 0 after a fault, else how much of the
recorded path was driven.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64, MetricInfo, MetricSeries
from evaluators.alpasim.settings import SceneScoreSettings
from evaluators.metrics import MetricValue
from evaluators.metrics.presets import Preset
from evaluators.metrics.score import series
from evaluators.statistics.reduce import Reduction, reduce_rollout

WITHOUT_MAP = "the map was missing, or had no road edge where one was needed"


@dataclass(frozen=True)
class ScoredRollout:
    """A scored log and its names."""

    scene: str
    rollout: str  # the log's folder name
    series: tuple[MetricSeries, ...]
    run_uuid: str | None = None
    run_name: str | None = None


@dataclass(frozen=True)
class ReducedRollout:
    """Its values; metrics of the run that this rollout does not have are None."""

    scored: ScoredRollout
    reduction: Reduction

    @property
    def dropped(self) -> str:
        """Say why the whole rollout does not count, or nothing."""
        return self.reduction.ledger.dropped

    @property
    def values(self) -> dict[str, float | None]:
        """Return the value of every metric."""
        return {name: value.value for name, value in self.reduction.values.items()}


def reduce_run(rollouts: Sequence[ScoredRollout], preset: Preset) -> list[ReducedRollout]:
    """Reduce all rollouts of a run.

    Off-road follows AlpaSim: where no rollout of the run has it, it counts as 0 when events are
    combined and is itself left out; where only some have it, events combined with it are unknown
    for the others unless the other part fired.

    Raises:
        EvaluatorError: No rollout has a camera image: AlpaSim's aggregation needs the black-image
            test in at least one.
    """
    names = {
        metric_series.name: metric_series.metric
        for rollout in rollouts
        for metric_series in rollout.series
    }
    if rollouts and "img_is_black" not in names:
        raise EvaluatorError(
            f"{len(rollouts)} rollouts: no image of camera {preset.image_camera!r} in any log",
            "log that camera, or name another one in scorers.image.camera_logical_id",
        )
    return [_reduce(rollout, names, preset) for rollout in rollouts]


def _reduce(
    rollout: ScoredRollout, names: Mapping[str, MetricInfo], preset: Preset
) -> ReducedRollout:
    series_names = {metric_series.name for metric_series in rollout.series}
    line = next(
        metric_series.t_us
        for metric_series in rollout.series
        if metric_series.name == "eval_relevant"
    )
    added = []
    if "offroad" not in series_names:
        none_has_map = "offroad" not in names
        added.append(
            series("offroad", line, 0.0 if none_has_map else np.nan, none_has_map, WITHOUT_MAP)
        )
    reduction = reduce_rollout([*rollout.series, *added], preset)
    values = dict(reduction.values)
    if added and "offroad" not in names:
        del values["offroad"]
    for name, metric in names.items():
        if name not in series_names:
            facts = values.get(name) or MetricValue(None, False, "", metric.unit, metric.direction)
            values[name] = replace(
                facts,
                value=None,
                valid=False,
                reason=reduction.ledger.dropped or "not scored in this rollout",
            )
    return ReducedRollout(rollout, replace(reduction, values=values))


INCIDENTS = {
    "avg_dist_between_incidents": "offroad_or_collision",
    "avg_dist_between_incidents_at_fault": "offroad_or_collision_at_fault",
}  # km


def over_sweeps(rollouts: Sequence[ReducedRollout]) -> dict[str, float | int | None]:
    """Return one row: every metric, ``n_clips`` and the distances between incidents in km, each
    with ``_std``, and ``n_rollouts``.

    ``n_clips`` is the mean number of scenes of a sweep: a fraction where rollouts were dropped. A
    distance is inf in a sweep without incident. None where no sweep has a value, or a spread has
    fewer than two.

    Raises:
        InputError: Two rollouts of a scene have the same name.
    """
    by_rank: dict[int, list[dict[str, float | None]]] = {}
    for rank, rollout in zip(_ranks(rollouts), rollouts, strict=True):
        if not rollout.dropped:
            by_rank.setdefault(rank, []).append(rollout.values)
    if not by_rank:
        return {}
    rows = [_sweep(by_rank[rank]) for rank in sorted(by_rank)]
    out: dict[str, float | int | None] = {}
    spread: dict[str, float | int | None] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        column = _column(rows, name)
        with np.errstate(invalid="ignore"):  # the spread of inf is NaN, as in AlpaSim's table
            out[name] = float(np.mean(column)) if len(column) else None
            spread[f"{name}_std"] = float(np.std(column, ddof=1)) if len(column) > 1 else None
    return {**out, **spread, "n_rollouts": len(rows)}


def _ranks(rollouts: Sequence[ReducedRollout]) -> list[int]:
    """Return the rank of each rollout among the names of its scene, dropped ones included: rollouts
    of one rank are a sweep.

    Raises:
        InputError: Two rollouts of a scene have the same name.
    """
    names: dict[str, list[str]] = {}
    for rollout in rollouts:
        names.setdefault(rollout.scored.scene, []).append(rollout.scored.rollout)
    for scene, scene_rollouts in names.items():
        twice = next((name for name in scene_rollouts if scene_rollouts.count(name) > 1), None)
        if twice is not None:
            raise InputError(
                f"scene {scene!r}: two rollouts named {twice!r}",
                "score the runs apart, or rename the folder of one log",
            )
        scene_rollouts.sort()
    return [names[rollout.scored.scene].index(rollout.scored.rollout) for rollout in rollouts]


def _column(rows: Sequence[Mapping[str, float | None]], name: str) -> F64:
    return np.array([row[name] for row in rows if row.get(name) is not None], dtype=np.float64)


def _sweep(rows: Sequence[dict[str, float | None]]) -> dict[str, float | None]:
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: _column(rows, name) for name in names}
    out: dict[str, float | None] = {
        name: float(np.mean(column)) if len(column) else None for name, column in columns.items()
    }
    out["n_clips"] = float(len(rows))
    for name, event in INCIDENTS.items():
        with np.errstate(divide="ignore", invalid="ignore"):
            out[name] = float(np.sum(columns["dist_traveled_m"]) / np.sum(columns[event]) / 1000)
    return out


FAULTS = ("collision_at_fault", "offroad")
LATER_FAULTS = (*FAULTS, "left_corridor_laterally")  # from commit 6f1029c on


@dataclass(frozen=True)
class SceneScore:
    """Score of one rollout."""

    score: float  # 0..1
    progress_score: float  # 0..1, what the score would be without a fault
    failure_reason: str | None  # the first of the faults

    @property
    def passed(self) -> bool:
        """Return whether no fault happened, whatever the progress."""
        return self.failure_reason is None


def scene_score(values: Mapping[str, float | None], settings: SceneScoreSettings) -> SceneScore:
    """Score a rollout: ``min(clip(progress, 0, 1) / saturation, 1)``, 1 on recordings shorter than
    the least distance, 0 after a fault.

    Args:
        values: Rollout values by metric.
        settings: Saturation and least distance.

    Raises:
        EvaluatorError: A metric that is needed is missing or not finite; AlpaSim stops there too.
    """
    scores: dict[str, float] = {}
    faults = (
        LATER_FAULTS if LATER_FAULTS[-1] in values else FAULTS
    )  # only a preset that has the rule has the metric
    needed = ("progress_clipped_rel", "gt_dist_traveled_m", *faults)
    for name in needed:
        value = values.get(name)
        if name not in values or value is None or not np.isfinite(value):
            kind = (
                f"missing metric {name!r}" if name not in values else f"metric {name!r} is {value}"
            )
            raise EvaluatorError(
                f"metrics {', '.join(needed)}: {kind}",
                "give the scene a map with road edges, or set scene_score.enabled: false in --settings",
            )
        scores[name] = float(value)
    progress = min(
        min(max(scores["progress_clipped_rel"], 0.0), 1.0) / settings.progress_saturation_threshold,
        1.0,
    )
    if scores["gt_dist_traveled_m"] < settings.min_gt_distance_for_full_score_m:
        progress = 1.0
    reason = next((name for name in faults if scores[name] != 0.0), None)
    return SceneScore(0.0 if reason else progress, progress, reason)


SCHEMA_VERSION = 1
SCORE_METRICS = (
    "progress_clipped_rel",
    "progress_rel",
    "progress_score",
    "collision_at_fault",
    "offroad",
    "dist_to_gt_trajectory",
    "gt_dist_traveled_m",
)
LATER_SCORE_METRICS = (*SCORE_METRICS, "lateral_dist_to_gt_trajectory", "left_corridor_laterally")


def combined_run_uuid(rollouts: Sequence[ScoredRollout]) -> str:
    """Return the id under which runs are put together: the SHA-256 of their sorted ids."""
    ids = sorted({rollout.run_uuid for rollout in rollouts if rollout.run_uuid is not None})
    return hashlib.sha256("\x1f".join(ids).encode()).hexdigest()


STEPS = pa.schema(
    [
        ("name", pa.string()),
        ("timestamps_us", pa.int64()),
        ("values", pa.float64()),
        ("valid", pa.bool_()),
        ("time_aggregation", pa.string()),
        *((name, pa.string()) for name in ("clipgt_id", "rollout_id", "run_uuid", "run_name")),
    ]
)


def metrics_unprocessed_table(rollouts: Sequence[ScoredRollout]) -> pa.Table:
    """Return every step of every metric, long; a metric without values has one row without a
    time.
    """
    rows = []
    for rollout in rollouts:
        ids = (rollout.scene, rollout.rollout, rollout.run_uuid, rollout.run_name)
        for metric_series in rollout.series:
            steps = zip(
                metric_series.t_us.tolist(),
                metric_series.value.tolist(),
                metric_series.valid.tolist(),
                strict=True,
            )
            for step in list(steps) or [(None, None, None)]:
                row = (metric_series.name, *step, metric_series.metric.aggregation, *ids)
                rows.append(dict(zip(STEPS.names, row, strict=True)))
    return pa.Table.from_pylist(rows, STEPS)


def metrics_results_table(
    row: Mapping[str, float | int | None], rollouts: Sequence[ScoredRollout]
) -> pa.Table:
    """Return the one-row table over sweeps."""
    columns: dict[str, pa.Array] = {
        "run_uuid": pa.array([combined_run_uuid(rollouts)], pa.string())
    }
    columns |= {
        name: pa.array([value], pa.int64() if name == "n_rollouts" else pa.float64())
        for name, value in row.items()
    }
    columns["run_name"] = pa.array([rollouts[0].run_name if rollouts else None], pa.string())
    return pa.table(columns)


def results_summary(
    rollouts: Sequence[ReducedRollout],
    scores: Mapping[int, SceneScore],
    failed: Sequence[JsonView],
    sweeps: Mapping[str, float | int | None],
    settings: SceneScoreSettings,
) -> JsonObject:
    """Return ``results-summary.json``: one entry per counted rollout, failed ones after them, then
    the row over sweeps.

    Args:
        rollouts: All reduced rollouts; dropped ones have no entry.
        scores: Scene score by index into ``rollouts``; empty where the score is off.
        failed: ``clipgt_id``, ``rollout_id``, ``run_uuid``, ``run_name`` and ``error`` of rollouts
            that failed.
        sweeps: What `over_sweeps` gave.
        settings: Of the scene score.
    """
    run_uuid = combined_run_uuid([rollout.scored for rollout in rollouts])
    is_later = any("left_corridor_laterally" in rollout.values for rollout in rollouts)
    score_metrics = LATER_SCORE_METRICS if is_later else SCORE_METRICS
    counted = [(i, rollout) for i, rollout in enumerate(rollouts) if not rollout.dropped]
    counted.sort(key=lambda item: (item[1].scored.scene, item[1].scored.rollout))
    entries = [
        *(_entry(rollout, scores.get(i), run_uuid, score_metrics) for i, rollout in counted),
        *(_failed_entry(failure, settings.enabled, score_metrics) for failure in failed),
    ]
    overall: JsonObject = {key: _number(value) for key, value in sweeps.items()}
    overall["run_uuid"] = run_uuid
    overall["run_name"] = rollouts[0].scored.run_name if rollouts else None
    out: JsonObject = {
        "schema_version": SCHEMA_VERSION,
        "scene_score_enabled": settings.enabled,
        "rollouts": entries,
        "metrics_results": [overall] if sweeps else [],
    }
    if settings.enabled:
        out["score_criteria"] = _criteria(settings, is_later)
    return out


def _failed_entry(failure: JsonView, is_scored: bool, score_metrics: Sequence[str]) -> JsonObject:
    """Return the entry of a rollout that failed; its score is 0 where scenes have scores."""
    ids = {key: failure.get(key) for key in ("run_uuid", "run_name", "clipgt_id", "rollout_id")}
    error = failure.get("error")
    entry: JsonObject = ids | {
        "status": "fail",
        "passed": False,
        "failure_reason": error,
        "metrics": ids | {"error": error},
    }
    if is_scored:
        entry["score"] = 0.0
        entry["score_metrics"] = dict.fromkeys(score_metrics) | {"progress_score": 0.0}
    return entry


def _criteria(settings: SceneScoreSettings, is_later: bool) -> JsonObject:
    """Return in words by what a scene is scored; ``is_later``: by AlpaSim's rules from commit
    6f1029c on.
    """
    saturation = settings.progress_saturation_threshold
    least_m = settings.min_gt_distance_for_full_score_m
    criteria = {
        "collision_at_fault": "== 0",
        "offroad": "== 0",
        "progress_score": f"min(clamp(progress_clipped_rel, 0, 1) / {saturation}, 1.0)",
        "short_gt_distance_override": f"progress_score = 1.0 when gt_dist_traveled_m < {least_m}",
    }
    if is_later:
        criteria["left_corridor_laterally"] = "== 0"
    return criteria


def _entry(
    rollout: ReducedRollout, score: SceneScore | None, run_uuid: str, score_metrics: Sequence[str]
) -> JsonObject:
    ids = {
        "run_uuid": run_uuid,
        "run_name": rollout.scored.run_name,
        "clipgt_id": rollout.scored.scene,
        "rollout_id": rollout.scored.rollout,
    }
    values = {name: _number(value) for name, value in rollout.values.items()}
    entry: JsonObject = {"status": "unscored"}
    entry |= dict.fromkeys(("passed", "score", "failure_reason", "score_metrics"))
    if score is not None:
        values_with_progress = values | {"progress_score": score.progress_score}
        entry = {
            "status": "pass" if score.passed else "fail",
            "passed": score.passed,
            "score": score.score,
            "failure_reason": score.failure_reason,
            "score_metrics": {name: values_with_progress.get(name) for name in score_metrics},
        }
    return ids | entry | {"metrics": values | ids}


def _number(value: float | int | None) -> float | int | None:
    return value if value is None or isinstance(value, int) or np.isfinite(value) else None
