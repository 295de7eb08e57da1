"""``simrun import``: make a scenario of a recorded drive, or of a trained model."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from alpasim_plugin.cli.options import HELP_NAMES, Json, command_of
from alpasim_plugin.cli.signals import Stopped
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8
from alpasim_plugin.drives.build import (
    Report,
    begin,
    finished,
    import_drive,
    key_of,
    shown_photographs,
    working_folder,
    write_folder,
    write_photographs,
)
from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.placing import PlacedDrive, corridor, place
from alpasim_plugin.drives.source import Points, SourceDrive, checked
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud, placed_cloud
from alpasim_plugin.gaussians.files import read_gaussians
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky
from alpasim_plugin.gaussians.sh import C0
from alpasim_plugin.world.ground import height_at

DOING = "importing a trained model"
OPAQUE, MOST_POINTS = (
    0.3,
    100_000,
)  # Gaussians that count as surface; how many of them the ground is looked for in
SPREAD = 0.5  # of a Gaussian's middle around the surface, in its own mean size
LEAST_CARRIED, NEAR_M, FEWEST = (
    0.5,
    2.5,
    5,
)  # share of the way that must have so many points so near below it

BESIDE_M, CLEARLY_M = 15.0, 0.5  # of the way, where things stand on the ground; above it


def import_splat(
    file: Path, poses: Path, out: Path, report: Report | None = None
) -> dict[str, Any]:
    """Make a scenario of a trained model.

    Args:
        file: PLY, compressed PLY, ``.splat``, ``.spz`` or SOG.
        poses: ``transforms.json`` with its folder, a COLMAP model or another drive, in the model's
            frame; photographs need not be there.
        out: Becomes the scenario's folder.
        report: Called as the work goes on.

    Returns:
        What ``quality.json`` holds.

    Raises:
        InputError: The model or the poses cannot be used, or do not lie in one frame; nothing is
            left behind then.
    """
    tell = report or (lambda stage, done, all: None)
    with working_folder(out) as work:
        drive = read_source(
            poses.parent if poses.name == "transforms.json" else poses, photographs=False
        )
        has_photographs = all(one.file.is_file() for one in drive.pictures)
        drive = checked(drive, poses, has_photographs)
        tell("reading the model", 0, 1)
        cloud, kept = read_gaussians(file)
        if kept.n_kept == 0:
            raise InputError(f"{file}: {kept}", "give a file with at least one drawable Gaussian")
        key = key_of(drive, None, file if file.is_file() else None)
        if out.exists():
            return finished(out, key)
        note = (
            f"the model is {file.name}: {kept}"
            if kept.n_kept < kept.n_input
            else f"the model is {file.name}: {kept.n_kept} Gaussians"
        )
        drive = replace(
            drive,
            scene_id=file.stem.split(".")[0],
            points=_surface(cloud),
            notes=(*drive.notes, note),
        )
        return _built(drive, cloud, file, work, key, has_photographs, tell)


def _surface(cloud: GaussianCloud) -> Points:
    """Return the middles of opaque Gaussians as points of surfaces, in the model's frame."""
    chosen = np.flatnonzero(np.asarray(cloud.opacities) > OPAQUE)
    chosen = stream("splat", 0, "surface").permutation(chosen)[:MOST_POINTS]
    spread = SPREAD * np.asarray(cloud.scales, dtype=np.float64)[chosen].mean(axis=1)
    rgb = np.clip(0.5 + C0 * np.asarray(cloud.sh, dtype=np.float64)[chosen, 0], 0, 1)
    return Points(
        np.asarray(cloud.means, dtype=np.float64)[chosen],
        rgb,
        np.eye(3) * (spread**2 / 3)[:, None, None],
    )


def _built(
    drive: SourceDrive,
    cloud: GaussianCloud,
    file: Path,
    work: Path,
    key: str,
    has_photographs: bool,
    tell: Report,
) -> dict[str, Any]:
    assert drive.points is not None
    placed = place(drive, drive.points)
    background = placed_cloud(cloud, placed.T_world_source)
    share = 0.0 if placed.strip is None else _carried(placed)
    if share < LEAST_CARRIED:
        raise InputError(
            f"{file}: {100 * share:.0f} % of the way of the poses runs over Gaussians of the model",
            "give the poses in the model's own frame and unit: those that it was trained with",
        )
    above, below = _stands(placed)
    if below > above:
        raise InputError(
            f"{file}: upside down: beside the way {below} of its surfaces lie below the road and {above} stand on it",
            "turn the model over, or give the poses that it was trained with",
        )
    model = Reconstruction(background, {}, Sky(np.zeros((HEIGHT, WIDTH, 3), np.float32)))
    begin(work, key)
    shown = shown_photographs(drive, placed) if has_photographs else []
    write_photographs(work, shown, tell)
    views = {
        use: [one.view() for one in shown if one.use == use]
        for use in ("fitted", "held-out", "never-fitted")
    }
    if not has_photographs:
        views["fitted"] = _blank(drive, placed)
    drive = replace(
        drive,
        notes=(
            *drive.notes,
            _said(has_photographs),
            "the sky is black: a model of Gaussians has none",
        ),
    )
    return write_folder(
        work, drive, placed, corridor(placed.ego, placed.ground), model, shown, views, {}, tell
    )


