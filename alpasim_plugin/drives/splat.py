"""Make a scenario of a trained model of Gaussians, and of the poses of a drive through it."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, read_json_object
from alpasim_plugin.core.files.fields import Fields, met_in
from alpasim_plugin.core.files.inputs import Inputs
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.build import (
    Report,
    begin,
    enter,
    finished,
    placed_photographs,
    working_folder,
    write_folder,
    write_photographs,
)
from alpasim_plugin.drives.held_out import EVERY, EVERY_STILL
from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.placing import PlacedDrive, check_motion, place
from alpasim_plugin.drives.quality import require_covered
from alpasim_plugin.drives.source import Points, SourceDrive, checked
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import CleanReport, GaussianCloud, placed_cloud, require_rigid
from alpasim_plugin.gaussians.files import read_gaussians
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.raster.rasterize import rasterize
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky
from alpasim_plugin.gaussians.sh import C0
from alpasim_plugin.world.ground import height_at
from scenarios.map_lines import corridor

OPAQUE = 0.3  # opacity from which a Gaussian counts as surface
MAX_POINTS = 100_000  # of them, in which the ground is looked for
SPREAD = 0.5  # of a Gaussian's centre around the surface, in its own mean size
# A pose is on the road if so many points are so near to it.
NEAR_M = 2.5
MIN_POINTS = 5
MIN_ON_ROAD = 0.5  # share of the poses
ROADSIDE_M = 15.0  # from the path, where objects stand on the ground
CLEARLY_M = 0.5  # above the ground, or below it
VIEW_PX = 320  # width of the views of a model without photographs
TRAINED = "dataparser_transforms.json"  # of nerfstudio
TRAINED_FRAME = Fields(TRAINED, read={"file": "transform scale"}, harmless={}, others="refused")
SWAPPED = ((0, 1, 0, 0), (1, 0, 0, 0), (0, 0, -1, 0))  # applied before it was stated
VIEWS = 8  # that coverage is measured on
OPAQUE_PIXEL = 0.5  # opacity from which the model covers a pixel
MOST_ROLL_DEG = 20.0  # of the camera against the ground


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
    tell = report or (lambda stage, done, total: None)
    with working_folder(out) as work:
        tell("reading the model", 0, 1)
        trained, key = read_inputs(file, poses)
        cloud = trained.cloud
        has_photographs = trained.has_photographs
        if os.path.exists(out):
            return finished(out, key)
        points = _surface(cloud)
        drive = replace(
            trained.drive,
            scene_id=file.stem.split(".")[0],
            points=points,
            notes=(*trained.drive.notes, *_notes(file, trained)),
        )
        placed = place(drive, points)
        _check_frame(file, placed)
        check_motion(drive, placed)
        sky = Sky(np.zeros((HEIGHT, WIDTH, 3), dtype=np.float32))
        model = Reconstruction(placed_cloud(cloud, placed.T_world_source), {}, sky)
        begin(work, key)
        stride = EVERY if placed.strip else EVERY_STILL
        photographs = placed_photographs(drive, placed, stride) if has_photographs else []
        write_photographs(work, photographs, tell)
        views = {
            use: [
                photograph.view(through_lens=True)
                for photograph in photographs
                if photograph.use == use
            ]
            for use in ("fitted", "held-out", "never-fitted")
        }
        if not has_photographs:
            views["fitted"] = _blank_views(drive, placed)
        roads = corridor(placed.ego, placed.ground)
        return write_folder(work, drive, placed, roads, model, photographs, views, {}, tell)


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A trained model as it was read, with its drive.

    Attributes:
        drive: Poses and, where they are there, photographs.
        cloud: The model in the frame of the poses.
        kept: How many of its Gaussians were usable.
        notes: What was assumed of its frame.
        has_photographs: Whether all photographs are there.
    """

    drive: SourceDrive
    cloud: GaussianCloud
    kept: CleanReport
    notes: tuple[str, ...]
    has_photographs: bool


