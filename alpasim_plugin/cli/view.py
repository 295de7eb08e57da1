"""``simrun view``: replay rollouts on an offline page, or draw a scenario. ``simrun report``: write a
run's report again from its tables.
"""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from alpasim_plugin.cli.options import (
    Json,
    Overrides,
    Run,
    refuse_existing,
    run_and_cell,
    run_or_newest,
)
from alpasim_plugin.cli.output import first_screen, show, warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import RUN_INFO, SUMMARY, slug
from alpasim_plugin.runs.logged_rollout import named_rollout
from alpasim_plugin.runs.reports import write_reports
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.pages.cells import Wanted
from evaluators.pages.page import MB, write_page
from evaluators.pages.terminal import metric_lines
from evaluators.results import to_json
from evaluators.statistics.opening import Run as OpenedRun
from evaluators.statistics.opening import read_run

PAGE = "view.html"

VIEW_EPILOG = """
Examples:

- `simrun view runs/us101`: runs/us101/view.html, an offline page with changed outcomes and events first

- `simrun view runs/smoke --scene smoke/curve --seed 0 --out curve.html`: one scene and seed, behind every renderer

- `simrun view runs/us101/rollouts/3dgs/lane-camera/smoke-curve/0`: the same by a rollout's folder

- `simrun view smoke/lead_car`: a scenario that has not been driven, as smoke-lead_car.png

Exit codes: 0 the page is written; 2 no such run, rollout or scenario; 4 the disk refuses.
"""


def view(
    selection: Wanted,
    target: Annotated[
        str | None,
        Positional(
            "A run, a rollout or a scenario.",
            metavar="RUN|ROLLOUT|SCENARIO",
        ),
    ] = None,
    overrides: Overrides = (),
    out: Annotated[
        Path | None,
        Flag("The file; default: view.html in the run folder, or SCENE.png.", also="-o"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Replay rollouts on an offline page, or draw a scenario.

    The page shows cameras side by side, a map from above, metrics over time and events. The image of
    a scenario shows its map, road users over time, and the camera along the recorded path.
    """
    refuse_existing(out, "--out")
    path = run_or_newest(None) if target is None else Path(target)
    if not any(os.path.exists(folder / RUN_INFO) for folder in (path, *path.parents)):
        _view_scenario(str(target), selection, overrides, out, as_json)
        return
    root, cell = run_and_cell(path)
    if os.path.exists(root / SUMMARY):
        ensure_tables(root, warn)
    opened = OpenedRun.read_so_far(root)
    for line in opened.damage:
        warn(f"warning: damaged: {line}")
    if not opened.is_finished:
        done = len(opened.rollouts)
        warn(f"note: the run is not finished: {done} of {opened.planned} rollouts")
    if not opened.rollouts:
        raise InputError(f"{root}: no rollout has finished", "Wait for the first.")
    wanted = cells_wanted(opened.rollouts, cell, selection)
    page = out or root / PAGE
    made = write_page(opened, page, wanted)
    facts = {
        "page": str(page),
        "bytes": made.size,
        "cells": [
            {"scene": cell.scene, "policy": cell.policy, "seed": cell.seed} for cell in made.cells
        ],
        "of": len(made.all_cells),
        "notes": list(made.notes),
    }
    n_shown, n_all = (
        sum(len(cell.rollouts) for cell in cells) for cells in (made.cells, made.all_cells)
    )
    size = f"{made.size / MB:.1f} MB, {n_shown} of {n_all} rollouts"
    lines = [
        *(f"note     {note}" for note in made.notes),
        f"page     {shlex.quote(str(page))}, {size}",
    ]
    show(as_json, facts, *lines)


def _view_scenario(
    scenario_name: str, selection: Wanted, overrides: Sequence[str], out: Path | None, as_json: bool
) -> None:
    from alpasim_plugin.cli.preview import draw_preview  # loads matplotlib and a renderer
    from scenarios.load import load_scenario

    if (
        selection.scenes
        or selection.policies
        or len(selection.seeds) > 1
        or len(selection.renderers) > 1
    ):
        raise InputError(
            f"{scenario_name}: neither a run nor a rollout",
            "Name a run folder, or for a scenario at most one --seed and one --renderer.",
        )
    scene = load_scenario(scenario_name, next(iter(selection.seeds), None), overrides)
    path = out or Path(f"{slug(scene.scene_id)}.png")
    made = draw_preview(scene, path, next(iter(selection.renderers), None))
    facts = {"preview": str(path), "scene": scene.scene_id, **made}
    show(as_json, facts, *made["facts"], f"preview  {path}")


def cells_wanted(rollouts: Sequence[Rollout], cell: str, selection: Wanted) -> Wanted:
    """Return which rollouts to show: of a run what was asked for, of a rollout those of its scene,
    policy and seed behind the renderers that were.

    Raises:
        InputError: There is no such rollout, or more than renderers is asked for beside it.
    """
    if not cell:
        return selection
    if selection.scenes or selection.policies or selection.seeds:
        raise InputError(
            f"{cell}: --scene, --policy or --seed with a rollout, which has one of each",
            "Name its run folder.",
        )
    rollout = named_rollout(rollouts, cell)
    return Wanted((rollout.scene,), (rollout.policy,), (rollout.seed,), selection.renderers)


REPORT_EPILOG = """
Examples:

- `simrun report runs/us101`

- `simrun report --all`: every metric of the newest run
"""


def report(
    run: Run = None,
    all_metrics: Annotated[bool, Flag("Print every metric too.", "--all")] = False,
    as_json: Json = False,
) -> None:
    """Write the reports of a run again and print its table."""
    folder = run_or_newest(run)
    ensure_tables(folder, warn)
    page = write_reports(folder)
    opened = read_run(folder)
    facts = {"report": str(page), "summary": to_json(opened.summary)}
    lines = first_screen(opened)
    if all_metrics:
        lines += ["", *metric_lines(opened.summary, table=opened.table)]
    show(as_json, facts, *lines, f"report   {page}")
