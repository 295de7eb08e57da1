"""``simrun score``: score rollout logs again without rendering."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from alpasim_plugin.cli.options import Evaluators, Json, Presets, Quiet, Report, Wait
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
from evaluators.report import render_presets, render_table

EPILOG = """
Examples:

- `simrun score rollouts/SCENE/ROLLOUT/rollout.asl --scene scenes/SCENE.usdz --preset alpasim`

- `simrun score 'rollouts/*/*/rollout.asl' --scene scenes --preset alpasim --settings eval-config.yaml --out scored`

- `simrun score runs/smoke/rollouts/3dgs --scene suites/smoke --preset strict`

- `simrun score runs/smoke --scene suites/smoke --preset strict,nuplan,navsim,hugsim,ncap` prints the scores side by side
"""


def score(
    logs: Annotated[tuple[str, ...], Positional("Logs (.asl, AlpaSim's or ours), folders of them, or patterns in quotes.")],
    scene: Annotated[tuple[str, ...], Flag("The logs' scene: .usdz, scenario YAML, recorded log, or a folder of them. Repeatable.")],
    preset: Presets = presets.DEFAULT,
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
    names = list(dict.fromkeys(part.strip() for part in preset.split(",")))
    chosen = {name: find_preset(name) for name in names}
    own = {name: _settings(one, settings if len(names) == 1 or one.aliases else None) for name, one in chosen.items()}
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
            _teller(len(found), quiet or as_json),
            report,
            wait,
        )
    code = max(one.exit_code for one in results.values())
    said = {name: {"out": str(one.root), "exit_code": one.exit_code, "summary": one.summary} for name, one in results.items()}
    if as_json:
        print(json.dumps(said[names[0]] if len(names) == 1 else {"exit_code": code, "presets": said}))
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
            print(f"[{done}/{count}] {manifest['rollout']}: {describe(manifest, reused=False)}", file=sys.stderr, flush=True)

    return on_done


def _settings(preset: presets.Preset, path: Path | None) -> EvalSettings | None:
    """Return AlpaSim's settings where its preset is meant; its defaults where no file is given."""
    if preset.reproduces is not None:
        return EvalSettings() if path is None else load_settings(path)
    if path is not None:
        raise InputError(
            "reading evaluation settings", f"--settings {path}", f"--preset {preset.name}", "add --preset alpasim: the file is AlpaSim's"
        )
    return None


def _print(result: ScoreResult, with_table: bool) -> None:
    if with_table:
        Console().print(render_table(result.summary, headline_only=True, known=MetricTable.of_run(read_run_json(result.root))))
    for cell in result.summary["failures"]["cells"][:5]:
        print(four_parts(cell["error"]), file=sys.stderr)
    aggregation = result.summary.get("alpasim") or {}
    if aggregation.get("skipped"):
        print(f"AlpaSim's aggregation was not written: {aggregation['skipped']}", file=sys.stderr)
    if aggregation.get("error"):
        print(four_parts(aggregation["error"]), file=sys.stderr)
    print(report_line(result.root))
