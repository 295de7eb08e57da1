"""Import a trained model of the user's own: its Gaussians, and poses in its frame that say how it was driven through."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8
from alpasim_plugin.drives.build import (
    Report,
    begin,
    finished,
    key_of,
    shown_photographs,
    working_folders,
    write_folder,
    write_photographs,
)
from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.placing import PlacedDrive, corridor, place
from alpasim_plugin.drives.source import Points, SourceDrive, checked
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files import read_gaussians
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene.builder import placed_cloud
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky
from alpasim_plugin.gaussians.sh import C0
from alpasim_plugin.world.ground import height_at

DOING = "importing a trained model"
OPAQUE, MOST_POINTS = 0.3, 100_000  # Gaussians that count as surface; how many of them the ground is looked for in
SPREAD = 0.5  # of a Gaussian's middle around the surface, in its own mean size
LEAST_CARRIED, NEAR_M, FEWEST = 0.5, 2.5, 5  # share of the way that must have so many points so near below it

BESIDE_M, CLEARLY_M = 15.0, 0.5  # of the way, where things stand on the ground; above it


def import_splat(file: Path, poses: Path, out: Path, report: Report | None = None) -> dict[str, Any]:
    """Make a scenario of a trained model.

    Args:
        file: PLY, compressed PLY, ``.splat``, ``.spz`` or SOG.
        poses: ``transforms.json`` with its folder, a COLMAP model or another drive, in the model's frame; photographs need not be there.
        out: Becomes the scenario's folder.
        report: Called as the work goes on.

    Returns:
        What ``quality.json`` holds.

    Raises:
        InputError: The model or the poses cannot be used, or do not lie in one frame; nothing is left behind then.
    """
    tell = report or (lambda stage, done, all: None)
    with working_folders(out) as (found, work):
        drive = read_source(poses.parent if poses.name == "transforms.json" else poses, found, tell, photographs=False)
        has_photographs = all(one.file.is_file() for one in drive.pictures)
        drive = checked(drive, poses, has_photographs)
        tell("reading the model", 0, 1)
        cloud, kept = read_gaussians(file)
        if kept.n_kept == 0:
            raise InputError(DOING, str(file), str(kept), "give a file with at least one drawable Gaussian")
        key = key_of(drive, None, file if file.is_file() else None)
        if out.exists():
            return finished(out, key)
        note = f"the model is {file.name}: {kept}" if kept.n_kept < kept.n_input else f"the model is {file.name}: {kept.n_kept} Gaussians"
        drive = replace(drive, scene_id=file.stem.split(".")[0], points=_surface(cloud), notes=(*drive.notes, note))
        return _built(drive, cloud, file, work, key, has_photographs, tell)


def _surface(cloud: GaussianCloud) -> Points:
    """Return the middles of opaque Gaussians as points of surfaces, in the model's frame."""
    chosen = np.flatnonzero(np.asarray(cloud.opacities) > OPAQUE)
    chosen = stream("splat", 0, "surface").permutation(chosen)[:MOST_POINTS]
    spread = SPREAD * np.asarray(cloud.scales, dtype=np.float64)[chosen].mean(axis=1)
    rgb = np.clip(0.5 + C0 * np.asarray(cloud.sh, dtype=np.float64)[chosen, 0], 0, 1)
    return Points(np.asarray(cloud.means, dtype=np.float64)[chosen], rgb, np.eye(3) * (spread**2 / 3)[:, None, None])


def _built(
    drive: SourceDrive, cloud: GaussianCloud, file: Path, work: Path, key: str, has_photographs: bool, tell: Report
) -> dict[str, Any]:
    assert drive.points is not None
    placed = place(drive, drive.points)
    background = placed_cloud(cloud, placed.T_world_source)
    share = 0.0 if placed.strip is None else _carried(placed)
    if share < LEAST_CARRIED:
        found = f"{100 * share:.0f} % of the way of the poses runs over Gaussians of the model"
        raise InputError(DOING, str(file), found, "give the poses in the model's own frame and unit: those that it was trained with")
    above, below = _stands(placed)
    if below > above:
        found = f"upside down: beside the way {below} of its surfaces lie below the road and {above} stand on it"
        raise InputError(DOING, str(file), found, "turn the model over, or give the poses that it was trained with")
    model = Reconstruction(background, {}, Sky(np.zeros((HEIGHT, WIDTH, 3), np.float32)))
    begin(work, key)
    shown = shown_photographs(drive, placed) if has_photographs else []
    write_photographs(work, shown, tell)
    views = {use: [one.view() for one in shown if one.use == use] for use in ("fitted", "held-out", "never-fitted")}
    if not has_photographs:
        views["fitted"] = _blank(drive, placed)
    drive = replace(drive, notes=(*drive.notes, _said(has_photographs), "the sky is black: a model of Gaussians has none"))
    return write_folder(work, drive, placed, corridor(placed.ego, placed.ground), model, shown, views, {}, tell)


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
        out.append(PosedView(PinholeCamera.from_pose(lens.width, lens.height, lens.straight_K(), pose), blank, picture.file.stem))
    return out