def _notes(file: Path, trained: TrainedModel) -> tuple[str, ...]:
    """Return what a reader must know of a model and of how well it is measured."""
    kept = trained.kept
    size = str(kept) if kept.n_kept < kept.n_input else f"{kept.n_kept} Gaussians"
    quality = "no photographs: how well the model shows them is not measured"
    if trained.has_photographs:
        quality = "what the model was trained with is not known: held-out photographs may have been among it"
    return (
        f"the model is {file.name}: {size}",
        *kept.notes,
        *trained.notes,
        quality,
        "the sky is black: a model of Gaussians has none",
    )


def read_inputs(file: Path, poses: Path) -> tuple[TrainedModel, str]:
    """Return the model that an import reads, and the key of the import: everything that was read.

    Raises:
        InputError: See `import_splat`.
    """
    with Inputs() as inputs:
        drive = read_source(poses, need_files=False)
        has_photographs = all(os.path.isfile(photograph.file) for photograph in drive.photographs)
        drive = checked(drive, poses, has_photographs)
        enter(drive, inputs)
        inputs.setting("model", file.name)
        cloud, kept = read_gaussians(file)
        if kept.n_kept == 0:
            raise InputError(f"{file}: {kept}", "Give a file with at least one drawable Gaussian.")
        cloud, notes = _in_frame(file, cloud, poses, drive)
    return TrainedModel(drive, cloud, kept, notes, has_photographs), inputs.key


def _in_frame(
    file: Path, cloud: GaussianCloud, poses: Path, drive: SourceDrive
) -> tuple[GaussianCloud, tuple[str, ...]]:
    """Return a model in the frame of the poses, with notes.

    nerfstudio trains in a frame of its own and states it in ``dataparser_transforms.json``. Models
    are exported in either frame, so the one in which the poses see the model counts.

    Raises:
        InputError: The poses see too little of the model.
    """
    folders = (file.parent, poses if os.path.isdir(poses) else poses.parent)
    stated = next(
        (folder / TRAINED for folder in folders if os.path.isfile(folder / TRAINED)), None
    )
    frames = {"as it is": np.eye(4)}
    if stated is not None:
        frames |= _T_trained_source(stated, drive)
    models = {
        name: placed_cloud(cloud, np.asarray(np.linalg.inv(T), dtype=np.float64))
        for name, T in frames.items()
    }
    shares = {name: _covered(model, drive) for name, model in models.items()}
    best = max(shares, key=lambda name: shares[name])
    covered = shares[best]
    moved = models[best]
    notes: tuple[str, ...] = ()
    if stated is not None:
        coverage = ", ".join(f"{100 * share:.0f} % {name}" for name, share in shares.items())
        notes = (f"the model is taken {best}: from the poses it covers {coverage}",)
    hint = (
        f"Give the poses in the model's own frame and unit; {TRAINED} of nerfstudio is read where it "
        "lies beside the model."
    )
    require_covered(file, covered, hint)
    return moved, notes


def _T_trained_source(path: Path, drive: SourceDrive) -> dict[str, F64]:
    """Return the transforms ``(4, 4)``, with scale, that may lead from the poses to the trainer's
    frame.

    The file maps the frame from before a ``transforms.json`` was written, whose own
    ``applied_transform`` and ``applied_scale`` lead from there to its poses. Old files do not state
    that they exchanged axes.
    """
    more = drive.photographs[0].more
    applied = {"": more.get("applied_transform", np.eye(3, 4))}
    if drive.kind == "transforms" and "applied_transform" not in more:
        applied[" with the axes of an old ns-process-data"] = SWAPPED
    with parsing(path, "copy it from the trained model again", "no transform and scale"):
        document = read_json_object(path)
        TRAINED_FRAME.check(met_in("file", document), path, "copy it from the trained model again")
        scale = float(document["scale"]) / float(more.get("applied_scale", 1.0))
        trained = np.diag([scale, scale, scale, 1.0]) @ _rigid(document["transform"])
        return {
            f"in the frame of {path.name}{name}": trained @ np.linalg.inv(_rigid(rows))
            for name, rows in applied.items()
        }