def _carried(placed: PlacedDrive) -> float:
    """Return the share of the way that has surface below it."""
    tree = scipy.spatial.KDTree(placed.points.xyz)
    near = tree.query_ball_point(placed.ego.xyz, NEAR_M, return_length=True)
    return float(np.mean(np.asarray(near) >= FEWEST))


def _stands(placed: PlacedDrive) -> tuple[int, int]:
    """Return how many points near the way lie clearly above the ground, and below it."""
    xyz = placed.points.xyz
    away, _ = scipy.spatial.KDTree(placed.ego.xyz[:, :2]).query(xyz[:, :2])
    height = (xyz[:, 2] - height_at(placed.ground, xyz))[away < BESIDE_M]
    return int((height > CLEARLY_M).sum()), int((height < -CLEARLY_M).sum())


def _said(has_photographs: bool) -> str:
    if has_photographs:
        return "what the model was trained with is not known: held-out photographs may have been among it"
    return "no photographs: how well the model shows them is not measured"


def _blank(drive: SourceDrive, placed: PlacedDrive) -> list[PosedView]:
    """Return views without a picture, for their cameras."""
    out = []
    for picture, pose in zip(drive.of(drive.front), placed.poses[drive.front], strict=True):
        lens = picture.lens.resized(320)
        blank: U8 = np.zeros((lens.height, lens.width, 3), np.uint8)
        out.append(
            PosedView(
                PinholeCamera.from_pose(lens.width, lens.height, lens.straight_K(), pose),
                blank,
                picture.file.stem,
            )
        )
    return out


LINE_EVERY_S = 10.0
DRIVE_EPILOG = """
Examples:

- `simrun import drive recordings/street -o street`: then `simrun --renderer 3dgs street/scenario.yaml`

- `simrun import drive walk -o walk --camera-height 1.4`: poses without a unit, such as a COLMAP model
"""
SPLAT_EPILOG = "Example: `simrun import splat street.ply --poses transforms.json -o street`: then `simrun --renderer 3dgs street/scenario.yaml`"

app = typer.Typer(
    help="Make a scenario of a recorded drive, or of a trained model.",
    context_settings=HELP_NAMES,
)

Out = Annotated[
    Path, Flag("Folder of the scenario; the same command goes on where it stopped.", also="-o")
]


def drive(
    folder: Annotated[
        Path,
        Positional("Folder of photographs with poses (docs/real-drives.md).", metavar="FOLDER"),
    ],
    out: Out,
    camera_height: Annotated[
        float | None,
        Flag("Front camera above the ground, metres, where poses have no unit.", min=0.1, max=5.0),
    ] = None,
    road: Annotated[
        Path | None,
        Flag(
            "OpenDRIVE map in the coordinates of the poses; by default the driven path is the road.",
            "--map",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a scenario of a recorded drive: photographs with poses become a street in which policies
    drive.
    """
    began = time.perf_counter()
    with _progress(as_json) as tell:
        try:
            quality = import_drive(folder, out, camera_height, road, tell)
        except Stopped as stop:
            stop.kept = "the same command goes on where it stopped"
            raise
    _finish(quality, out, began, as_json)


def splat(
    file: Annotated[
        Path,
        Positional(
            "The model: .ply, compressed .ply, .splat, .spz, .sog, or a folder of SOG.",
            metavar="FILE",
        ),
    ],
    poses: Annotated[
        Path,
        Flag(
            "How it was driven through, in its own frame: transforms.json, COLMAP model, KITTI folder."
        ),
    ],
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
        print(
            json.dumps(
                {
                    "scenario": str(out / "scenario.yaml"),
                    "seconds": round(time.perf_counter() - began, 1),
                    **quality,
                }
            )
        )
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
    """Show a bar on a terminal; elsewhere a line a stage, and one every `LINE_EVERY_S`; nothing if
    ``silent``.
    """
    if silent:
        yield lambda stage, done, whole: None
        return
    if not sys.stderr.isatty():
        yield _Lines()
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
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
