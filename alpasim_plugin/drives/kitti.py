"""KITTI odometry folders: pictures of one or two rectified stereo pairs, poses of the left grey
camera, projections.

Read are the benchmark's own layout (``image_0`` to ``image_3``, rows P0 to P3 in ``calib.txt`` in
any order, ``times.txt``, poses beside or in ``../../poses/NN.txt``) and copies with ``image_l`` and
``image_r`` and a ``calib.txt`` of two bare rows. Poses map the left camera to the world, metres,
axes of OpenCV; a row of ``calib.txt`` is the projection K [I | t] of a camera, t against the left
one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import (
    natural_order,
    parsing,
    read_bytes,
    read_text,
    real,
    some_of,
)
from alpasim_plugin.core.reading.images import check_image
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import PERIOD_US, SourceDrive, name_numbers
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import Picture, rigid_pose

PAIRS = (
    ("image_2", "image_3"),
    ("image_0", "image_1"),
    ("image_l", "image_r"),
)  # the first that is there is read, left and right
ROWS = {  # of `calib.txt` by the folder of their images
    "image_l": "P0",
    "image_r": "P1",
    "image_0": "P0",
    "image_1": "P1",
    "image_2": "P2",
    "image_3": "P3",
}
# Rows that say nothing of a rectified camera: other sensors, and how raw images were rectified.
UNUSED = re.compile(r"Tr|Tr_.*|(R|S|K|D|T)(_rect)?(_?\d+)?(_rect)?|calib_time|corner_dist")
NAMED = re.compile(r"^\s*([A-Z]\w*)\s+(?!:)")  # a name without its colon
RECTIFIED = re.compile(r"P_rect_0?(\d)")  # how raw drives name the row Pn
SUFFIXES = (".png", ".jpg", ".jpeg")


def is_kitti(folder: Path) -> bool:
    """Look for ``calib.txt`` beside a folder of left pictures."""
    return os.path.isfile(folder / "calib.txt") and any(
        os.path.isdir(folder / left) for left, _ in PAIRS
    )


def read_kitti(folder: Path) -> SourceDrive:
    """Read a drive: the left camera is driven by and fitted, the right one is kept for judging.

    Raises:
        InputError: A file is missing or damaged, or a pose is no rigid motion; the message names
            it.
    """
    left, right = next(pair for pair in PAIRS if os.path.isdir(folder / pair[0]))
    projections, unknown = _projections(folder / "calib.txt")
    poses, pictures = _poses(folder), []
    notes = [f"calib.txt: unknown rows are not read: {', '.join(unknown)}"] if unknown else []
    sides = {left: "left", right: "right"}
    files = {
        name: sorted(
            (path for path in (folder / name).iterdir() if path.suffix.lower() in SUFFIXES),
            key=lambda path: natural_order(path.name),
        )
        for name in sides
        if os.path.isdir(folder / name)
    }
    if right not in files:
        notes.append(f"no {right}: no second camera to measure the fit with")
    times = _times(folder, len(poses))
    for name, rows in _rows_of_poses(folder, files, len(poses)).items():
        K, T_left_camera = _camera(projections, name, folder / "calib.txt")
        spare = [path.name for i, path in zip(rows, files[name], strict=True) if i >= len(poses)]
        if spare:
            notes.append(f"{name}: photographs without a pose are left out: {some_of(spare)}")
        alone = len(poses) - len(rows) + len(spare)
        if alone:
            notes.append(f"{name}: {alone} of {len(poses)} poses have no photograph")
        for i, path in zip(rows, files[name], strict=True):
            if i >= len(poses):
                continue
            lens = Lens(*check_image(read_bytes(path), path), K)
            pictures.append(
                Picture(
                    path,
                    lens,
                    poses[i] @ T_left_camera,
                    f"{folder}, photograph {i}",
                    times[i],
                    sides[name],
                    {},
                )
            )
    if not os.path.isfile(folder / "times.txt"):
        notes.append("no times.txt: 10 photographs a second are assumed, as KITTI takes them")
    others = [name for name in ROWS if name not in (left, right) and os.path.isdir(folder / name)]
    if others:
        notes.append(f"not read: {', '.join(others)}")
    return SourceDrive(
        "kitti",
        real(folder).name,
        tuple(pictures),
        "left",
        ("right",) if os.path.isdir(folder / right) else (),
        metric="the poses, metres",
        notes=tuple(notes),
    )


def _rows_of_poses(
    folder: Path, files: Mapping[str, Sequence[Path]], poses: int
) -> dict[str, list[int]]:
    """Return which row has the pose of each photograph, by folder: the number of its name, counted
    from 0 or, in a part of a drive, from its first photograph; else its place among as many.

    Raises:
        InputError: Nothing says which pose belongs to a photograph, or many belong to none.
    """
    numbers = {name: name_numbers(paths) for name, paths in files.items()}
    every = {number for column in numbers.values() for number in column}
    first = min(every, default=0) if max(every, default=0) >= poses else 0
    numbered = all(numbers.values()) and (first == 0 or max(every) - first + 1 == poses)
    for name, paths in files.items():
        spare = abs(len(paths) - poses)
        if spare > (max(2, poses // 10) if numbered else 0):
            raise InputError(
                f"{folder / name}: {len(paths)} photographs and {poses} poses",
                "give the poses of these very photographs, or name them by their rows, from 0",
            )
    if not numbered:
        return {name: list(range(poses)) for name in files}
    return {name: [number - first for number in column] for name, column in numbers.items()}


def _numbers(words: str, where: str, count: int) -> list[float]:
    do_this = f"give a line of {count} for each, and no header"
    with parsing(where, do_this, "not only numbers"):
        numbers = [float(word) for word in words.split()]
    if len(numbers) != count:
        raise InputError(f"{where}: {len(numbers)} numbers", do_this)
    return numbers


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the lines of a text file that are not empty, each after its place."""
    for i, line in enumerate(read_text(path).splitlines()):
        if line.strip():
            yield f"{path}, line {i + 1}", line


