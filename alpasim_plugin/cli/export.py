"""``simrun export``: runs and rollouts for other people's tools: AlpaSim's evaluation, Foxglove, Rerun."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.cli.export_recording import FORMATS, Asked, Exported, export_recording
from alpasim_plugin.cli.progress import warn
from alpasim_plugin.cli.rollout_folders import is_run
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runtime.export import Export, export_run, export_scenes
from alpasim_plugin.runtime.repair import use_run
from alpasim_plugin.viewer.cells import Wanted

DOING = "exporting"

EPILOG = """
Examples:

- `simrun export runs/smoke --alpasim exported`, then, where AlpaSim is installed: `alpasim-reeval exported/3dgs/lane-camera`

- `simrun export smoke/lead_car real/us101 --alpasim exported` writes their scenes only

- `simrun export runs/smoke --scene smoke/curve --seed 0 --mcap curve.mcap`: one scene and seed behind every renderer, for Foxglove

- `simrun export runs/smoke/rollouts/3dgs/lane-camera/smoke-curve/0 --rrd curve.rrd`, then `rerun curve.rrd`

- `simrun export runs/smoke --scene smoke/curve --renderer 3dgs --mcap curve.mcap --rrd curve.rrd`

Exit codes: 0 written; 2 no such run or rollout, several cells where one was needed, or a library is not installed; 4 the disk refuses.
"""


def export(
    items: Annotated[
        list[str],
        typer.Argument(metavar="RUN|ROLLOUT|SCENARIO...", help="A run folder, the folder of a rollout, or scenarios (--alpasim)."),
    ],
    alpasim: Annotated[Path | None, typer.Option("--alpasim", metavar="DIR", help="Write AlpaSim run folders; new or empty.")] = None,
    mcap: Annotated[Path | None, typer.Option("--mcap", metavar="FILE", help="Write a recording for Foxglove; extra [mcap].")] = None,
    rrd: Annotated[Path | None, typer.Option("--rrd", metavar="FILE", help="Write a recording for Rerun; extra [rerun].")] = None,
    scene: Annotated[str | None, typer.Option("--scene", help="Scene of the recording.")] = None,
    policy: Annotated[str | None, typer.Option("--policy", help="Policy of the recording.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the recording.")] = None,
    renderer: Annotated[list[str] | None, typer.Option("--renderer", help="Renderer in the recording; all by default. Repeatable.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the files that --mcap and --rrd name.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No line for each rollout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Write a run for other tools: AlpaSim run folders and scenes, or one scene, policy and seed as a recording for Foxglove or Rerun.

    With `--alpasim`, one run folder for each renderer and policy: logs, `_complete` marks, metadata and settings, so that `alpasim-eval`,
    `alpasim-aggregation` and `alpasim-reeval` take them as they are, and `simrun score --preset alpasim` gives the same numbers.

    With `--mcap` or `--rrd`, camera frames, boxes, map, driven path, plans and metrics behind every renderer on one time line.
    """
    del debug  # read from the command line by cli.main, before any option is parsed
    files = dict(zip(FORMATS, (mcap, rrd), strict=True))
    wanted = Wanted(
        () if scene is None else (scene,), () if policy is None else (policy,), () if seed is None else (seed,), tuple(renderer or ())
    )
    if (alpasim is None) == (not any(files.values())):
        found = "nothing to write" if alpasim is None else "--alpasim beside --mcap or --rrd"
        raise InputError(DOING, " ".join(items), found, "give --alpasim DIR, or --mcap FILE and --rrd FILE")
    if alpasim is None:
        asked = Asked(items, wanted, {name: path for name, path in files.items() if path is not None}, overwrite)
        _print_recording(export_recording(asked, warn), as_json)
        return
    if not wanted.is_all:
        raise InputError(DOING, "--alpasim", "--scene, --policy, --seed or --renderer beside it", "leave them out: a run is exported whole")
    runs = [item for item in items if is_run(Path(item))]
    if runs and len(items) > 1:
        raise InputError("exporting to AlpaSim", " ".join(items), "a run folder among several items", "export one run at a time")
    if runs:
        use_run(Path(runs[0]), warn)
        done = export_run(Path(runs[0]), alpasim, lambda text: None if quiet or as_json else print(text, file=sys.stderr, flush=True))
    else:
        done = export_scenes(items, alpasim)
    _print(done, as_json)


def _print_recording(done: Exported, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"recording": done.name, "files": list(done.files), "notes": list(done.notes)}))
        return
    for note in done.notes:
        print(f"note     {note}")
    for one in done.files:
        print(f"{one['format']:<8} {one['file']}  {one['bytes'] / 1e6:.1f} MB, {one['messages']} messages: {done.name}")


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
