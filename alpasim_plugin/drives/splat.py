"""Make a scenario of a trained model of Gaussians, and of the poses of a drive through it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.drives.build import (
    Report,
    begin,
    finished,
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

OPAQUE = 0.3  # opacity from which a Gaussian counts as surface
MAX_POINTS = 100_000  # of them, in which the ground is looked for
SPREAD = 0.5  # of a Gaussian's centre around the surface, in its own mean size
NEAR_M, MIN_POINTS = 2.5, 5  # a pose is on the road if so many points are so near to it
MIN_ON_ROAD = 0.5  # share of the poses
ROADSIDE_M = 15.0  # from the path, where objects stand on the ground
CLEARLY_M = 0.5  # above the ground, or below it
VIEW_PX = 320  # width of the views of a model without photographs


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
        source = poses.parent if poses.name == "transforms.json" else poses
        drive = read_source(source, photographs=False)
        has_photographs = all(picture.file.is_file() for picture in drive.pictures)
        drive = checked(drive, poses, has_photographs)
        tell("reading the model", 0, 1)
        cloud, kept = read_gaussians(file)
        if kept.n_kept == 0:
            raise InputError(f"{file}: {kept}", "Give a file with at least one drawable Gaussian.")
        key = key_of(drive, None, file if file.is_file() else None)
        if out.exists():
            return finished(out, key)
        size = str(kept) if kept.n_kept < kept.n_input else f"{kept.n_kept} Gaussians"
        quality = "what the model was trained with is not known: held-out photographs may have been among it"
        if not has_photographs:
            quality = "no photographs: how well the model shows them is not measured"
        notes = (
            f"the model is {file.name}: {size}",
            quality,
            "the sky is black: a model of Gaussians has none",
        )
        points = _surface(cloud)
        drive = replace(
            drive,
            scene_id=file.stem.split(".")[0],
            points=points,
            notes=(*drive.notes, *notes),
        )
        placed = place(drive, points)
        _check_frame(file, placed)
        sky = Sky(np.zeros((HEIGHT, WIDTH, 3), np.float32))
        model = Reconstruction(placed_cloud(cloud, placed.T_world_source), {}, sky)
        begin(work, key)
        shown = shown_photographs(drive, placed) if has_photographs else []
        write_photographs(work, shown, tell)
        views = {
            use: [photograph.view() for photograph in shown if photograph.use == use]
            for use in ("fitted", "held-out", "never-fitted")
        }
        if not has_photographs:
            views["fitted"] = _blank_views(drive, placed)
        roads = corridor(placed.ego, placed.ground)
        return write_folder(work, drive, placed, roads, model, shown, views, {}, tell)


def _surface(cloud: GaussianCloud) -> Points:
    """Return the centres of opaque Gaussians as points of surfaces, in the model's frame."""
    opaque = np.flatnonzero(np.asarray(cloud.opacities) > OPAQUE)
    chosen = stream("splat", 0, "surface").permutation(opaque)[:MAX_POINTS]
    spread = SPREAD * np.asarray(cloud.scales, dtype=np.float64)[chosen].mean(axis=1)
    rgb = np.clip(0.5 + C0 * np.asarray(cloud.sh, dtype=np.float64)[chosen, 0], 0, 1)
    means = np.asarray(cloud.means, dtype=np.float64)[chosen]
    return Points(means, rgb, np.eye(3) * (spread**2 / 3)[:, None, None])


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
    away_m, _ = scipy.spatial.KDTree(placed.ego.xyz[:, :2]).query(xyz[:, :2])
    height_m = (xyz[:, 2] - height_at(placed.ground, xyz))[away_m < ROADSIDE_M]
    above, below = int((height_m > CLEARLY_M).sum()), int((height_m < -CLEARLY_M).sum())
    if below > above:
        raise InputError(
            f"{file}: upside down: beside the path {below} of its surfaces lie below the road and {above} stand on it",
            "Turn the model over, or give the poses that it was trained with.",
        )


def _blank_views(drive: SourceDrive, placed: PlacedDrive) -> list[PosedView]:
    """Return views without an image, for their cameras."""
    views = []
    for picture, pose in zip(drive.of(drive.front), placed.poses[drive.front], strict=True):
        lens = picture.lens.resized(VIEW_PX)
        camera = PinholeCamera.from_pose(lens.width, lens.height, lens.straight_K(), pose)
        blank = np.zeros((lens.height, lens.width, 3), np.uint8)
        views.append(PosedView(camera, blank, picture.file.stem))
    return views