def _poses(folder: Path) -> list[F64]:
    places = (folder / "poses.txt", folder.parent.parent / "poses" / f"{real(folder).name}.txt")
    path = next((one for one in places if os.path.isfile(one)), None)
    if path is None:
        raise InputError(
            f"{folder}: no poses.txt",
            "put the poses of the left camera beside the pictures, one row of 12 numbers each",
        )
    poses = [
        rigid_pose(np.reshape(_numbers(line, where, 12), (3, 4)).tolist(), where)
        for where, line in _lines(path)
    ]
    if len(poses) < 2:
        raise InputError(
            f"{path}: {len(poses)} poses", "give a row of 12 numbers for each photograph"
        )
    return poses


def _projections(path: Path) -> tuple[dict[str, F64], list[str]]:
    """Return the projections by the names of their rows, P0 on, and the names of unknown rows.

    Rows without names count from P0.
    """
    rows: dict[str, F64] = {}
    unknown = []
    for where, line in _lines(path):
        line = NAMED.sub(r"\1: ", line)
        name, colon, words = line.partition(":")
        name = RECTIFIED.sub(r"P\1", name.strip()) if colon else f"P{len(rows)}"
        if name in rows:
            raise InputError(f"{where}: a second row {name}", "give each camera one row")
        if re.fullmatch(r"P\d", name):
            rows[name] = np.reshape(_numbers(words if colon else line, where, 12), (3, 4))
        elif UNUSED.fullmatch(name) is None:
            unknown.append(name)
    return rows, unknown


def _camera(projections: dict[str, F64], name: str, path: Path) -> tuple[F64, F64]:
    """Return a camera's intrinsics and its pose against the left grey camera."""
    row = ROWS[name]
    if row not in projections:
        raise InputError(
            f"{path}: no row {row} for {name}, only {', '.join(projections) or 'none of P0 to P3'}",
            "give the projection of each camera whose images are there, a row of 12 numbers",
        )
    P = projections[row]
    K = P[:, :3].copy()
    if not np.isfinite(P).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise InputError(
            f"{path}, row {row}: no focal length",
            "give the projection of a rectified camera",
        )
    T = np.eye(4)
    T[:3, 3] = -np.linalg.solve(K, P[:, 3])
    return K + np.array(
        [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    ), T  # pixels are counted from their middle there


def _times(folder: Path, count: int) -> list[int]:
    path = folder / "times.txt"
    if not os.path.isfile(path):
        return [i * PERIOD_US for i in range(count)]
    seconds = np.array([_numbers(line, where, 1)[0] for where, line in _lines(path)])
    if len(seconds) < count or not (np.diff(seconds) > 0).all() or not np.isfinite(seconds).all():
        found = (
            f"{len(seconds)} times for {count} poses"
            if len(seconds) < count
            else "times that do not increase"
        )
        raise InputError(
            f"{path}: {found}", "give the time of each photograph in seconds, in order"
        )
    return [round(1e6 * float(one - seconds[0])) for one in seconds]
