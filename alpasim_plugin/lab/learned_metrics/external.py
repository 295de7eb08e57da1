"""Detections that a user's own detectors wrote as JSON: then, and only then, lanes and cuboids have
the paper's names.

    {"detector": "PGD R101 nuScenes 2x", "weights_sha256": "...", "size": [960, 544], "K": [[...]],
    "frames": [
        {"frame": 0, "cuboids": [{"label": "car", "score": 0.7, "box": [x, y, z, length, height,
        width, yaw]}]}, {"frame": 1, "lanes": [{"score": 0.8, "points": [[forward, left], ...]}]}]}

Boxes are in the camera's axes with the origin in their middle; with ``"origin": "bottom"`` in the
middle of their underside, as in mmdetection3d. Lane points are metres in the rig frame; only
visible ones are listed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import parsing, read_json_object
from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.learned_metrics.fvmd import EVERY, FRAMES, GRID
from alpasim_plugin.lab.learned_metrics.lanes import resampled
from alpasim_plugin.lab.learned_metrics.types import Cuboid, Lane3D

DOING = "reading a detector's results"
DO = "write the form that docs/lab/judges.md describes"


@dataclass(frozen=True)
class Detections:
    """Detections of one clip, frame by frame.

    Args:
        detector: Its name, printed in tables.
        weights: Digest of its weights, as the file says.
        cuboids, lanes: By frame; empty where nothing was found.
        K, size: Of the images that it saw; needed for cuboids. Height and width.
    """

    detector: str
    weights: str
    cuboids: tuple[tuple[Cuboid, ...], ...]
    lanes: tuple[tuple[Lane3D, ...], ...]
    K: F64 | None
    size: tuple[int, int] | None


def read_detections(path: Path, frames: int) -> Detections:
    """Read a clip's detections.

    Args:
        path: JSON.
        frames: Frames of the clip.

    Raises:
        InputError: Not of this form, or a frame twice or beyond the clip.
    """
    document = read_json_object(path, do_this=DO)
    with parsing(path, DO, "not a detector's results"):
        rows: list[Mapping[str, Any]] = list(document["frames"])
        numbers = [int(row["frame"]) for row in rows]
        bottom = document.get("origin", "middle") == "bottom"
        by_frame = dict(zip(numbers, rows, strict=True))
        cuboids = tuple(
            tuple(_cuboid(c, bottom) for c in by_frame.get(i, {}).get("cuboids", ()))
            for i in range(frames)
        )
        lanes = tuple(
            tuple(_lane(lane) for lane in by_frame.get(i, {}).get("lanes", ()))
            for i in range(frames)
        )
        K = np.array(document["K"], dtype=np.float64).reshape(3, 3) if "K" in document else None
        size = (int(document["size"][1]), int(document["size"][0])) if "size" in document else None
        detector, weights = str(document["detector"]), str(document["weights_sha256"])
    if len(by_frame) != len(rows) or any(not 0 <= n < frames for n in numbers):
        raise InputError(
            f"{path}: frames {sorted(numbers)[:3]} ... {max(numbers, default=0)} of a clip of {frames}",
            "list every frame once, counted from 0",
        )
    return Detections(detector, weights, cuboids, lanes, K, size)


def read_tracks(path: Path, frames: int) -> F64:
    """Read a clip's tracks of points: an ``.npz`` with ``tracks (W, 16, 400, 2)``, a window of 16
    frames every 25.

    The first index of the last axis is x; both are pixels of the 256x256 image.

    Args:
        path: The file.
        frames: Frames of the clip.

    Raises:
        InputError: Not of this form, other windows than the clip has, or a value that is not
            finite.
    """
    _, do = (
        "reading tracks",
        "write one window of 16 frames for every 25, 400 points each, as docs/lab/judges.md describes",
    )
    with parsing(path, do, "not an archive with tracks"), np.load(path) as stored:
        tracks = np.asarray(stored["tracks"], dtype=np.float64)
    wanted = (len(range(0, frames - FRAMES + 1, EVERY)), FRAMES, GRID * GRID, 2)
    if tracks.shape != wanted or not np.isfinite(tracks).all():
        found = f"shape {tracks.shape}" if tracks.shape != wanted else "a value that is not finite"
        raise InputError(f"{path}: {found}, a clip of {frames} frames has {wanted}", do)
    return tracks


def _cuboid(row: Mapping[str, Any], bottom: bool) -> Cuboid:
    x, y, z, length, height, width, yaw = (float(v) for v in row["box"])
    if not np.isfinite([x, y, z, yaw]).all() or not min(length, height, width) > 0:
        raise ValueError(f"box {row['box']}")
    return Cuboid(
        str(row["label"]),
        float(row["score"]),
        x,
        y - height / 2 if bottom else y,
        z,
        length,
        height,
        width,
        yaw,
    )


def _lane(row: Mapping[str, Any]) -> Lane3D:
    points = np.array(row["points"], dtype=np.float64).reshape(-1, 2)
    if not len(points) or not np.isfinite(points).all():
        raise ValueError("a lane without points, or one that is not finite")
    return resampled(points[:, 0], points[:, 1], float(row["score"]))
