"""Score logs into a run folder: run.json, the tables, the reports, and AlpaSim's aggregation."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from alpasim_plugin import __version__
from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.files import file_sha256, real, some_of
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.parts import PartSpec, digest
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.log.run_folder import records
from alpasim_plugin.log.run_folder.manifests import read_run_json, write_manifest, write_run_json
from alpasim_plugin.log.run_folder.records import (
    Manifest,
    MetricValue,
    RunInfo,
    SceneFacts,
    ScoreConfig,
)
from alpasim_plugin.log.run_folder.schema import AGGREGATE, is_named, slug
from alpasim_plugin.log.run_folder.writer import (
    LoggedScene,
    unfinish,
    write_parquet,
    write_scene,
    writing,
)
from alpasim_plugin.runs.changes import changed_evaluators
from alpasim_plugin.runs.execute import Threads
from alpasim_plugin.runs.provenance import hardware, part_facts, project, versions
from alpasim_plugin.runs.run import finish_run, now
from alpasim_plugin.runs.score_logs import KnownScenes, LogScore, exit_code, score_logs
from alpasim_plugin.runs.summary import pool_of
from evaluators.alpasim import (
    EvalSettings,
    ReducedRollout,
    SceneScore,
    metrics_results_table,
    metrics_unprocessed_table,
    over_sweeps,
    reduce_run,
    results_summary,
    scene_score,
)
from evaluators.metrics import METRICS, table_of
from evaluators.metrics.presets import Preset
from evaluators.results import Summary, to_json


@dataclass(frozen=True)
class ScoreResult:
    """Result of scoring: the run folder, its summary and the process exit code."""

    root: Path
    summary: Summary
    exit_code: int

    def as_dict(self) -> JsonObject:
        """Return the result for JSON."""
        return {
            "out": str(self.root),
            "exit_code": self.exit_code,
            "summary": to_json(self.summary),
        }


def execute_score(
    logs: Sequence[Path],
    scenes: KnownScenes,
    preset: Preset,
    settings: EvalSettings | None,
    evaluators: Sequence[PartSpec],
    root: Path | None,
    command: Sequence[str],
    on_done: Callable[[Manifest], None],
    noticed: Callable[[str], None],
) -> ScoreResult:
    """Score logs and write run.json, the tables, the reports, and with preset ``alpasim`` its
    aggregation.

    Args:
        logs: The logs.
        scenes: Their scenes.
        preset: Evaluator preset.
        settings: AlpaSim's settings; None for other presets.
        evaluators: From `evaluators.resolve_evaluators`.
        root: Run folder; None makes one below ``runs/`` named after content and preset.
        command: The command line, for run.json.
        on_done: Called with each log's manifest.
        noticed: Called with one line that names the evaluators which have changed since the same
            command scored into the folder, if any have.

    Raises:
        InputError: The folder holds other results, or a log's scene is not among ``scenes``.
        InfrastructureError: Another process writes the folder.
    """
    began = time.perf_counter()
    key = _key(logs, scenes, preset, evaluators)
    root = root or Path("runs", f"score-{slug(real(logs[0]).parent.parent.name)}-{key}")
    with writing(root):
        earlier = _earlier_results(root, key)
        changes = changed_evaluators({} if earlier is None else earlier.parts, evaluators)
        if changes:
            noticed(f"scored again: {some_of(changes)}")
        unfinish(root)
        scores = score_logs(logs, scenes, preset, evaluators, root, on_done)
        aggregation, error = _aggregate(scores, preset, settings, root / AGGREGATE)
        manifests = [log_score.manifest for log_score in scores]
        for manifest in manifests:
            write_manifest(root / manifest.path, manifest)
        used = _write_scenes(root, scores, scenes)
        info = _run_info(key, scores, used, preset, settings, command, evaluators)
        write_run_json(root, info)
        allowed = settings is not None and settings.allow_aggregation_with_failed_rollouts
        code = exit_code(scores, allowed, error)
        pool = pool_of(manifests, Threads(1, 1), time.perf_counter() - began, None)
        info = replace(info, alpasim=aggregation, pool=pool, exit_code=code)
        summary = finish_run(root, info, manifests)
    return ScoreResult(root, summary, code)


def _key(
    logs: Sequence[Path], scenes: KnownScenes, preset: Preset, evaluators: Sequence[PartSpec]
) -> str:
    """Return what names the results: logs by content, scenes, preset and evaluators by name."""
    facts = {
        "logs": sorted(file_sha256(log) for log in logs),
        "scenes": scenes.places,
        "preset": preset.as_dict(),
        "evaluators": sorted(part.name for part in evaluators),
    }
    return digest(facts)[:12]


def _earlier_results(root: Path, key: str) -> RunInfo | None:
    """Return ``run.json`` of a folder into which the same logs were scored before; None where there
    is none, or a damaged one, which is written again.

    Raises:
        InputError: The folder holds other results.
    """
    try:
        info = read_run_json(root)
    except InputError:
        return None
    if info.key != key:
        raise InputError(
            f"{root}: the folder holds other results (key {info.key})",
            "Name another --out.",
        )
    return info


def _aggregate(
    scores: Sequence[LogScore], preset: Preset, settings: EvalSettings | None, folder: Path
) -> tuple[JsonObject | None, EvaluatorError | None]:
    """Aggregate as AlpaSim does, put its rollout values into the manifests, and write its files;
    without settings there is nothing to aggregate.

    An error of the scene score leaves the values of the rollouts.
    """
    if settings is None:
        return None, None
    finished = [log_score for log_score in scores if log_score.scored is not None]
    failed = [log_score.manifest for log_score in scores if log_score.scored is None]
    has_images = any(log_score.manifest.frames for log_score in finished)
    reduced: list[ReducedRollout] = []
    marks: dict[int, SceneScore] | None = None
    error: EvaluatorError | None = None
    try:
        if has_images:
            scored = [log_score.scored for log_score in finished if log_score.scored is not None]
            reduced = reduce_run(scored, preset)
        marks = _marks(reduced, settings)
    except EvaluatorError as caught:
        error = caught
    for number, (log_score, rollout) in enumerate(zip(finished, reduced, strict=False)):
        mark = None if marks is None else marks.get(number)
        log_score.manifest = _with_values(log_score.manifest, rollout, mark)
    skipped = _why_skipped(len(finished), len(failed), has_images, settings)
    files: list[str] = []
    if reduced and not skipped:
        files = _write_aggregate(folder, reduced, marks, failed, settings)
    facts: JsonObject = {
        "folder": AGGREGATE,
        "files": files,
        "skipped": skipped,
        "error": error and error.as_dict(),
    }
    return facts, error


def _why_skipped(n_finished: int, n_failed: int, has_images: bool, settings: EvalSettings) -> str:
    """Say why AlpaSim's files are not written; empty where they may be."""
    if n_failed and not settings.allow_aggregation_with_failed_rollouts:
        return (
            f"{n_failed} of {n_finished + n_failed} rollouts failed, and "
            "allow_aggregation_with_failed_rollouts is false"
        )
    if n_finished and not has_images:
        return "no log has an image, and its aggregation asks whether images are black"
    return ""


