"""``simrun import``: make a scenario of a recorded drive, or of a trained model."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from alpasim_plugin.cli.options import Json, command_of
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.drives.build import import_drive
from alpasim_plugin.drives.splat import import_splat
from alpasim_plugin.process.signals import Stopped

LINE_EVERY_S = 10.0
DRIVE_EPILOG = """
Examples:

- `simrun import drive recordings/street -o street`: then `simrun --renderer 3dgs street/scenario.yaml`

- `simrun import drive walk.mp4 -o walk --camera-height 1.4`: a video without poses (needs the extra `sfm`)
"""
SPLAT_EPILOG = (
    "Example: `simrun import splat street.ply --poses transforms.json -o street`: then `simrun --renderer 3dgs street/scenario.yaml`"
)

app = typer.Typer(no_args_is_help=True, help="Make a scenario of a recorded drive, or of a trained model.")

Out = Annotated[Path, Flag("Folder of the scenario; the same command goes on where it stopped.", also="-o")]


def drive(
    folder: Annotated[Path, Positional("Folder of photographs with poses, or a video (docs/real-drives.md).", metavar="FOLDER")],
    out: Out,
    camera_height: Annotated[
        float | None, Flag("Front camera above the ground, metres, where poses have no unit.", min=0.1, max=5.0)
    ] = None,
    road: Annotated[
        Path | None, Flag("OpenDRIVE map in the coordinates of the poses; by default the driven path is the road.", "--map")
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a scenario of a recorded drive: photographs with poses become a street in which policies drive."""
    began = time.perf_counter()
    with _progress(as_json) as tell:
        try:
            quality = import_drive(folder, out, camera_height, road, tell)
        except Stopped as stop:
            stop.kept = "the same command goes on where it stopped"
            raise
    _finish(quality, out, began, as_json)


def splat(
    file: Annotated[Path, Positional("The model: .ply, compressed .ply, .splat, .spz, .sog, or a folder of SOG.", metavar="FILE")],
    poses: Annotated[Path, Flag("How it was driven through, in its own frame: transforms.json, COLMAP model, KITTI folder.")],
    out: Out,
    as_json: Json = False,
) -> None:
    """Make a scenario of a trained model of Gaussians and the poses of a drive through it."""
    began = time.perf_counter()
    with _progress(as_json) as tell:
        quality = import_splat(file, poses, out, tell)
    _finish(quality, out, began, as_json)


app.command("drive", epilog=DRIVE_EPILOG)(command_of(drive))
app.command("splat", epilog=SPLAT_EPILOG)(command_of(splat))


def _finish(quality: Mapping[str, Any], out: Path, began: float, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"scenario": str(out / "scenario.yaml"), "seconds": round(time.perf_counter() - began, 1), **quality}))
        return
    for line in _told(quality, out):
        print(line)


def _told(quality: Mapping[str, Any], out: Path) -> Iterator[str]:
    """Yield what a user wants to know of an import."""
    for note in quality["notes"]:
        yield f"note     {note}"
    for use in ("held-out", "never-fitted"):
        if use in quality:
            yield f"quality  {use}: {quality[use]['psnr_db']:.2f} dB over {quality['photographs'][use]} photographs"
    yield f"page     {out / 'quality.md'}"
    yield f"next     simrun --renderer 3dgs {out / 'scenario.yaml'}"


@contextmanager
def _progress(silent: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar on a terminal; elsewhere a line a stage, and one every `LINE_EVERY_S`; nothing if ``silent``."""
    if silent:
        yield lambda stage, done, whole: None
        return
    if not sys.stderr.isatty():
        yield _Lines()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def show(stage: str, done: int, whole: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=whole)
            bar.update(tasks[stage], completed=done)

        yield show


class _Lines:
    """Print a line when a stage begins, and now and then while it goes on."""

    def __init__(self) -> None:
        self.stage, self.last_s = "", 0.0

    def __call__(self, stage: str, done: int, whole: int) -> None:
        now = time.monotonic()
        if stage != self.stage or now - self.last_s > LINE_EVERY_S:
            print(f"{stage} {done}/{whole}", file=sys.stderr, flush=True)
            self.stage, self.last_s = stage, now
