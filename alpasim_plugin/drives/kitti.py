"""KITTI odometry folders: pictures of one or two rectified stereo pairs, poses of the left grey
camera, projections.

Read are the benchmark's own layout (``image_0`` to ``image_3``, named rows in ``calib.txt``,
``times.txt``, poses beside or in ``../../poses/NN.txt``) and copies with ``image_l`` and
``image_r`` and a ``calib.txt`` of bare rows. Poses map the left camera to the world, metres, axes
of OpenCV; a row of ``calib.txt`` is the projection K [I | t] of a camera, t against the left one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import read_bytes, read_text
from alpasim_plugin.core.reading.images import check_image
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import SourceDrive
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import Picture, rigid_pose

PAIRS = (
    ("image_2", "image_3"),
    ("image_0", "image_1"),
    ("image_l", "image_r"),
)  # the first that is there is read, left and right
ROWS = {"image_l": 0, "image_r": 1, "image_0": 0, "image_1": 1, "image_2": 2, "image_3": 3}
PERIOD_US = 100_000
SUFFIXES = (".png", ".jpg", ".jpeg")


def is_kitti(folder: Path) -> bool:
    """Look for ``calib.txt`` beside a folder of left pictures."""
    return (folder / "calib.txt").is_file() and any((folder / left).is_dir() for left, _ in PAIRS)


def read_kitti(folder: Path) -> SourceDrive:
    """Read a drive: the left camera is driven by and fitted, the right one is kept for judging.

    Raises:
        InputError: A file is missing or damaged, or a pose is no rigid motion; the message names
            it.
    """
    left, right = next(pair for pair in PAIRS if (folder / pair[0]).is_dir())
    projections, poses = _projections(folder / "calib.txt"), _poses(folder)
    notes, pictures = [], []
    for name, side in ((left, "left"), (right, "right")):
        if not (folder / name).is_dir():
            notes.append(f"no {name}: no second camera to judge the fit by")
            continue
        files = sorted(
            path for path in (folder / name).iterdir() if path.suffix.lower() in SUFFIXES
        )
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
    if not (folder / "times.txt").is_file():
        notes.append("no times.txt: 10 photographs a second are assumed, as KITTI takes them")
    others = [name for name in ROWS if name not in (left, right) and (folder / name).is_dir()]
    if others:
        notes.append(f"not read: {', '.join(others)}")
    return SourceDrive(
        "kitti",
        folder.resolve().name,
        tuple(pictures),
        "left",
        ("right",) if (folder / right).is_dir() else (),
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


def _rows(path: Path, width: int) -> list[list[float]]:
    """Return the rows of a text file of numbers, names before a colon left out."""
    rows = []
    for i, line in enumerate(read_text(path).splitlines()):
        words = line.rpartition(":")[2].split()
        if not words:
            continue
        try:
            numbers = [float(word) for word in words]
        except ValueError as error:
            raise InputError(
                f"{path}, line {i + 1}: {error}", f"give {width} numbers a line"
            ) from error
        if len(numbers) == width:
            rows.append(numbers)
        elif len(words) not in (9, 12):  # calib.txt of raw drives also holds rotations
            raise InputError(
                f"{path}, line {i + 1}: {len(numbers)} numbers",
                f"give {width} numbers a line",
            )
    return rows


def _poses(folder: Path) -> list[F64]:
    places = (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.resolve().name}.txt")
    path = next((one for one in places if one.is_file()), None)
    if path is None:
        raise InputError(
            f"{folder}: no poses.txt",
            "put the poses of the left camera beside the pictures, one row of 12 numbers each",
        )
    rows = _rows(path, 12)
    if len(rows) < 2:
        raise InputError(
            f"{path}: {len(rows)} poses", "give a row of 12 numbers for each photograph"
        )
    return [
        rigid_pose(np.reshape(row, (3, 4)).tolist(), f"{path}, line {i + 1}")
        for i, row in enumerate(rows)
    ]


def _projections(path: Path) -> list[F64]:
    rows = _rows(path, 12)
    if not rows:
        raise InputError(
            f"{path}: no row of 12 numbers",
            "give the cameras' projections, left and right",
        )
    return [np.reshape(row, (3, 4)) for row in rows]


def _camera(projections: list[F64], name: str, path: Path) -> tuple[F64, F64]:
    """Return a camera's intrinsics and its pose against the left grey camera."""
    if ROWS[name] >= len(projections):
        raise InputError(
            f"{path}: {len(projections)} projections, none for {name}",
            "give a row of 12 numbers for each camera",
        )
    P = projections[ROWS[name]]
    K = P[:, :3].copy()
    if not np.isfinite(P).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise InputError(
            f"{path}, row {ROWS[name] + 1}: no focal length",
            "give the projection of a rectified camera",
        )
    T = np.eye(4)
    T[:3, 3] = -np.linalg.solve(K, P[:, 3])
    return K + np.array(
        [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    ), T  # pixels are counted from their middle there


def _times(folder: Path, count: int) -> list[int]:
    path = folder / "times.txt"
    if not path.is_file():
        return [i * PERIOD_US for i in range(count)]
    seconds = np.array([float(word) for word in read_text(path).split()])
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
