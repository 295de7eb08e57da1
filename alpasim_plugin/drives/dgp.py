"""DGP scenes (TRI's Dataset Governance Policy, as DDAD ships): a camera rig, LiDAR, boxes,
calibration.

A scene file lists samples, each with a datum for every sensor: an image or a point cloud with its
pose ``sensor -> world``, metres. The extrinsics in ``calibration/`` map a sensor to the rig. Boxes
of a sweep stand in the LiDAR's frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, se3, trajectory_from_poses, transform_points
from alpasim_plugin.core.reading import read_bytes, read_json_object
from alpasim_plugin.core.reading.arrays import open_npy
from alpasim_plugin.core.reading.files import parsing
from alpasim_plugin.core.types import F64, Actor, Bool, Box
from alpasim_plugin.drives.source import Points, SourceDrive
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import Picture
from scenarios.recorded import split_at_gaps, stands_still

DOING = "reading a DGP scene"
SCENES = "scene_*.json"
FRONT = "CAMERA_01"
LABELS = {
    "Person": "pedestrian",
    "Truck": "truck",
    "Car": "car",
    "Bus/RV/Caravan": "bus",
    "Motorcycle": "motorcycle",
    "Bicycle": "cyclist",
}
MAX_GAP_US = 1_500_000  # keyframes are labelled once or twice a second
LIDAR_SPREAD_M = 0.02
NEAR_M = 80.0
MARGIN_M = 0.2
FEWEST_POINTS = 1  # a box without a point was guessed


def is_dgp(folder: Path) -> bool:
    """Look for a scene file beside its calibration."""
    return (folder / "calibration").is_dir() and any(folder.glob(SCENES))


def read_dgp(folder: Path) -> SourceDrive:
    """Read a scene: all cameras are fitted, the front one is driven by, the LiDAR gives the points.

    Raises:
        InputError: A file or key is missing or damaged; the message names it.
    """
    scenes = sorted(folder.glob(SCENES))
    if len(scenes) != 1:
        names = ", ".join(path.name for path in scenes)
        raise InputError(
            f"{folder}: {len(scenes)} scenes ({names})", "give the folder of one scene"
        )
    path = scenes[0]
    document = read_json_object(path)
    with parsing(path, "give a whole scene of DGP, with its calibration"):
        lenses, mounts = _calibration(folder, document)
        data = list(document["data"])
        pictures = tuple(
            one
            for name in sorted(lenses)
            for one in _pictures(folder, path, data, name, lenses[name])
        )
        sweeps = [item for item in data if "point_cloud" in item["datum"]]
        front = FRONT if any(one.camera == FRONT for one in pictures) else str(pictures[0].camera)
        points, tracks, notes = _lidar(folder, document, sweeps, pictures)
        mine = [one for one in pictures if one.camera == front]
        rig = np.array([one.T_world_camera @ inverse(mounts[front]) for one in mine])
        ego = trajectory_from_poses(np.array([int(one.t_us or 0) for one in mine]), rig)
    scene_id = str(document.get("name") or folder.resolve().name) or "dgp"
    return SourceDrive(
        "dgp",
        scene_id,
        pictures,
        front,
        metric="the poses, metres",
        up=np.array([0.0, 0.0, 1.0]),
        points=points,
        ego=ego,
        mounts=mounts,
        tracks=tracks,
        notes=tuple(notes),
    )


def _pose(pose: Mapping[str, Any]) -> F64:
    t, q = pose["translation"], pose["rotation"]
    quat = np.array([q["qw"], q["qx"], q["qy"], q["qz"]], dtype=np.float64)
    if not np.isfinite(quat).all() or abs(np.linalg.norm(quat) - 1) > 1e-2:
        raise ValueError(f"a quaternion of length {np.linalg.norm(quat):.3g}")
    return se3(np.array([t["x"], t["y"], t["z"]], dtype=np.float64), quat / np.linalg.norm(quat))


def _time_us(datum: Mapping[str, Any]) -> int:
    moment = datetime.fromisoformat(
        str(datum["id"]["timestamp"]).replace("Z", "+00:00")
    ).astimezone(UTC)
    return round((moment - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() * 1e6)


def _calibration(
    folder: Path, document: Mapping[str, Any]
) -> tuple[dict[str, F64], dict[str, F64]]:
    """Return intrinsics and mounts of every camera by its name."""
    key = document["samples"][0]["calibration_key"]
    path = folder / "calibration" / f"{key}.json"
    found = read_json_object(path)
    lenses, mounts = {}, {}
    for name, K, T in zip(found["names"], found["intrinsics"], found["extrinsics"], strict=True):
        if K["fx"] > 0:  # the LiDAR has none
            lenses[name] = np.array(
                [[K["fx"], 0, K["cx"] + 0.5], [0, K["fy"], K["cy"] + 0.5], [0, 0, 1.0]]
            )
            mounts[name] = _pose(T)
    return lenses, mounts


def _pictures(
    folder: Path, scene: Path, data: Sequence[Mapping[str, Any]], name: str, K: F64
) -> list[Picture]:
    out = []
    for item in data:
        if item["id"]["name"] == name and "image" in item["datum"]:
            image = item["datum"]["image"]
            lens = Lens(int(image["width"]), int(image["height"]), K)
            where = f"{scene}, datum {item['key']}"
            out.append(
                Picture(
                    folder / image["filename"],
                    lens,
                    _pose(image["pose"]),
                    where,
                    _time_us(item),
                    name,
                    {},
                )
            )
    return sorted(out, key=lambda one: int(one.t_us or 0))


def _lidar(
    folder: Path,
    document: Mapping[str, Any],
    sweeps: Sequence[Mapping[str, Any]],
    pictures: Sequence[Picture],
) -> tuple[Points | None, tuple[Actor, ...], list[str]]:
    """Return the LiDAR's points without those on boxes, the boxes as tracks, and notes."""
    if not sweeps:
        return None, (), ["no LiDAR: points are triangulated, and there are no tracks"]
    names = _classes(folder, document)
    clouds: list[F64] = []
    seen: dict[str, list[tuple[int, F64, Box]]] = {}
    for sweep in sweeps:
        datum, t_us = sweep["datum"]["point_cloud"], _time_us(sweep)
        path, T = folder / datum["filename"], _pose(datum["pose"])
        local = _sweep(path)
        labels = datum["annotations"].get("1")
        for one in read_json_object(folder / labels)["annotations"] if labels else ():
            size = one["box"]
            body, T_box = Box(size["length"], size["width"], size["height"]), _pose(size["pose"])
            local = local[~_inside(transform_points(inverse(T_box), local), body)]
            if one["num_points"] >= FEWEST_POINTS:
                key = f"{names.get(one['class_id'], 'other')}-{one['instance_id']}"
                seen.setdefault(key, []).append((t_us, T @ T_box, body))
        clouds.append(transform_points(T, local))
    xyz = np.concatenate(clouds)
    actors = tuple(actor for key, rows in sorted(seen.items()) for actor in _actors(key, rows))
    covariance = np.tile(np.eye(3) * LIDAR_SPREAD_M**2, (len(xyz), 1, 1))
    rgb, coloured = _colours(xyz, pictures)
    points = Points(xyz, rgb, covariance).chosen(coloured)
    return (
        points,
        actors,
        [
            f"{len(points)} LiDAR points that a photograph shows; {len(xyz) - len(points)} others were left out"
        ],
    )