def _marks(reduced: Sequence[ReducedRollout], settings: EvalSettings) -> dict[int, SceneScore]:
    """Return the scene scores of the rollouts that count, by index; none where scores are off.

    Raises:
        EvaluatorError: A metric that the score needs is missing.
    """
    if not settings.scene_score.enabled:
        return {}
    return {
        number: scene_score(rollout.values, settings.scene_score)
        for number, rollout in enumerate(reduced)
        if not rollout.dropped
    }


def _with_values(manifest: Manifest, rollout: ReducedRollout, mark: SceneScore | None) -> Manifest:
    """Return a manifest with the values that AlpaSim gives a rollout, its scene score among them."""
    values = dict(rollout.reduction.values)
    if mark is None:
        return replace(manifest, metrics=values, scene_score=None)
    metric = METRICS["scene_score"]
    values["scene_score"] = MetricValue(mark.score, True, "", metric.unit, metric.direction)
    scene_facts = records.SceneScore(mark.failure_reason)
    return replace(manifest, metrics=values, scene_score=scene_facts)


def _write_aggregate(
    folder: Path,
    reduced: Sequence[ReducedRollout],
    marks: dict[int, SceneScore] | None,
    failed: Sequence[Manifest],
    settings: EvalSettings,
) -> list[str]:
    """Write AlpaSim's files and return their names; without ``marks`` no summary."""
    scored_rollouts = [rollout.scored for rollout in reduced]
    sweeps = over_sweeps(reduced)
    write_parquet(
        folder / "metrics_unprocessed.parquet", metrics_unprocessed_table(scored_rollouts)
    )
    write_parquet(
        folder / "metrics_results.parquet", metrics_results_table(sweeps, scored_rollouts)
    )
    files = ["metrics_unprocessed.parquet", "metrics_results.parquet"]
    if marks is None:
        return files
    rows = [
        {
            "clipgt_id": manifest.scene,
            "rollout_id": manifest.rollout,
            "run_uuid": None,
            "run_name": scored_rollouts[0].run_name,
            "error": "" if manifest.error is None else manifest.error.message,
        }
        for manifest in failed
    ]
    summary = results_summary(reduced, marks, rows, sweeps, settings.scene_score)
    write_json(folder / "results-summary.json", summary)
    return [*files, "results-summary.json"]


