"""``simrun score``: score rollout logs again without rendering."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from alpasim_plugin.cli.options import Evaluators, Json
from alpasim_plugin.cli.output import Progress, first_screen, report_lines, show, warn
from alpasim_plugin.core.errors import InputError, error_lines
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.log.run_folder.records import Manifest
from alpasim_plugin.runs.score import ScoreResult, execute_score
from alpasim_plugin.runs.score_logs import KnownScenes, find_logs
from evaluators import preset as find_preset
from evaluators import resolve_evaluators
from evaluators.alpasim import EvalSettings, load_settings
from evaluators.metrics import presets
from evaluators.pages.terminal import render_presets
from evaluators.results import Summary, to_json
from evaluators.statistics.opening import read_run
from evaluators.statistics.verdicts import worst_code

SHOWN_FAILURES = 5

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
        Positional("Logs (.asl), folders of them, or patterns in quotes."),
    ],
    scene: Annotated[
        tuple[str, ...],
        Flag("The logs' scene: a scenario, a recorded log, or a folder of them. Repeatable."),
    ],
    preset: Annotated[
        str, Flag("Evaluator presets, separated by commas.", names="preset")
    ] = presets.DEFAULT,
    settings: Annotated[
        Path | None, Flag("AlpaSim's eval-config.yaml, with --preset alpasim.")
    ] = None,
    evaluators: Evaluators = (),
    out: Annotated[Path | None, Flag("Run folder; default: below runs/.")] = None,
    as_json: Json = False,
) -> None:
    """Score rollout logs, AlpaSim's or ours, without rendering.

    Rows name the log by its folder in the column `rollout`. With `--preset alpasim` AlpaSim's own
    aggregation and scene score are written to `aggregate/` as well. Nothing in a log is ever
    unpickled.
    """
    chosen = {name: find_preset(name) for name in map(str.strip, preset.split(","))}
    jobs = [_job(choice, settings, out, len(chosen) == 1) for choice in chosen.values()]
    paths = find_logs(logs)
    parts = resolve_evaluators(evaluators)
    results: dict[str, ScoreResult] = {}
    oddities: dict[str, None] = {}  # what is odd about logs, each line once
    with Progress(as_json) as progress:

        def done(manifest: Manifest) -> None:
            progress.rollout_done(manifest, reused=False)
            oddities.update(dict.fromkeys(manifest.warnings or ()))

        for name, job in zip(chosen, jobs, strict=True):
            progress.add_task(name, total=len(paths))
            results[name] = execute_score(
                paths,
                KnownScenes(scene),
                job.preset,
                job.settings,
                parts,
                job.out,
                ["simrun", *sys.argv[1:]],
                done,
                progress.noticed,
            )
    code = worst_code([result.exit_code for result in results.values()])
    if not as_json:
        _warn_of_odd_logs(tuple(oddities))
        for result in results.values():
            _warn_of_failures(result.summary)
    has_protocol = any(choice.protocol for choice in chosen.values())
    show(as_json, _json_of(results, code), *_result_lines(results, has_protocol))
    raise typer.Exit(code)


@dataclass(frozen=True)
class _Job:
    """What one of the named presets scores with, and into which run folder."""

    preset: presets.Preset
    settings: EvalSettings | None
    out: Path | None


def _job(
    choice: presets.Preset, settings_file: Path | None, out: Path | None, is_alone: bool
) -> _Job:
    """Return the job of a preset. Beside others it has a folder of its own in ``out``, and the
    settings are only for a preset that has AlpaSim's names of metrics.
    """
    settings = _settings(choice, settings_file if is_alone or choice.aliases else None)
    return _Job(
        preset=choice if settings is None else settings.preset(choice),
        settings=settings,
        out=out if out is None or is_alone else out / choice.name,
    )


def _json_of(results: Mapping[str, ScoreResult], code: int) -> JsonObject:
    """Return the results for JSON: of a single preset its own, of several each by name."""
    documents = {name: result.as_dict() for name, result in results.items()}
    if len(documents) == 1:
        (document,) = documents.values()
        return document
    return {"exit_code": code, "presets": documents}


def _result_lines(results: Mapping[str, ScoreResult], has_protocol: bool) -> list[Any]:
    """Return where the reports are, of a single preset below the first screen of its run; then the
    scores of several presets, or of a protocol, side by side.
    """
    lines: list[Any] = []
    for result in results.values():
        run = read_run(result.root)
        if len(results) == 1 and any(rollout.ok for rollout in run.rollouts):
            lines += first_screen(run)
        lines += report_lines(result.root)
    if len(results) > 1 or has_protocol:
        lines.append(render_presets({name: result.summary for name, result in results.items()}))
    return lines


def _warn_of_odd_logs(lines: Sequence[str]) -> None:
    """Warn of logs that end early or have fields of a newer version."""
    for line in lines[:SHOWN_FAILURES]:
        warn(line)
    if len(lines) > SHOWN_FAILURES:
        warn(f"{len(lines) - SHOWN_FAILURES} more lines of this kind stand in manifest.json")


def _warn_of_failures(summary: Summary) -> None:
    """Warn of rollouts that could not be scored, and of AlpaSim's tables that were not written."""
    for cell in summary.failures.cells[:SHOWN_FAILURES]:
        warn(*error_lines(to_json(cell.error)))
    aggregation = summary.alpasim or {}
    if aggregation.get("skipped"):
        warn(f"AlpaSim's aggregation was not written: {aggregation['skipped']}")
    if aggregation.get("error"):
        warn(*error_lines(aggregation["error"]))


def _settings(preset: presets.Preset, path: Path | None) -> EvalSettings | None:
    """Return AlpaSim's settings where its preset is meant; its defaults where no file is given."""
    if preset.reproduces is not None:
        return EvalSettings() if path is None else load_settings(path)
    if path is not None:
        raise InputError(
            f"--settings {path}: the file is AlpaSim's, the preset is {preset.name}",
            "Add --preset alpasim.",
        )
    return None
