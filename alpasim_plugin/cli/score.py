"""``simrun score``: score rollout logs again without rendering."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from alpasim_plugin.cli.options import Evaluators, Json, Presets
from alpasim_plugin.cli.progress import describe, report_line
from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import EvaluatorError, InputError, error_text
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts import PartSpec, digest
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.log.run_folder.manifests import (
    read_run_json,
    write_manifest,
    write_run_json,
)
from alpasim_plugin.log.run_folder.schema import AGGREGATE, SUMMARY, slug
from alpasim_plugin.log.run_folder.writer import write_parquet, write_scene, writing
from alpasim_plugin.runs.execute import Threads
from alpasim_plugin.runs.provenance import hardware, versions
from alpasim_plugin.runs.run import SCHEMA_VERSION, finish_run, origin_of
from alpasim_plugin.runs.score_logs import KnownScenes, LogScore, exit_code, find_logs, score_logs
from alpasim_plugin.runs.summary import pool_of
from evaluators import preset as find_preset
from evaluators import resolve_evaluators
from evaluators.alpasim import (
    EvalSettings,
    SceneScore,
    ScoredRollout,
    load_settings,
    metrics_results_table,
    metrics_unprocessed_table,
    over_sweeps,
    reduce_run,
    results_summary,
    scene_score,
)
from evaluators.metrics import METRICS, MetricTable, presets, table_of
from evaluators.metrics.presets import Preset
from evaluators.report import render_presets, render_table
from evaluators.statistics.reduce import RolloutValue


@dataclass(frozen=True)
class ScoreResult:
    """Result of scoring: the run folder, its summary and the process exit code."""

    root: Path
    summary: dict[str, Any]
    exit_code: int


def execute_score(
    logs: Sequence[Path],
    scenes: KnownScenes,
    preset: Preset,
    settings: EvalSettings | None,
    evaluators: Sequence[PartSpec],
    root: Path | None,
    command: Sequence[str],
    on_done: Callable[[dict[str, Any]], None],
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

    Raises:
        InputError: The folder holds other results, or a log's scene is not among ``scenes``.
        InfrastructureError: Another process writes the folder.
    """
    began = time.perf_counter()
    key = digest(
        {
            "logs": sorted(_hash(log) for log in logs),
            "scenes": scenes.places,
            "preset": preset.as_dict(),
        }
    )[:12]
    root = root or Path("runs", f"score-{slug(logs[0].resolve().parent.parent.name)}-{key}")
    with writing(root):
        held = _held_key(root)
        if held not in (None, key):
            raise InputError(
                f"folder {root}: it holds other results (key {held})",
                "choose another --out",
            )
        (root / SUMMARY).unlink(missing_ok=True)  # from here on the folder is unfinished
        scores = score_logs(logs, scenes, preset, evaluators, root, on_done)
        aggregation: dict[str, Any] | None = None
        error: EvaluatorError | None = None
        if settings is not None:
            aggregation, error = _aggregate(scores, preset, settings, root)
        manifests = [one.manifest for one in scores]
        for manifest in manifests:
            write_manifest(root / manifest["path"], manifest)
        _write_info(root, key, scores, scenes, preset, settings, command, table_of(evaluators))
        code = exit_code(
            scores, settings is not None and settings.allow_aggregation_with_failed_rollouts, error
        )
        more = {
            "pool": pool_of(manifests, Threads(1, 1), time.perf_counter() - began, None),
            "exit_code": code,
        }
        summary = finish_run(
            root,
            manifests,
            more | ({} if aggregation is None else {"alpasim": aggregation}),
        )
    return ScoreResult(root, summary, code)


def _held_key(root: Path) -> str | None:
    """Return the key of the results that a folder holds; None for a new one, or where ``run.json``
    is damaged: it is written again.
    """
    try:
        return str(read_run_json(root)["key"])
    except InputError:
        return None