def _write_scenes(
    root: Path, scores: Sequence[LogScore], scenes: KnownScenes
) -> dict[str, Scenario | LoggedScene]:
    """Write the files of the scenes in which logs were scored, and return them by id."""
    used = {
        log_score.manifest.scene: scenes.of(log_score.manifest.scene)
        for log_score in scores
        if log_score.scored is not None
    }
    for scene in used.values():
        write_scene(root, scene)
    return used


def _run_info(
    key: str,
    scores: Sequence[LogScore],
    scenes: Mapping[str, Scenario | LoggedScene],
    preset: Preset,
    settings: EvalSettings | None,
    command: Sequence[str],
    evaluators: Sequence[PartSpec],
) -> RunInfo:
    manifests = [log_score.manifest for log_score in scores]
    named = [
        manifest for manifest in manifests if is_named(manifest.cell, manifest.ok)
    ] or manifests
    left_out = {note for scene in scenes.values() for note in scene.notes}
    return RunInfo(
        key=key,
        command=tuple(command),
        config=ScoreConfig(
            preset=preset.as_dict(),
            settings=None if settings is None else settings.model_dump(),
        ),
        preset=preset.name,
        renderers=tuple(dict.fromkeys(manifest.renderer for manifest in named)),
        policies=tuple(dict.fromkeys(manifest.policy for manifest in named)),
        seeds=tuple(dict.fromkeys(manifest.seed for manifest in manifests)),
        scenes={
            name: SceneFacts(
                source=scene.source,
                content_hash=scene.content_hash,
                notes=tuple(scene.notes),
            )
            for name, scene in scenes.items()
        },
        kind="score",
        version=__version__,
        started_at=now(),
        project=project(),
        code={"scoring": package_digest()[:12]},
        metrics=dict(table_of(evaluators)),
        parts={f"{part.kind} {part.name}": part_facts(part) for part in evaluators},
        unseen={f"{part.kind} {part.name}": part.unseen for part in evaluators if part.unseen},
        hardware=hardware(),
        versions=versions(),
        left_out=tuple(sorted(left_out)),
        logs=tuple(dict.fromkeys(manifest.log or "" for manifest in manifests)),
    )
