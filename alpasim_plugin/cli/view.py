"""``simrun view``: replay rollouts in a browser."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.cli.progress import warn
from alpasim_plugin.cli.rollout_folders import find_cell, narrowed
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.process.signals import Stopped
from alpasim_plugin.run_folder.schema import CONTENTS
from alpasim_plugin.runtime.repair import use_run
from alpasim_plugin.viewer.cells import Wanted
from alpasim_plugin.viewer.page import DEFAULT_MB, MB, Options
from alpasim_plugin.viewer.pictures import Fineness
from alpasim_plugin.viewer.serve import RunServer, loopback
from alpasim_plugin.viewer.write import write_page
from evaluators.opening import read_so_far

DOING = "watching rollouts"
PAGE = "view.html"

EPILOG = """
Examples:

- `simrun view runs/us101`: runs/us101/view.html, an offline page with changed outcomes and events first

- `simrun view runs/smoke --scene smoke/curve --seed 0 --out curve.html`: one scene and seed, behind every renderer

- `simrun view runs/us101/rollouts/3dgs/lane-camera/smoke-curve/0`: the same by a rollout's folder

- `simrun view runs/us101 --serve 8000`: at http://127.0.0.1:8000/ while the run goes on; Ctrl-C ends it

Exit codes: 0 the page is written, or the server was stopped by a signal; 2 no such run or rollout; 4 the disk or the port refuses.
"""


def view(
    what: Annotated[Path, typer.Argument(metavar="RUN|ROLLOUT", help="A run folder, or the folder of one of its rollouts.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The page; by default view.html in the run folder.")] = None,
    serve: Annotated[str | None, typer.Option("--serve", metavar="HOST:PORT", help="Serve a running run on this machine instead.")] = None,
    scene: Annotated[list[str] | None, typer.Option("--scene", help="Scene; repeatable.")] = None,
    policy: Annotated[list[str] | None, typer.Option("--policy", help="Policy; repeatable.")] = None,
    seed: Annotated[list[int] | None, typer.Option("--seed", help="Seed; repeatable.")] = None,
    renderer: Annotated[list[str] | None, typer.Option("--renderer", help="Renderer; repeatable.")] = None,
    camera: Annotated[str | None, typer.Option("--camera", help="Keep this camera alone.")] = None,
    cells: Annotated[int | None, typer.Option("--cells", min=1, help="Most scene-policy-seed cells in the page.")] = None,
    max_mb: Annotated[float, typer.Option("--max-mb", min=1.0, help="Size of the page, megabytes.")] = DEFAULT_MB,
    width: Annotated[int, typer.Option("--width", min=64, max=4096, help="Frames wider than this are made smaller, pixels.")] = 512,
    every: Annotated[int, typer.Option("--every", min=1, help="Keep every n-th camera frame.")] = 1,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that --out names.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Replay rollouts in a browser: cameras side by side, a map from above, metrics over time, events; offline, or of a running run."""
    del debug
    root, of_rollout = find_cell(what, DOING)
    asked = Wanted(tuple(scene or ()), tuple(policy or ()), tuple(seed or ()), tuple(renderer or ()))
    wanted = narrowed(what, of_rollout, asked, DOING)
    options = Options(int(max_mb * MB), Fineness(every, width), camera)
    if serve is not None:
        if out is not None:
            raise InputError(DOING, "--serve and --out", "both", "give one of them")
        _serve(root, serve, wanted, options, as_json)
        return
    if (root / CONTENTS).exists():
        use_run(root, warn)
    so_far = read_so_far(root)
    for line in so_far.damage:
        warn(f"warning: damaged: {line}")
    if not so_far.finished:
        warn(f"note: the run is not finished: {len(so_far.run.rollouts)} of {so_far.planned} rollouts")
    if not so_far.run.rollouts:
        raise InputError(DOING, str(root), "no rollout has finished", "wait for the first, or watch with --serve 8000")
    path = out or root / PAGE
    if out is not None and out.exists() and not overwrite:
        raise InputError(DOING, str(out), "it exists already", "name another --out, or pass --overwrite")
    made = write_page(so_far.run, path, wanted, options, cells)
    if as_json:
        shown = [{"scene": cell.scene, "policy": cell.policy, "seed": cell.seed} for cell in made.shown]
        print(json.dumps({"page": str(path), "bytes": made.size, "cells": shown, "of": len(made.known), "notes": list(made.notes)}))
        return
    for note in made.notes:
        print(f"note     {note}")
    print(f"page     {shlex.quote(str(path))}, {made.size / MB:.1f} MB, {len(made.shown)} of {len(made.known)} cells")


def _serve(root: Path, address: str, wanted: Wanted, options: Options, as_json: bool) -> None:
    with RunServer(loopback(address), lambda: read_so_far(root), wanted, options) as server:
        print(json.dumps({"serving": str(root), "at": server.url}) if as_json else f"watch    {server.url}   # Ctrl-C ends it", flush=True)
        try:
            server.serve_forever()
        except Stopped:  # how a server ends
            return
