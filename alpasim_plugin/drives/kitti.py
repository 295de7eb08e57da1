"""KITTI odometry folders: images of one or two rectified stereo pairs, poses of the left grey
camera, projections.

Read are the benchmark's own layout (``image_0`` to ``image_3``, rows P0 to P3 in ``calib.txt`` in
any order, ``times.txt``, poses beside or in ``../../poses/NN.txt``) and copies with ``image_l`` and
``image_r`` and a ``calib.txt`` of two bare rows. Poses map the left camera to the world, metres,
axes of OpenCV; a row of ``calib.txt`` is the projection K [I | t] of a camera, t against the left
one.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import (
    natural_order,
    parsing,
    read_bytes,
    read_text,
    real,
    some_of,
)
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.files.images import check_image
from alpasim_plugin.core.geometry import shifted
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import PERIOD_US, SourceDrive, name_numbers
from alpasim_plugin.gaussians.fit.lens import FROM_CORNER, Lens
from alpasim_plugin.gaussians.fit.photographs import PosedPhotograph, rigid_pose

# Left and right; the first pair that is there is read.
PAIRS = (("image_2", "image_3"), ("image_0", "image_1"), ("image_l", "image_r"))
# Rows of `calib.txt` by the folder of their images.
ROWS = {
    "image_l": "P0",
    "image_r": "P1",
    "image_0": "P0",
    "image_1": "P1",
    "image_2": "P2",
    "image_3": "P3",
}
CALIBRATION = "calib.txt"
KITTI = Fields(
    "KITTI odometry",
    read={
        "folder": "calib.txt poses.txt times.txt image_0 image_1 image_2 image_3 image_l image_r",
        CALIBRATION: "P# P_rect_#",
    },
    # Other sensors, and how raw images were rectified: what is read of a rectified camera is whole.
    harmless={
        "folder": "velodyne",
        CALIBRATION: """Tr Tr_velo_cam Tr_velo_to_cam Tr_imu_to_velo Tr_cam_to_road R_rect R#_rect R_rect_#
            S_# S_rect_# K_# D_# R_# T_# calib_time corner_dist""",
    },
)
SUFFIXES = (".png", ".jpg", ".jpeg")
ROW_OF_12 = "give a row of 12 numbers for each, and no header"


def is_kitti(folder: Path) -> bool:
    """Look for ``calib.txt`` beside a folder of left images."""
    return os.path.isfile(folder / CALIBRATION) and any(
        os.path.isdir(folder / left) for left, _ in PAIRS
    )


def read_kitti(folder: Path) -> SourceDrive:
    """Read a drive: the left camera is driven by and fitted, the right one is kept for measuring.

    Raises:
        InputError: A file is missing or damaged, or a pose is no rigid motion; the message names
            it.
    """
    left, right = next(pair for pair in PAIRS if os.path.isdir(folder / pair[0]))
    projections, notes = _projections(folder / CALIBRATION)
    poses = _poses(folder)
    files = {left: _images(folder / left)}
    if os.path.isdir(folder / right):
        files[right] = _images(folder / right)
    else:
        notes.append(f"no {right}: no second camera to measure the fit with")
    times = _times(folder / "times.txt", len(poses), notes)
    photographs = []
    for name, rows in _rows_of_poses(folder, files, len(poses)).items():
        K, T_left_camera = _camera(projections, name, folder / CALIBRATION)
        camera = "left" if name == left else "right"
        numbered = list(zip(rows, files[name], strict=True))
        for i, path in numbered:
            if i >= len(poses):
                continue
            lens = Lens(*check_image(read_bytes(path), path), K)
            location = f"{folder}, photograph {i}"
            pose = poses[i] @ T_left_camera
            photographs.append(PosedPhotograph(path, lens, pose, location, times[i], camera, {}))
        notes += _unmatched(name, numbered, len(poses))
    others = [name for name in ROWS if name not in files and os.path.isdir(folder / name)]
    if others:
        notes.append(f"not read: {', '.join(others)}")
    notes += KITTI.notes(field_name("folder", entry.name) for entry in folder.iterdir())
    return SourceDrive(
        "kitti",
        real(folder).name,
        tuple(photographs),
        "left",
        ("right",) if right in files else (),
        metric="the poses, metres",
        notes=tuple(notes),
    )


def _unmatched(name: str, numbered: Sequence[tuple[int, Path]], n_poses: int) -> list[str]:
    """Say which photographs of a camera have no pose, and how many poses have no photograph."""
    notes = []
    spare = [path.name for row, path in numbered if row >= n_poses]
    if spare:
        notes.append(f"{name}: photographs without a pose are left out: {some_of(spare)}")
    alone = n_poses - (len(numbered) - len(spare))
    if alone:
        notes.append(f"{name}: {alone} of {n_poses} poses have no photograph")
    return notes


