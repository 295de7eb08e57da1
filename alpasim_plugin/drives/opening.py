"""From a folder or file to the drive in it: which of the known forms it has."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import contents, natural_order, parsing, real, some_of
from alpasim_plugin.core.files.fields import field_name
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.drives.colmap import models_in, read_colmap
from alpasim_plugin.drives.kitti import is_kitti, read_kitti
from alpasim_plugin.drives.points import agreeing
from alpasim_plugin.drives.py123d import SYNC_FILE, read_py123d
from alpasim_plugin.drives.source import Points, SourceDrive, front_camera, in_order, timed
from alpasim_plugin.gaussians.fit.photographs import (
    AXES,
    FILE,
    TRANSFORMS,
    PosedPhotograph,
    angle_notes,
    inside,
    present,
    read_points,
    read_posed_photographs,
)
from alpasim_plugin.gaussians.sh import C0
from scenarios.unread_forms import unread_form

# Pairs of photographs that the axes are tried on.
PAIRS = 6
# Matches that tell the axes.
FEWEST = 40
# How many times the matches of the other axes the better ones must have.
CLEARLY = 1.5
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
    unread = unread_form(folder)
    if unread is not None:
        raise InputError(f"{folder}: {unread[0]}, which is not read", unread[1])
    raise InputError(f"{folder}: {contents(folder)}: no known form of a drive", f"give {FORMS}")


def _transforms(folder: Path, need_files: bool) -> SourceDrive:
    """Read a ``transforms.json`` of either convention of axes."""
    document, listed = read_posed_photographs(folder, "opencv")
    if not listed:
        raise InputError(f"{folder / FILE}: no frames", "list the photographs with their poses")
    existing, missing = _existing(folder, listed, need_files)
    files = {photograph.file for photograph in existing}
    in_axes, axes_notes = _in_opencv_axes(folder, document, listed, existing)
    with_cameras = _with_cameras(folder, in_axes)
    names = sorted(
        {str(photograph.camera) for photograph in with_cameras if photograph.file in files}
    )
    with_times, time_notes = _with_times(with_cameras, names)
    photographs = [photograph for photograph in with_times if photograph.file in files]
    photographs.sort(key=lambda photograph: (str(photograph.camera), int(photograph.t_us or 0)))
    never_fitted = _never_fitted(photographs)
    shots = {name: [shot for shot in photographs if shot.camera == name] for name in names}
    return SourceDrive(
        "transforms",
        real(folder).name,
        tuple(photographs),
        front=front_camera(
            {name: shots[name] for name in names if name not in never_fitted} or shots
        ),
        never_fitted=never_fitted,
        metric=_unit_source(folder, document),
        points=_start_points(folder, document, photographs) if need_files else None,
        notes=(*axes_notes, *_file_notes(listed, missing), *time_notes),
    )


def _existing(
    folder: Path, listed: Sequence[PosedPhotograph], need_files: bool
) -> tuple[Sequence[PosedPhotograph], tuple[str, ...]]:
    """Return the photographs to use and the names of the missing ones.

    Where files are not needed and none exists, all listed photographs are used for their poses.
    """
    if not need_files and not _any_file(listed):
        return listed, ()
    return present(folder, listed)


def _any_file(photographs: Sequence[PosedPhotograph]) -> bool:
    return any(os.path.isfile(photograph.file) for photograph in photographs)


def _in_opencv_axes(
    folder: Path,
    document: JsonObject,
    listed: Sequence[PosedPhotograph],
    existing: Sequence[PosedPhotograph],
) -> tuple[Sequence[PosedPhotograph], list[str]]:
    """Return the listed photographs with poses in OpenCV's axes, with notes.

    Poses of a file that does not name its axes were read as if they were OpenCV's already; the
    photographs tell which axes they have.

    Raises:
        InputError: The file does not name its axes and the photographs cannot tell them.
    """
    if "axes" in document:
        return listed, []
    if not _any_file(existing):
        raise InputError(
            f"{folder / FILE}: no key 'axes', and no photographs to recognise it by",
            'write "axes": "opengl" into the file, as nerfstudio and Instant-NGP mean it, or "axes": "opencv" (y down, z forward)',
        )
    axes, note = recognised_axes(folder, existing)
    turn = AXES[axes]
    turned = [
        replace(photograph, T_world_camera=photograph.T_world_camera @ turn)
        for photograph in listed
    ]
    return turned, [note]


def _file_notes(listed: Sequence[PosedPhotograph], missing: Sequence[str]) -> list[str]:
    """Return notes on missing photographs and on keys that are not used."""
    notes = []
    if missing:
        notes.append(
            f"{len(missing)} of {len(listed)} listed photographs are missing and left out: {some_of(missing)}"
        )
    keys = (field_name("frame", key) for photograph in listed for key in photograph.more)
    return [*notes, *angle_notes(listed), *TRANSFORMS.notes(keys)]


def _with_cameras(folder: Path, photographs: Sequence[PosedPhotograph]) -> list[PosedPhotograph]:
    """Return the photographs with the name of their camera: as the file names it, else by their
    folder.

    Where all lie in one folder, or no name of a file occurs twice, they are one camera's: a camera
    does not use a name twice.
    """
    files = {photograph.file for photograph in photographs}
    folders = {file: os.path.relpath(file.parent, folder) for file in files}
    is_one_folder = len(set(folders.values())) == 1
    names_differ = len({file.name for file in files}) == len(files)
    if is_one_folder or names_differ:
        cameras = dict.fromkeys(files, "front")
    else:
        cameras = {file: path.replace(os.sep, "-") for file, path in folders.items()}
    return [
        replace(photograph, camera=photograph.camera or cameras[photograph.file])
        for photograph in photographs
    ]


def _with_times(
    photographs: Sequence[PosedPhotograph], cameras: Sequence[str]
) -> tuple[Sequence[PosedPhotograph], list[str]]:
    """Return the photographs with their times, with notes on the order that was assumed.

    Where no photograph has a time, those of the named cameras are put into an order and timed by
    it.

    Raises:
        InputError: Some photographs have a time and others have none.
    """
    without = [photograph for photograph in photographs if photograph.t_us is None]
    if not without:
        return photographs, []
    if len(without) < len(photographs):
        raise InputError(
            f"{without[0].location}: no t_us, which other photographs have",
            "give every photograph its time, or none",
        )
    columns = []
    notes: list[str] = []
    for camera in cameras:
        column, order_note = in_order(
            [photograph for photograph in photographs if photograph.camera == camera]
        )
        columns.append(column)
        notes.append(order_note)
    return timed(columns), notes


def _never_fitted(photographs: Sequence[PosedPhotograph]) -> tuple[str, ...]:
    """Return the cameras that the file holds out of the fit."""
    cameras = (
        str(photograph.camera)
        for photograph in photographs
        if photograph.more.get("use") == "never-fitted"
    )
    return tuple(dict.fromkeys(cameras))


def _unit_source(folder: Path, document: JsonObject) -> str | None:
    """Return what says that the file's unit is the metre; None where nothing does.

    Raises:
        InputError: The file has another unit.
    """
    unit = document.get("unit")
    if unit not in (None, "m"):
        raise InputError(f"{folder / FILE}, unit: {unit!r}", 'give metres, "unit": "m", or no unit')
    return "the file's word that its unit is the metre" if unit else None


def _start_points(
    folder: Path, document: JsonObject, photographs: Sequence[PosedPhotograph]
) -> Points | None:
    """Return the points, with colours, that the file names; None where it names none."""
    name = document.get("ply_file_path")
    if name is None:
        return None
    path = inside(folder, folder / str(name), f"{folder / FILE}, ply_file_path")
    cloud = read_points(path)
    rgb = np.clip(0.5 + C0 * cloud.sh[:, 0], 0, 1)
    xyz = np.asarray(cloud.means, dtype=np.float64)
    return Points.of_unstated_error(xyz, rgb, photographs)


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
    ordered = sorted(photographs, key=lambda photograph: natural_order(photograph.file.as_posix()))
    chosen = np.unique(np.linspace(0, len(ordered) - 2, min(PAIRS, len(ordered) - 1)).astype(int))
    counts = np.sum(
        [agreeing(ordered[i], ordered[i + 1], list(AXES.values())) for i in chosen], axis=0
    )
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