def _aggregate(
    scores: Sequence[LogScore], preset: Preset, settings: EvalSettings, root: Path
) -> tuple[dict[str, Any], EvaluatorError | None]:
    """Aggregate as AlpaSim does, put its rollout values into the manifests, and write its files."""
    good = [one for one in scores if one.scored is not None]
    failed = [one.manifest for one in scores if one.scored is None]
    skipped = ""
    if failed and not settings.allow_aggregation_with_failed_rollouts:
        skipped = f"{len(failed)} of {len(scores)} rollouts failed, and allow_aggregation_with_failed_rollouts is false"
    reduced, marks, error = _reduce(
        [one.scored for one in good if one.scored is not None], preset, settings
    )
    for i, one in enumerate(reduced):
        values = dict(one.reduction.values)
        if i in marks:
            facts = METRICS["scene_score"]
            values["scene_score"] = RolloutValue(
                marks[i].score, True, "", facts.unit, facts.direction
            )
        good[i].manifest["metrics"] = {name: value.as_dict() for name, value in values.items()}
        good[i].manifest["scene_score"] = (
            None if i not in marks else {"failure_reason": marks[i].failure_reason}
        )
    written: list[str] = []
    if reduced and not skipped:
        written = _write_aggregate(
            root / AGGREGATE, reduced, None if error else marks, failed, settings
        )
    return {
        "folder": AGGREGATE,
        "files": written,
        "skipped": skipped,
        "error": error.as_dict() if error else None,
    }, error


def _reduce(
    scored: Sequence[ScoredRollout], preset: Preset, settings: EvalSettings
) -> tuple[Sequence[Any], dict[int, SceneScore], EvaluatorError | None]:
    """Reduce rollouts to values, and score their scenes; an error of the scene score leaves the
    values.
    """
    if not scored:
        return [], {}, None
    try:
        reduced = reduce_run(scored, preset)
    except EvaluatorError as error:
        return [], {}, error
    try:
        kept = [
            (i, one)
            for i, one in enumerate(reduced)
            if settings.scene_score.enabled and not one.dropped
        ]
        return reduced, {i: scene_score(one.values, settings.scene_score) for i, one in kept}, None
    except EvaluatorError as error:
        return reduced, {}, error


def _write_aggregate(
    folder: Path,
    reduced: Sequence[Any],
    marks: dict[int, SceneScore] | None,
    failed: Sequence[dict[str, Any]],
    settings: EvalSettings,
) -> list[str]:
    """Write AlpaSim's files and return their names; without ``marks`` no summary."""
    own, sweeps = [one.of for one in reduced], over_sweeps(reduced)
    write_parquet(folder / "metrics_unprocessed.parquet", metrics_unprocessed_table(own))
    write_parquet(folder / "metrics_results.parquet", metrics_results_table(sweeps, own))
    if marks is None:
        return ["metrics_unprocessed.parquet", "metrics_results.parquet"]
    rows = []
    for one in failed:
        ids = {
            "clipgt_id": one["scene"],
            "rollout_id": one["rollout"],
            "run_uuid": None,
            "run_name": own[0].run_name,
        }
        rows.append(ids | {"error": one["error"]["message"]})
    write_json(
        folder / "results-summary.json",
        results_summary(reduced, marks, rows, sweeps, settings.scene_score),
    )
    return ["metrics_unprocessed.parquet", "metrics_results.parquet", "results-summary.json"]


def _write_info(
    root: Path,
    key: str,
    scores: Sequence[LogScore],
    scenes: KnownScenes,
    preset: Preset,
    settings: EvalSettings | None,
    command: Sequence[str],
    metrics: MetricTable,
) -> None:
    used = {
        one.manifest["scene"]: scenes.of(one.manifest["scene"])
        for one in scores
        if one.scored is not None
    }
    for scene in used.values():
        write_scene(root, scene)

    def names(column: str) -> list[Any]:
        return list(dict.fromkeys(one.manifest[column] for one in scores))

    write_run_json(
        root,
        {
            **{"schema_version": SCHEMA_VERSION, "kind": "score", "key": key},
            **origin_of(command),
            "config": {
                "preset": preset.as_dict(),
                "settings": None if settings is None else settings.model_dump(mode="json"),
            },
            "preset": preset.name,
            "renderers": names("renderer"),
            "policies": names("policy"),
            "seeds": names("seed"),
            "logs": names("log"),
            "scenes": {
                name: {
                    "source": one.source,
                    "content_hash": one.content_hash,
                    "notes": list(one.notes),
                }
                for name, one in used.items()
            },
            "code": {"scoring": package_digest()[:12]},
            "metrics": metrics.as_dict(),
            "weights": {},
            "hardware": hardware(),
            "versions": versions(),
            "left_out": sorted({note for one in used.values() for note in one.notes}),
        },
    )