def _images(folder: Path) -> list[Path]:
    """Return the images of a camera in the natural order of their names."""
    images = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    return sorted(images, key=lambda path: natural_order(path.name))


def _rows_of_poses(folder: Path, files: dict[str, list[Path]], poses: int) -> dict[str, list[int]]:
    """Return which row has the pose of each photograph, by folder: the number of its name, counted
    from 0 or, in a part of a drive, from its first photograph; else its place among as many.

    Raises:
        InputError: Nothing says which pose belongs to a photograph, or many belong to none.
    """
    numbers = {name: name_numbers(paths) for name, paths in files.items()}
    all_numbers = {number for column in numbers.values() for number in column}
    first = min(all_numbers, default=0) if max(all_numbers, default=0) >= poses else 0
    numbered = all(numbers.values()) and (first == 0 or max(all_numbers) - first + 1 == poses)
    for name, paths in files.items():
        if abs(len(paths) - poses) > (max(2, poses // 10) if numbered else 0):
            raise InputError(
                f"{folder / name}: {len(paths)} photographs and {poses} poses",
                "give the poses of these very photographs, or name them by their rows, from 0",
            )
    if not numbered:
        return {name: list(range(poses)) for name in files}
    return {name: [number - first for number in column] for name, column in numbers.items()}


def _table(path: Path, columns: int, do_this: str) -> F64:
    """Return the numbers ``(N, columns)`` of a text file."""
    rows = []
    for i, line in enumerate(read_text(path).splitlines()):
        if line.strip():
            with parsing(f"{path}, line {i + 1}", do_this, "not only numbers"):
                rows.append(np.array(line.split(), dtype=np.float64).reshape(columns))
    return np.array(rows).reshape(-1, columns)


def _poses(folder: Path) -> list[F64]:
    places = (folder / "poses.txt", folder.parent.parent / "poses" / f"{real(folder).name}.txt")
    path = next((place for place in places if os.path.isfile(place)), None)
    if path is None:
        raise InputError(f"{folder}: no poses.txt", "put the poses of the left camera beside it")
    table = _table(path, 12, ROW_OF_12)
    if len(table) < 2:
        raise InputError(f"{path}: {len(table)} poses", ROW_OF_12)
    return [
        rigid_pose(row.reshape(3, 4).tolist(), f"{path}, row {i + 1}")
        for i, row in enumerate(table)
    ]


def _projections(path: Path) -> tuple[dict[str, F64], list[str]]:
    """Return the projections by the names of their rows, P0 on, and notes on rows that are not
    read.

    Rows without names count from P0.
    """
    rows = {}
    met = []
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    for i, line in enumerate(lines):
        head = re.match(r"\s*(?:(\w+):|(P\d)\s)", line)
        name = f"P{i}"
        words = line
        if head is not None:
            stated = head[1] or head[2]
            met.append(field_name(CALIBRATION, stated))
            name = stated.replace("P_rect_0", "P")
            words = line[head.end() :]
        if name in rows:
            raise InputError(f"{path}: a second row {name}", "give each camera one row")
        if re.fullmatch(r"P\d", name):
            with parsing(f"{path}, row {name}", ROW_OF_12):
                rows[name] = np.array(words.split(), dtype=np.float64).reshape(3, 4)
    return rows, list(KITTI.notes(met))


def _camera(projections: dict[str, F64], name: str, path: Path) -> tuple[F64, F64]:
    """Return a camera's intrinsics and its pose against the left grey camera."""
    row = ROWS[name]
    if row not in projections:
        raise InputError(
            f"{path}: no row {row} for {name}, only {', '.join(projections) or 'none of P0 to P3'}",
            "give the projection of each camera whose images are there, a row of 12 numbers",
        )
    P = projections[row]
    K = P[:, :3]
    Lens(1, 1, K).check(f"{path}, row {row}", "give the projection of a rectified camera")
    T = shifted(*-np.linalg.solve(K, P[:, 3]))
    return K + FROM_CORNER, T  # KITTI counts from pixel centres


def _times(path: Path, count: int, notes: list[str]) -> list[int]:
    if not os.path.isfile(path):
        notes.append("no times.txt: 10 photographs a second are assumed, as KITTI takes them")
        return [i * PERIOD_US for i in range(count)]
    seconds = _table(path, 1, "give the time of each photograph in seconds, and no header")[:, 0]
    if len(seconds) < count or not (np.diff(seconds) > 0).all():
        raise InputError(
            f"{path}: {len(seconds)} times for {count} poses, or times that do not increase",
            "give the time of each photograph in seconds, in order",
        )
    return np.rint(1e6 * (seconds - seconds[0])).astype(np.int64).tolist()