def _rigid(rows: Any) -> F64:
    T = np.vstack([np.asarray(rows, dtype=np.float64)[:3], [0.0, 0.0, 0.0, 1.0]])
    require_rigid(T)
    return T


def _covered(cloud: GaussianCloud, drive: SourceDrive) -> float:
    """Return the share of the lower half of the images that a model in the frame of the poses
    covers.
    """
    steps = np.linalg.norm(np.diff(drive.path, axis=0), axis=1)
    unit = 1 / float(np.median(steps[steps > 0]))
    scaled = placed_cloud(cloud, np.diag([unit, unit, unit, 1.0]))
    photographs = drive.of(drive.front)
    shares = []
    for i in np.unique(np.linspace(0, len(photographs) - 1, VIEWS).astype(int)):
        lens = photographs[i].lens.resized(VIEW_PX)
        pose = photographs[i].T_world_camera.copy()
        pose[:3, 3] *= unit
        camera = PinholeCamera.from_pose(lens.width, lens.height, lens.straight_K(), pose)
        alpha = rasterize(scaled, camera).alpha
        shares.append(float((alpha[camera.height // 2 :] > OPAQUE_PIXEL).mean()))
    return float(np.mean(shares))


def _surface(cloud: GaussianCloud) -> Points:
    """Return the centres of opaque Gaussians as points of surfaces, in the model's frame."""
    opaque = np.flatnonzero(cloud.opacities > OPAQUE)
    chosen = cloud.take(stream("splat", 0, "surface").permutation(opaque)[:MAX_POINTS])
    spread = SPREAD * chosen.scales.astype(np.float64).mean(axis=1)
    rgb = np.clip(0.5 + C0 * chosen.sh[:, 0].astype(np.float64), 0, 1)
    return Points(chosen.means.astype(np.float64), rgb, np.eye(3) * (spread**2 / 3)[:, None, None])


def _check_frame(file: Path, placed: PlacedDrive) -> None:
    """Refuse poses that do not run over surfaces of the model, and a model upside down."""
    xyz = placed.points.xyz
    share = 0.0
    if placed.strip is not None:
        near = scipy.spatial.KDTree(xyz).query_ball_point(
            placed.ego.xyz, NEAR_M, return_length=True
        )
        share = float(np.mean(np.asarray(near) >= MIN_POINTS))
    if share < MIN_ON_ROAD:
        raise InputError(
            f"{file}: {100 * share:.0f} % of the poses lie over Gaussians of the model",
            "Give the poses in the model's own frame and unit: those that it was trained with.",
        )
    mean = placed.poses[next(iter(placed.poses))][:, :3, :3].mean(axis=0)
    roll = float(np.degrees(np.arctan2(mean[2, 0], -mean[2, 1])))
    if abs(roll) > MOST_ROLL_DEG:
        raise InputError(
            f"{file}: the ground under the path is rolled by {abs(roll):.0f} degrees against the cameras",
            "Give the poses in the model's own frame, with cameras that stand upright.",
        )
    away_m, _ = scipy.spatial.KDTree(placed.ego.xyz[:, :2]).query(xyz[:, :2])
    height_m = (xyz[:, 2] - height_at(placed.ground, xyz))[away_m < ROADSIDE_M]
    above = int((height_m > CLEARLY_M).sum())
    below = int((height_m < -CLEARLY_M).sum())
    if below > above:
        raise InputError(
            f"{file}: upside down: beside the path {below} of its surfaces lie below the road and {above} stand on it",
            "Turn the model over, or give the poses that it was trained with.",
        )


def _blank_views(drive: SourceDrive, placed: PlacedDrive) -> list[PosedView]:
    """Return views without an image, for their cameras."""
    views = []
    for photograph, pose in zip(drive.of(drive.front), placed.poses[drive.front], strict=True):
        lens = photograph.lens.resized(VIEW_PX)
        camera = PinholeCamera.from_pose(lens.width, lens.height, lens.straight_K(), pose)
        blank = np.zeros((lens.height, lens.width, 3), dtype=np.uint8)
        views.append(PosedView(camera, blank, photograph.file.stem))
    return views
