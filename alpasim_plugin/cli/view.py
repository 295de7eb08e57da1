"""``simrun view``: replay rollouts in a browser. ``simrun report``: write a run's report again from
its tables.
"""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated

from rich.console import Console

from alpasim_plugin.cli.options import Json, Overwrite, Run, refuse_existing
from alpasim_plugin.cli.progress import warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.log.run_folder.manifests import read_manifest, read_run_json
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.schema import MANIFEST, RUN_INFO, SUMMARY
from alpasim_plugin.runs.reports import write_reports
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.metrics import MetricTable
from evaluators.opening import read_so_far
from evaluators.report import render_table
from evaluators.viewer.cells import Wanted
from evaluators.viewer.page import DEFAULT_MB, MB, Options, write_page

DOING = "watching rollouts"
PAGE = "view.html"

VIEW_EPILOG = """
Examples:

- `simrun view runs/us101`: runs/us101/view.html, an offline page with changed outcomes and events first

- `simrun view runs/smoke --scene smoke/curve --seed 0 --out curve.html`: one scene and seed, behind every renderer

- `simrun view runs/us101/rollouts/3dgs/lane-camera/smoke-curve/0`: the same by a rollout's folder

Exit codes: 0 the page is written; 2 no such run or rollout; 4 the disk refuses.
"""


def view(
    what: Annotated[
        Path,
        Positional("A run folder, or the folder of one of its rollouts.", metavar="RUN|ROLLOUT"),
    ],
    asked: Wanted,
    out: Annotated[
        Path | None, Flag("The page; by default view.html in the run folder.", also="-o")
    ] = None,
    camera: Annotated[str | None, Flag("Keep this camera alone.")] = None,
    cells: Annotated[int | None, Flag("Most scene-policy-seed cells in the page.", min=1)] = None,
    max_mb: Annotated[float, Flag("Size of the page, megabytes.", min=1.0)] = DEFAULT_MB,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Replay rollouts in a browser: cameras side by side, a map from above, metrics over time,
    events.
    """
    root, of_rollout = find_cell(what)
    wanted = narrowed(what, of_rollout, asked)
    options = Options(int(max_mb * MB), camera=camera)
    if (root / SUMMARY).exists():
        ensure_tables(root, warn)
    so_far = read_so_far(root)
    for line in so_far.damage:
        warn(f"warning: damaged: {line}")
    if not so_far.finished:
        warn(
            f"note: the run is not finished: {len(so_far.run.rollouts)} of {so_far.planned} rollouts"
        )
    if not so_far.run.rollouts:
        raise InputError(
            f"{root}: no rollout has finished",
            "wait for the first",
        )
    path = out or root / PAGE
    refuse_existing(out, overwrite, "--out")
    made = write_page(so_far.run, path, wanted, options, cells)
    if as_json:
        shown = [
            {"scene": cell.scene, "policy": cell.policy, "seed": cell.seed} for cell in made.shown
        ]
        print(
            json.dumps(
                {
                    "page": str(path),
                    "bytes": made.size,
                    "cells": shown,
                    "of": len(made.known),
                    "notes": list(made.notes),
                }
            )
        )
        return
    for note in made.notes:
        print(f"note     {note}")
    print(
        f"page     {shlex.quote(str(path))}, {made.size / MB:.1f} MB, {len(made.shown)} of {len(made.known)} cells"
    )


def is_run(what: Path) -> bool:
    """Tell whether a folder is a run folder."""
    return (what / RUN_INFO).exists()


def find_cell(what: Path) -> tuple[Path, Wanted | None]:
    """Return the run folder of a run or a rollout, and which rollouts to show if a rollout was
    named.

    Raises:
        InputError: Neither.
    """
    if is_run(what):
        return what, None
    if (what / MANIFEST).exists():
        manifest, _ = read_manifest(what)
        root = next(
            (folder for folder in what.resolve().parents if (folder / RUN_INFO).exists()), None
        )
        if root is not None:
            return root, Wanted(
                (str(manifest["scene"]),), (str(manifest["policy"]),), (int(manifest["seed"]),)
            )
    found = "no run.json and no manifest.json" if what.exists() else "no such folder"
    raise InputError(
        f"{what}: {found}",
        "give a folder that simrun run wrote, or RUN/rollouts/RENDERER/POLICY/SCENE/SEED",
    )


def narrowed(what: Path, rollout: Wanted | None, asked: Wanted) -> Wanted:
    """Return which rollouts to show: all that was asked for of a run, of a rollout's cell the
    renderers that were.

    Raises:
        InputError: More than renderers is asked for beside a rollout.
    """
    if rollout is None:
        return asked
    if asked.scenes or asked.policies or asked.seeds:
        raise InputError(
            f"{what}: --scene, --policy or --seed beside a rollout, which has one of each",
            "name its run folder",
        )
    return Wanted(rollout.scenes, rollout.policies, rollout.seeds, asked.renderers)


REPORT_EPILOG = "Example: `simrun report runs/us101`"


def report(
    run: Run,
    as_json: Json = False,
) -> None:
    """Write report.html, summary.md and junit.xml of a run again and print its table."""
    ensure_tables(run, warn)
    summary = read_json(run / SUMMARY)
    page = write_reports(run, flips=read_run_json(run).get("kind") != "score")
    if as_json:
        print(json.dumps({"report": str(page), "summary": summary}))
    else:
        Console().print(render_table(summary, known=MetricTable.of_run(read_run_json(run))))
        print(f"report   {page}")
