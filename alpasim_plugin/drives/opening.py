"""From a folder or file to the drive in it: which of the known forms it has."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import contents, natural_order, parsing, real, some_of
from alpasim_plugin.core.files.fields import field_name
from alpasim_plugin.drives.colmap import models_in, read_colmap
from alpasim_plugin.drives.kitti import is_kitti, read_kitti
from alpasim_plugin.drives.points import agreeing
from alpasim_plugin.drives.py123d import SYNC_FILE, read_py123d
from alpasim_plugin.drives.source import Points, SourceDrive, in_order, timed
from alpasim_plugin.gaussians.fit.photographs import (
    AXES,
    FILE,
    TRANSFORMS,
    PosedPhotograph,
    inside,
    present,
    read_points,
    read_posed_photographs,
)
from alpasim_plugin.gaussians.sh import C0

PAIRS, FEWEST, CLEARLY = (
    6,
    40,
    1.5,
)  # pairs that the axes are tried on; matches that tell; by how much one must be better
FORMS = "a folder with transforms.json, a KITTI odometry folder (not raw, which has no poses), a COLMAP model, or a log of py123d"


def read_source(folder: Path, need_files: bool = True) -> SourceDrive:
    """Read a recorded drive.

    Args:
        folder: Holds poses and photographs.
        need_files: Whether the photographs must be there; poses and lenses alone are enough for a model that
            is trained already.

    Raises:
        InputError: There is nothing, no reader knows it, or it is damaged.
    """
    if not os.path.exists(folder):
        raise InputError(f"{folder}: it does not exist", f"give {FORMS}")
    if folder.name == FILE:
        folder = folder.parent
    with parsing(folder, f"give {FORMS}"):
        if os.path.isfile(folder / FILE):
            return _transforms(folder, need_files)
        if is_kitti(folder):
            return read_kitti(folder)
        if os.path.isfile(folder / SYNC_FILE):
            return read_py123d(folder)
        if models_in(folder):
            return read_colmap(folder, need_files=need_files)
    raise InputError(f"{folder}: {contents(folder)}: no known form of a drive", f"give {FORMS}")


def _transforms(folder: Path, need_files: bool) -> SourceDrive:
    """Read a ``transforms.json`` of either convention of axes."""
    document, listed = read_posed_photographs(folder, "opencv")
    if not listed:
        raise InputError(f"{folder / FILE}: no frames", "list the photographs with their poses")
    notes = []
    some = need_files or any(os.path.isfile(one.file) for one in listed)
    there, missing = present(folder, listed) if some else (listed, ())
    if "axes" not in document:
        if not some:
            raise InputError(
                f"{folder / FILE}: no key 'axes', and no photographs to recognise it by",
                'write "axes": "opengl" into the file, as nerfstudio and Instant-NGP mean it, or "axes": "opencv" (y down, z forward)',
            )
        axes, note = recognised_axes(folder, there)
        notes.append(note)
        listed = [replace(one, T_world_camera=one.T_world_camera @ AXES[axes]) for one in listed]
    if missing:
        notes.append(
            f"{len(missing)} of {len(listed)} listed photographs are missing and left out: {some_of(missing)}"
        )
    files = {one.file for one in there}
    notes += TRANSFORMS.notes(field_name("frame", key) for one in listed for key in one.more)
    folders = {one.file: os.path.relpath(one.file.parent, folder) for one in listed}
    if len(set(folders.values())) == 1 or len({one.name for one in folders}) == len(folders):
        folders = dict.fromkeys(folders, "front")  # one camera does not use a name twice
    every = [
        replace(one, camera=one.camera or folders[one.file].replace(os.sep, "-")) for one in listed
    ]
    names = sorted({str(one.camera) for one in every if one.file in files})
    front = next((name for name in names if "front" in name), names[0])
    without = [one for one in every if one.t_us is None]
    if len(without) == len(every):
        ordered = [in_order([one for one in every if one.camera == name]) for name in names]
        every = timed([mine for mine, _ in ordered])
        notes += [note for _, note in ordered]
    elif without:
        raise InputError(
            f"{without[0].location}: no t_us, which other photographs have",
            "give every photograph its time, or none",
        )
    photographs = [one for one in every if one.file in files]
    photographs.sort(key=lambda one: (str(one.camera), int(one.t_us or 0)))
    kept = tuple(
        {str(one.camera): 0 for one in photographs if one.more.get("use") == "never-fitted"}
    )
    unit = document.get("unit")
    if unit not in (None, "m"):
        raise InputError(f"{folder / FILE}, unit: {unit!r}", 'give metres, "unit": "m", or no unit')
    metric = "the file's word that its unit is the metre" if unit else None
    points = None
    if need_files and document.get("ply_file_path") is not None:
        path = inside(
            folder, folder / str(document["ply_file_path"]), f"{folder / FILE}, ply_file_path"
        )
        cloud = read_points(path)
        rgb = np.clip(0.5 + C0 * cloud.sh[:, 0], 0, 1)
        xyz = np.asarray(cloud.means, np.float64)
        points = Points(xyz, rgb, np.zeros((len(cloud), 3, 3)))
    return SourceDrive(
        "transforms",
        real(folder).name,
        tuple(photographs),
        front,
        kept,
        metric,
        points=points,
        notes=tuple(notes),
    )


def recognised_axes(folder: Path, photographs: Sequence[PosedPhotograph]) -> tuple[str, str]:
    """Return the convention of axes of a ``transforms.json`` under which neighbouring photographs
    fit together, and a note.

    With the wrong one epipolar lines are mirrored, or points lie behind the cameras.

    Args:
        folder: Holds the file.
        photographs: Read as if it were that of OpenCV.

    Raises:
        InputError: Both fit, or neither.
    """
    there = sorted(photographs, key=lambda one: natural_order(one.file.as_posix()))
    chosen = np.unique(np.linspace(0, len(there) - 2, min(PAIRS, len(there) - 1)).astype(int))
    counts = np.sum([agreeing(there[i], there[i + 1], list(AXES.values())) for i in chosen], axis=0)
    inliers = dict(zip(AXES, (int(count) for count in counts), strict=True))
    best, other = sorted(inliers, key=lambda axes: -inliers[axes])
    if inliers[best] < FEWEST or inliers[best] < CLEARLY * inliers[other]:
        raise InputError(
            f"{folder / FILE}: no 'axes', and photographs fit together alike with {best} ({inliers[best]} matches) and {other} ({inliers[other]})",
            'write "axes": "opencv" (y down, z forward) or "axes": "opengl" (y up, z back) into the file',
        )
    return (
        best,
        f"axes recognised as {best}: {inliers[best]} matches of neighbouring photographs fit, {inliers[other]} with {other}",
    )