def _classes(folder: Path, document: Mapping[str, Any]) -> dict[int, str]:
    key = document["ontologies"].get("1")
    items = read_json_object(folder / "ontology" / f"{key}.json")["items"] if key else []
    return {int(item["id"]): LABELS.get(str(item["name"]), "other") for item in items}


def _sweep(path: Path) -> F64:
    """Return the points ``(N, 3)`` of a sweep within `NEAR_M`, sensor frame."""
    if path.suffix == ".npy":
        data = np.asarray(open_npy(path), dtype=np.float64)
    else:
        read_bytes(path)
        with np.load(path, allow_pickle=False) as file:
            data = np.asarray(file["data"], dtype=np.float64)
    xyz = data[:, :3]
    return np.asarray(xyz[np.isfinite(xyz).all(axis=1) & (np.linalg.norm(xyz, axis=1) < NEAR_M)])


def _inside(local: F64, box: Box) -> Bool:
    half = np.array([box.length_m, box.width_m, box.height_m]) / 2 + MARGIN_M
    return np.asarray(
        (np.abs(local) < half).all(axis=1) & (local[:, 2] > -box.height_m / 2 + MARGIN_M)
    )


def _actors(key: str, rows: Sequence[tuple[int, F64, Box]]) -> list[Actor]:
    """Return a labelled instance as one actor, or one a run where it was not seen for long."""
    rows = sorted(rows, key=lambda row: row[0])
    label, times = key.partition("-")[0], np.array([row[0] for row in rows])
    out = []
    for number, part in enumerate(split_at_gaps(times, MAX_GAP_US), start=1):
        track = trajectory_from_poses(times[part], np.array([row[1] for row in rows[part]]))
        name = key if number == 1 else f"{key}~{number}"
        out.append(
            Actor(name, label, rows[part][0][2], track, stands_still(track.t_us, track.xyz, label))
        )
    return out


def _colours(xyz: F64, pictures: Sequence[Picture]) -> tuple[F64, Bool]:
    """Return the colour of each point in the first photograph that shows it, and which points any
    shows; nothing hides a point.
    """
    rgb, found = np.full(xyz.shape, 0.5), np.zeros(len(xyz), dtype=bool)
    for picture in pictures:
        rest = np.nonzero(~found)[0]
        local = transform_points(inverse(picture.T_world_camera), xyz[rest])
        pixel = local @ picture.lens.straight_K().T
        at = pixel[:, :2] / np.where(local[:, 2:] > 0.5, local[:, 2:], np.inf)
        inside = (
            (local[:, 2] > 0.5)
            & (at > 0).all(axis=1)
            & (at < [picture.lens.width, picture.lens.height]).all(axis=1)
        )
        if inside.any():
            image, cells = picture.rgb(), at[inside].astype(np.int64)
            rgb[rest[inside]] = image[cells[:, 1], cells[:, 0]] / 255.0
            found[rest[inside]] = True
    return rgb, found
