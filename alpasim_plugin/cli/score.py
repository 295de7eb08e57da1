"""``simrun score``: score rollout logs again without rendering."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from alpasim_plugin.cli.options import Evaluators, Json, Preset, Quiet, Report, Wait
from alpasim_plugin.cli.progress import describe, report_line
from alpasim_plugin.core.errors import InputError, four_parts
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.run_folder.manifests import read_run_json
from alpasim_plugin.runtime.score_logs import KnownScenes, find_logs
from alpasim_plugin.runtime.score_run import ScoreResult, execute_score
from evaluators import preset as find_preset
from evaluators import resolve_evaluators
from evaluators.alpasim import EvalSettings, load_settings
from evaluators.metrics import MetricTable, presets
from evaluators.report import render_table

EPILOG = """
Examples:

- `simrun score rollouts/SCENE/ROLLOUT/rollout.asl --scene scenes/SCENE.usdz --preset alpasim`

- `simrun score 'rollouts/*/*/rollout.asl' --scene scenes --preset alpasim --settings eval-config.yaml --out scored`

- `simrun score runs/smoke/rollouts/3dgs --scene suites/smoke --preset strict`
"""


def score(
    logs: Annotated[tuple[str, ...], Positional("Logs (.asl, AlpaSim's or ours), folders of them, or patterns in quotes.")],
    scene: Annotated[tuple[str, ...], Flag("The logs' scene: .usdz, scenario YAML, recorded log, or a folder of them. Repeatable.")],
    preset: Preset = "paper",
    settings: Annotated[Path | None, Flag("AlpaSim's eval-config.yaml, with --preset alpasim.")] = None,
    rails: Annotated[bool, Flag("Lanes by their rails, or their centres widened by 1.85 m.", "--rails/--no-rails")] = True,
    evaluators: Evaluators = (),
    out: Annotated[Path | None, Flag("Run folder; by default one below runs/ named by logs and preset.")] = None,
    report: Report = True,
    wait: Wait = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Score rollout logs, AlpaSim's or ours, without rendering; the files are those of a run.

    Rows name the log by its folder in the column `rollout`. With `--preset alpasim` AlpaSim's own aggregation and scene score are written
    to `aggregate/` as well. Nothing in a log is ever unpickled.
    """
    chosen = find_preset(preset)
    own = _settings(chosen, settings)
    if own is not None:
        chosen = own.preset(chosen)
    found = find_logs(logs)
    done = 0

    def on_done(manifest: dict[str, Any]) -> None:
        nonlocal done
        done += 1
        if not (quiet or as_json):
            print(f"[{done}/{len(found)}] {manifest['rollout']}: {describe(manifest, reused=False)}", file=sys.stderr, flush=True)

    result = execute_score(
        found,
        KnownScenes(scene, rails),
        chosen,
        own,
        resolve_evaluators(evaluators),
        out,
        ["simrun", *sys.argv[1:]],
        on_done,
        report,
        wait,
    )
    _print(result, as_json)
    raise typer.Exit(result.exit_code)


def _settings(preset: presets.Preset, path: Path | None) -> EvalSettings | None:
    """Return AlpaSim's settings where its preset is meant; its defaults where no file is given."""
    if preset.reproduces is not None:
        return EvalSettings() if path is None else load_settings(path)
    if path is not None:
        raise InputError(
            "reading evaluation settings", f"--settings {path}", f"--preset {preset.name}", "add --preset alpasim: the file is AlpaSim's"
        )
    return None


def _print(result: ScoreResult, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"out": str(result.root), "exit_code": result.exit_code, "summary": result.summary}))
        return
    Console().print(render_table(result.summary, headline_only=True, known=MetricTable.of_run(read_run_json(result.root))))
    for cell in result.summary["failures"]["cells"][:5]:
        print(four_parts(cell["error"]), file=sys.stderr)
    aggregation = result.summary.get("alpasim") or {}
    if aggregation.get("skipped"):
        print(f"AlpaSim's aggregation was not written: {aggregation['skipped']}", file=sys.stderr)
    if aggregation.get("error"):
        print(four_parts(aggregation["error"]), file=sys.stderr)
    print(report_line(result.root))
