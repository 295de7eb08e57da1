"""``simrun export``: a run, or scenarios, as folders that AlpaSim's own tools take."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.cli.progress import warn
from alpasim_plugin.errors import InputError
from alpasim_plugin.runtime.contents import CONTENTS, RUN_INFO
from alpasim_plugin.runtime.export import Export, export_run, export_scenes
from alpasim_plugin.runtime.repair import use_run

EPILOG = """
Examples:

- `simrun export runs/smoke --alpasim exported`

- `simrun export smoke/lead_car real/us101 --alpasim exported` writes their scenes only

Then, where AlpaSim is installed: `alpasim-reeval exported/3dgs/lane-camera`
"""


def export(
    items: Annotated[list[str], typer.Argument(metavar="RUN|SCENARIO...", help="One run folder, or scenarios as `simrun run` takes them.")],
    alpasim: Annotated[Path, typer.Option("--alpasim", help="Folder to write, new or empty.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No line for each rollout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Write a run as AlpaSim run folders, one for each renderer and policy, and its scenes as .usdz; or scenes alone.

    The folders hold the logs, `_complete` marks, metadata and settings, so that `alpasim-eval`, `alpasim-aggregation` and `alpasim-reeval`
    take them as they are, and `simrun score --preset alpasim` gives the same numbers.
    """
    del debug  # read from the command line by cli.main, before any option is parsed
    runs = [item for item in items if any((Path(item) / name).is_file() for name in (RUN_INFO, CONTENTS))]
    if runs and len(items) > 1:
        raise InputError("exporting to AlpaSim", " ".join(items), "a run folder among several items", "export one run at a time")
    if runs:
        use_run(Path(runs[0]), warn)
        done = export_run(Path(runs[0]), alpasim, lambda text: None if quiet or as_json else print(text, file=sys.stderr, flush=True))
    else:
        done = export_scenes(items, alpasim)
    _print(done, as_json)


def _print(done: Export, as_json: bool) -> None:
    if as_json:
        runs = [{**one.__dict__, "notes": list(one.notes)} for one in done.runs]
        print(json.dumps({"out": str(done.root), "runs": runs, "scenes": list(done.scenes)}))
        return
    for one in done.runs:
        failed = f", {one.failed} failed" if one.failed else ""
        print(f"run     {done.root / one.folder}  {one.rollouts} rollouts{failed}")
        for note in one.notes:
            print(f"  note  {note}")
    for scene in done.scenes:
        print(f"scene   {done.root / scene}")
