"""``simrun import``: make a scenario of a recorded drive, or of a trained model."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from alpasim_plugin.cli.options import Json, typer_of
from alpasim_plugin.cli.output import Progress, show
from alpasim_plugin.core.errors import Stopped
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.drives.build import Report, import_drive
from alpasim_plugin.drives.splat import import_splat

DRIVE_EPILOG = """
Examples:

- `simrun import drive recordings/street -o street`: then `simrun --renderer 3dgs street/scenario.yaml`

- `simrun import drive walk -o walk --camera-height 1.4`: poses without a unit, such as a COLMAP model
"""
SPLAT_EPILOG = "Example: `simrun import splat street.ply --poses transforms.json -o street`: then `simrun --renderer 3dgs street/scenario.yaml`"

Out = Annotated[Path, Flag("Folder of the scenario; the same command continues.", also="-o")]


def drive(
    folder: Annotated[
        Path,
        Positional("Folder of photographs with poses.", metavar="FOLDER"),
    ],
    out: Out,
    camera_height: Annotated[
        float | None,
        Flag("Of the front camera, metres, where poses have no unit.", min=0.1, max=5.0),
    ] = None,
    road: Annotated[
        Path | None,
        Flag(
            "OpenDRIVE map in the poses' coordinates; default: the driven path.",
            "--map",
        ),
    ] = None,
    device: Annotated[str, Flag("Where to fit: cpu, cuda or cuda:N.")] = "cpu",
    steps: Annotated[
        int | None,
        Flag(
            "Updates of the fit; default: 1300. Fewer are sooner there and less like the photographs.",
            min=20,
            max=100_000,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a scenario of a recorded drive: photographs with poses.

    After a quarter of the updates a scenario of the street as it is then is written to OUT.preview,
    with images, to be driven while the fit goes on.
    """
    _import(
        lambda tell: import_drive(folder, out, camera_height, road, tell, device, steps),
        out,
        as_json,
    )


def splat(
    file: Annotated[
        Path,
        Positional(
            "The model: .ply, .splat, .spz, .sog, or a folder of SOG.",
            metavar="FILE",
        ),
    ],
    poses: Annotated[
        Path,
        Flag("Its drive: transforms.json, COLMAP model, KITTI folder."),
    ],
    out: Out,
    as_json: Json = False,
) -> None:
    """Make a scenario of a Gaussian model and the poses of its drive."""
    _import(lambda tell: import_splat(file, poses, out, tell), out, as_json)


def _import(work: Callable[[Report], dict[str, Any]], out: Path, as_json: bool) -> None:
    """Import with progress, and print what a user wants to know of it."""
    began = time.perf_counter()
    try:
        with Progress(as_json) as progress:
            quality = work(partial(_tell, progress))
    except Stopped as stop:
        stop.kept = "the same command goes on where it stopped"
        raise
    scenario = str(out / "scenario.yaml")
    facts = {"scenario": scenario, "seconds": round(time.perf_counter() - began, 1), **quality}
    lines = [f"note     {note}" for note in quality["notes"]]
    for use in ("held-out", "never-fitted"):
        if use in quality:
            count = quality["photographs"][use]
            lines.append(
                f"quality  {use}: {quality[use]['psnr_db']:.2f} dB over {count} photographs"
            )
    lines += [f"page     {out / 'quality.md'}", f"next     simrun --renderer 3dgs {scenario}"]
    show(as_json, facts, *lines)


def _tell(progress: Progress, stage: str, done: int, all: int) -> None:
    """Show how much of a stage is done, or print a sentence, of which there is no more to do."""
    if all:
        progress.show(stage, done, all)
    else:
        progress.say(stage)


app = typer_of(
    {"drive": (drive, DRIVE_EPILOG), "splat": (splat, SPLAT_EPILOG)},
    "Make a scenario of a recorded drive, or of a trained model.",
)
