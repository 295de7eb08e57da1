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
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import natural_order, parsing, read_bytes, read_text, real
from alpasim_plugin.core.reading.images import check_image
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import PERIOD_US, SourceDrive
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
    for name, side in ((left, "left"), (right, "right")):
        if not os.path.isdir(folder / name):
            notes.append(f"no {name}: no second camera to judge the fit by")
            continue
        files = [path for path in (folder / name).iterdir() if path.suffix.lower() in SUFFIXES]
        files.sort(key=lambda path: natural_order(path.name))
        taken, note = _matched(folder, name, files, len(poses))
        notes += note
        K, T_left_camera = _camera(projections, name, folder / "calib.txt")
        times = _times(folder, len(poses))
        for i, path in enumerate(taken):
            lens = Lens(*check_image(read_bytes(path), path), K)
            pictures.append(
                Picture(
                    path,
                    lens,
                    poses[i] @ T_left_camera,
                    f"{folder}, photograph {i}",
                    times[i],
                    side,
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


def _matched(
    folder: Path, name: str, files: list[Path], poses: int
) -> tuple[list[Path], list[str]]:
    """Return the pictures that have poses; a few more of either are dropped and said, many are
    another drive's.
    """
    spare = len(files) - poses
    if not spare:
        return files, []
    if abs(spare) > max(2, poses // 10):
        raise InputError(
            f"{folder / name}: {len(files)} photographs and {poses} poses",
            "give the poses of these very photographs, one row each",
        )
    if spare < 0:
        return files, [
            f"{poses} poses for {len(files)} photographs in {name}: the last {-spare} poses were dropped"
        ]
    names = ", ".join(path.name for path in files[poses:])
    return files[:poses], [
        f"{poses} poses for {len(files)} photographs in {name}: the last was dropped ({names})"
        if spare == 1
        else f"{poses} poses for {len(files)} photographs in {name}: the last {spare} were dropped ({names})"
    ]


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