def _hash(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot open: {error.strerror}", "check the path") from error


EPILOG = """
Examples:

- `simrun score rollouts/SCENE/ROLLOUT/rollout.asl --scene scenes/SCENE.usdz --preset alpasim`

- `simrun score 'rollouts/*/*/rollout.asl' --scene scenes --preset alpasim --settings eval-config.yaml --out scored`

- `simrun score runs/smoke/rollouts/3dgs --scene suites/smoke --preset strict`

- `simrun score runs/smoke --scene suites/smoke --preset strict,nuplan,navsim` prints the scores side by side
"""


def score(
    logs: Annotated[
        tuple[str, ...],
        Positional("Logs (.asl, AlpaSim's or ours), folders of them, or patterns in quotes."),
    ],
    scene: Annotated[
        tuple[str, ...],
        Flag(
            "The logs' scene: .usdz, scenario YAML, recorded log, or a folder of them. Repeatable."
        ),
    ],
    preset: Presets = presets.DEFAULT,
    settings: Annotated[
        Path | None, Flag("AlpaSim's eval-config.yaml, with --preset alpasim.")
    ] = None,
    rails: Annotated[
        bool,
        Flag("Lanes by their rails, or their centres widened by 1.85 m.", "--rails/--no-rails"),
    ] = True,
    evaluators: Evaluators = (),
    out: Annotated[
        Path | None, Flag("Run folder; by default one below runs/ named by logs and preset.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Score rollout logs, AlpaSim's or ours, without rendering; the files are those of a run.

    Rows name the log by its folder in the column `rollout`. With `--preset alpasim` AlpaSim's own
    aggregation and scene score are written to `aggregate/` as well. Nothing in a log is ever
    unpickled.
    """
    names = list(dict.fromkeys(part.strip() for part in preset.split(",")))
    chosen = {name: find_preset(name) for name in names}
    own = {
        name: _settings(one, settings if len(names) == 1 or one.aliases else None)
        for name, one in chosen.items()
    }
    found = find_logs(logs)
    results: dict[str, ScoreResult] = {}
    for name, one in chosen.items():
        mine = own[name]
        results[name] = execute_score(
            found,
            KnownScenes(scene, rails),
            one if mine is None else mine.preset(one),
            mine,
            resolve_evaluators(evaluators),
            out if out is None or len(names) == 1 else out / name,
            ["simrun", *sys.argv[1:]],
            _teller(len(found), as_json),
        )
    code = max(one.exit_code for one in results.values())
    said = {
        name: {"out": str(one.root), "exit_code": one.exit_code, "summary": one.summary}
        for name, one in results.items()
    }
    if as_json:
        print(
            json.dumps(said[names[0]] if len(names) == 1 else {"exit_code": code, "presets": said})
        )
    for result in () if as_json else results.values():
        _print(result, len(names) == 1)
    if not as_json and (len(names) > 1 or any(one.protocol for one in chosen.values())):
        Console().print(render_presets({name: one.summary for name, one in results.items()}))
    raise typer.Exit(code)


def _teller(count: int, silent: bool) -> Callable[[dict[str, Any]], None]:
    """Return what tells of each log that is scored."""
    done = 0

    def on_done(manifest: dict[str, Any]) -> None:
        nonlocal done
        done += 1
        if not silent:
            print(
                f"[{done}/{count}] {manifest['rollout']}: {describe(manifest, reused=False)}",
                file=sys.stderr,
                flush=True,
            )

    return on_done


def _settings(preset: presets.Preset, path: Path | None) -> EvalSettings | None:
    """Return AlpaSim's settings where its preset is meant; its defaults where no file is given."""
    if preset.reproduces is not None:
        return EvalSettings() if path is None else load_settings(path)
    if path is not None:
        raise InputError(
            f"--settings {path}: --preset {preset.name}",
            "add --preset alpasim: the file is AlpaSim's",
        )
    return None


def _print(result: ScoreResult, with_table: bool) -> None:
    if with_table:
        Console().print(
            render_table(
                result.summary,
                headline_only=True,
                known=MetricTable.of_run(read_run_json(result.root)),
            )
        )
    for cell in result.summary["failures"]["cells"][:5]:
        print(error_text(cell["error"]), file=sys.stderr)
    aggregation = result.summary.get("alpasim") or {}
    if aggregation.get("skipped"):
        print(f"AlpaSim's aggregation was not written: {aggregation['skipped']}", file=sys.stderr)
    if aggregation.get("error"):
        print(error_text(aggregation["error"]), file=sys.stderr)
    print(report_line(result.root))
