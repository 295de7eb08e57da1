"""Logs that py123d has converted: nuScenes, nuPlan, Waymo, PandaSet, KITTI-360 and others.

A log is a folder with one Arrow IPC file a modality, named by its key; its columns begin with that
key, and its schema's ``metadata`` is a msgpack document. Poses are x, y, z and ``wxyz``; boxes add
length, width and height. An image is a JPEG or PNG, the path of one, or the number of a frame of
the film beside the file. Read are the ego's poses, pinhole cameras and boxes of road users.

Source: the writers of py123d 0.7.0 (github.com/kesai-labs/py123d).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import msgpack
import numpy as np
import pyarrow as pa

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import check_regular, parsing
from alpasim_plugin.core.files.arrow import read_arrow
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.files.limits import ARCHIVE_BYTES, BODY_M
from alpasim_plugin.core.geometry import interpolate, intrinsics, inverse, se3
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import F64, Actor, Box, Trajectory, Vehicle
from alpasim_plugin.drives.source import PHOTOGRAPHS, SourceDrive, front_camera
from alpasim_plugin.gaussians.fit.lens import FROM_CORNER, Lens
from alpasim_plugin.gaussians.fit.photographs import PosedPhotograph, rigid_pose
from scenarios.recorded import actors_of_track, checked_trajectory

_Member = TypeVar("_Member")
UNIT = 0.01  # how far from 1 the length of a quaternion may be
SYNC_FILE = "sync.arrow"
EGO = "ego_state_se3"
BOXES = "box_detections_se3"
CAMERA = "camera."
DO_THIS = "convert the log again with py123d 0.1 or later"
FRONT = ("pcam_f0", "pcam_stereo_l")  # the first that is there is driven by
SPARE = "pcam_stereo_r"  # shows what the left one shows: kept for measuring
LABELS = {
    "b": "bus",
    "c": "car",
    "m": "motorcycle",
    "o": "other",
    "p": "pedestrian",
    "t": "truck",
    "y": "cyclist",
}
EGO_BOX = "e"  # the letter of the ego's own box, which is no other road user
# The labels of each data set's classes, in the order of their numbers.
CLASSES = {
    "AV2SensorBoxDetectionLabel": "obyyotboootoommppocboopotttpyy",
    "DefaultBoxDetectionLabel": "ecoypooooooo",
    "GriffinBoxDetectionLabel": "pctbmy",
    "KITTI360BoxDetectionLabel": "yobctompoyooootooto",
    "NuPlanBoxDetectionLabel": "cypoooo",
    "NuScenesBoxDetectionLabel": "ctbbttctympppppppoooooo",
    "NureasoningBoxDetectionLabel": "cypooootbmypo",
    "PandasetBoxDetectionLabel": "ooybcoottmmtycpppcoootooooo",
    "PhysicalAIAVBoxDetectionLabel": "cpbtcoyptoob",
    "WODMotionBoxDetectionLabel": "ocpyo",
    "WODPerceptionBoxDetectionLabel": "ocpoy",
}


PY123D = Fields(
    "py123d",
    read={
        "log": "sync ego_state_se3 box_detections_se3 camera",
        "sync": "@log_name",
        "ego_state_se3": """timestamp_us imu_se3 @length @width @height @wheel_base
            @rear_axle_to_imu_se3 @center_to_imu_se3""",
        "box_detections_se3": """timestamp_us bounding_box_se3 track_token label
            @box_detection_label_class""",
        "camera": """timestamp_us data camera_to_global_se3 @camera_model @intrinsics @distortion
            @width @height @camera_to_imu_se3 @is_undistorted""",
    },
    # Speeds follow from poses; the synchronisation table numbers the rows of the other files.
    harmless={
        "sync": "@dataset @split @location @version @map_metadata",
        "ego_state_se3": "@vehicle_name dynamic_state_se3",
        "box_detections_se3": "velocity_3d num_lidar_points",
        "camera": "@camera_name @camera_id",
    },
)


def read_py123d(folder: Path) -> SourceDrive:
    """Read a log: the front camera is driven by, all pinhole cameras are fitted.

    Raises:
        InputError: A file is missing, damaged or of another schema, or a pose is no rigid motion;
            the message names it.
    """
    log, _ = _modality(folder, "sync", ())
    with parsing(folder / SYNC_FILE, DO_THIS):
        scene_id = str(log["log_name"])
    ego, vehicle, T_imu_axle = _ego(folder)
    notes: list[str] = []
    keys = sorted(path.stem for path in folder.glob("*.arrow"))
    cameras = _cameras(folder, keys, ego, notes)
    front = next((name for name in FRONT if name in cameras), front_camera(cameras))
    last_us = int(cameras[front][: int(PHOTOGRAPHS.high)][-1].t_us or 0)
    photographs = [shot for shots in cameras.values() for shot in shots]
    chosen = tuple(shot for shot in photographs if int(shot.t_us or 0) <= last_us)
    if len(chosen) < len(photographs):
        notes.append(
            f"{len(photographs) - len(chosen)} photographs after the last that is read of {front} left out"
        )
    actors = _actors(folder, notes) if BOXES in keys else ()
    notes += PY123D.notes(_met(folder, keys))
    with parsing(folder / f"{CAMERA}{front}.arrow", DO_THIS):
        T_front = _T(_modality(folder, CAMERA + front, ())[0]["camera_to_imu_se3"])
    ahead_m, left_m = (inverse(T_imu_axle) @ T_front)[:2, 3].tolist()
    return SourceDrive(
        "py123d",
        scene_id,
        chosen,
        front,
        tuple({SPARE} & set(cameras) - {front}),
        metric="the poses, metres",
        notes=tuple(notes),
        actors=actors,
        vehicle=vehicle,
        front_xy_m=(ahead_m, left_m),
    )


def _cameras(
    folder: Path, keys: Sequence[str], ego: Trajectory, notes: list[str]
) -> dict[str, list[PosedPhotograph]]:
    """Return the photographs of the pinhole cameras among the files ``keys``, by name.

    Raises:
        InputError: There are none.
    """
    cameras = {}
    for key in keys:
        photographs = _camera(folder, key, ego, notes) if key.startswith(CAMERA) else []
        if photographs:
            cameras[key.removeprefix(CAMERA)] = photographs
    if not cameras:
        raise InputError(f"{folder}: no pinhole camera with images", DO_THIS)
    return cameras


def _ego(folder: Path) -> tuple[Trajectory, Vehicle, F64]:
    """Return the poses of the ego's IMU, its body, and where its rear axle is, ``T_imu_axle``."""
    body, (times, poses) = _modality(folder, EGO, ("timestamp_us", "imu_se3"))
    location = folder / f"{EGO}.arrow"
    with parsing(location, DO_THIS):
        if times.null_count:
            raise ValueError("a row without a time")
        table = np.array(poses.to_pylist(), dtype=np.float64).reshape(-1, 7)
        ego = checked_trajectory(location, times.to_numpy(), table[:, :3], table[:, 3:], least=2)
        for name in ("length", "width", "height", "wheel_base"):
            BODY_M.check(body[name], f"{location}: {name}")
        T_imu_axle = _T(body["rear_axle_to_imu_se3"])
        T_imu_centre = _T(body["center_to_imu_se3"])
        vehicle = Vehicle(
            Box(body["length"], body["width"], body["height"]),
            float(T_imu_centre[0, 3] - T_imu_axle[0, 3]),
            body["wheel_base"],
        )
    return ego, vehicle, T_imu_axle


def _modality(
    folder: Path, key: str, columns: Sequence[str]
) -> tuple[JsonObject, list[pa.ChunkedArray]]:
    """Return the metadata of a file and columns of it, which stay on the disk until they are used."""
    path = folder / f"{key}.arrow"
    check_regular(path, ARCHIVE_BYTES, DO_THIS)
    with parsing(path, DO_THIS, "no Arrow file of py123d"):
        table = read_arrow(pa.memory_map(str(path)).read_buffer(), path)
        facts = msgpack.unpackb((table.schema.metadata or {})[b"metadata"], strict_map_key=False)
        return facts, [table.column(f"{key}.{name}") for name in columns]


def _met(folder: Path, keys: Sequence[str]) -> Iterator[str]:
    """Yield the names of the fields of a log: its files, and the columns and metadata of those that
    are read; the columns of ``sync`` are numbers of rows of other files.
    """
    for key in keys:
        holder = "camera" if key.startswith(CAMERA) else key
        yield field_name("log", holder)
        if field_name("log", holder) not in PY123D.names():
            continue
        path = folder / f"{key}.arrow"
        check_regular(path, ARCHIVE_BYTES, DO_THIS)
        with parsing(path, DO_THIS, "no Arrow file of py123d"):
            schema = pa.ipc.open_file(pa.memory_map(str(path))).schema
            facts = msgpack.unpackb((schema.metadata or {})[b"metadata"], strict_map_key=False)
        yield from (field_name(holder, f"@{name}") for name in facts)
        if key != "sync":
            yield from (field_name(holder, name.removeprefix(f"{key}.")) for name in schema.names)


def _T(pose: Sequence[float]) -> F64:
    """Return the transform ``(4, 4)`` of x, y, z and ``wxyz``.

    Raises:
        ValueError: It is no rigid motion.
    """
    is_unit = abs(np.linalg.norm(pose[3:7]) - 1) < UNIT
    if not is_unit or not np.isfinite(pose).all():
        raise ValueError(f"the pose {list(pose)} is no rigid motion")
    return se3(pose[:3], pose[3:7])


def _numbered(members: Sequence[_Member], number: int, noun: str) -> _Member:
    """Return the member of a number that a log states."""
    if not 0 <= number < len(members):
        raise ValueError(f"{noun} {number} of {len(members)}")
    return members[number]


def _camera(folder: Path, key: str, ego: Trajectory, notes: list[str]) -> list[PosedPhotograph]:
    """Return the photographs of a camera in order of time; none of a camera that is no pinhole."""
    path = folder / f"{key}.arrow"
    name = key.removeprefix(CAMERA)
    columns = ("timestamp_us", "data", "camera_to_global_se3")
    facts, (times, data, stated) = _modality(folder, key, columns)
    with parsing(path, DO_THIS):
        if facts["camera_model"] != "pinhole":
            notes.append(f"camera {name} left out: its lens is {facts['camera_model']}")
            return []
        lens = _lens(facts, path)
        t_us = times.to_numpy()
        if not (np.diff(t_us) > 0).all():
            raise ValueError("times that do not increase")
        of_ego = interpolate(ego, t_us.clip(ego.t_us[0], ego.t_us[-1]))
        poses = of_ego @ _T(facts["camera_to_imu_se3"])
        has_ego = (t_us >= ego.t_us[0]) & (t_us <= ego.t_us[-1])
        images = _images(path, data)
        photographs = []
        unposed = 0
        for i, (image, pose) in enumerate(zip(images, stated.to_pylist(), strict=True)):
            if pose is None and not has_ego[i]:
                unposed += 1
                continue
            location = f"{path}, row {i}"
            T = rigid_pose((poses[i] if pose is None else _T(pose)).tolist(), location)
            photographs.append(
                PosedPhotograph(image.file, lens, T, location, int(t_us[i]), name, {}, image.data)
            )
    if unposed:
        notes.append(f"{name}: {unposed} photographs before or after the ego's poses left out")
    return photographs


def _lens(facts: JsonObject, path: Path) -> Lens:
    fx, fy, cx, cy, skew = facts["intrinsics"]
    if skew:
        raise ValueError(f"a lens with skew {skew:g}")
    K = intrinsics(fx, fy, cx, cy) + FROM_CORNER
    bends = None if facts["is_undistorted"] else facts["distortion"]
    distortion = np.array(bends or [0.0] * 5)
    return Lens(facts["width"], facts["height"], K, distortion).check(str(path), DO_THIS)


@dataclass(frozen=True)
class _StoredImage:
    """Where an image is stored: in a file of its own, or as encoded bytes."""

    file: Path
    data: memoryview | None = None


def _images(path: Path, column: pa.ChunkedArray) -> Iterator[_StoredImage]:
    """Yield the images of a camera: paths in the log, frames of its film, or encoded bytes.

    Raises:
        ValueError: They are stored in another way, a path leads out of the log, or the film has no
            such frame.
    """
    is_film = pa.types.is_integer(column.type)
    is_path = pa.types.is_string(column.type)
    if not is_film and not is_path and not pa.types.is_binary(column.type):
        raise ValueError(f"images of the type {column.type}")
    film = _film(path.with_suffix(".mp4")) if is_film else []
    for i, value in enumerate(column):
        if is_film:
            yield _StoredImage(path, memoryview(_numbered(film, value.as_py(), "frame")))
        elif is_path:
            name_in_log = Path(value.as_py())
            if name_in_log.is_absolute() or ".." in name_in_log.parts:
                raise ValueError(f"row {i}: the path {name_in_log} leads out of the log")
            yield _StoredImage(path.parent / name_in_log)
        else:
            yield _StoredImage(path, memoryview(value.as_buffer()))


def _film(path: Path) -> list[bytes]:
    """Return the frames of a film as JPEG."""
    check_regular(path, ARCHIVE_BYTES, DO_THIS)
    frames: list[bytes] = []
    film = cv2.VideoCapture(str(path))
    while True:
        is_read, image = film.read()
        if not is_read:
            return frames
        frames.append(cv2.imencode(".jpg", image)[1].tobytes())


def _actors(folder: Path, notes: list[str]) -> tuple[Actor, ...]:
    """Return the road users that move; what stands is found in the reconstruction."""
    names = ("timestamp_us", "bounding_box_se3", "track_token", "label")
    facts, columns = _modality(folder, BOXES, names)
    path = folder / f"{BOXES}.arrow"
    tracks: dict[str, list[list[float]]] = {}
    with parsing(path, DO_THIS):
        kind = str(facts["box_detection_label_class"]).rpartition(".")[2]
        for t_us, boxes, tokens, labels in zip(
            *(column.to_pylist() for column in columns), strict=True
        ):
            for box, token, label in zip(boxes, tokens, labels, strict=True):
                tracks.setdefault(str(token), []).append([t_us, *box, label])
        if kind not in CLASSES:
            notes.append(f"road users of the unknown classes {kind} are labelled 'other'")
        actors: list[Actor] = []
        for token in sorted(tracks):
            table = np.array(tracks[token], dtype=np.float64).reshape(-1, 12)
            number = int(table[0, 11])
            letter = _numbered(CLASSES[kind], number, "label") if kind in CLASSES else "o"
            if letter == EGO_BOX:
                notes.append(f"boxes of the ego itself, track {token}, are left out")
                continue
            times = table[:, 0].astype(np.int64)
            location = f"{path}, track {token}"
            track = checked_trajectory(location, times, table[:, 1:4], table[:, 4:8])
            length_m, width_m, height_m = np.median(table[:, 8:11], axis=0).tolist()
            for side_m in (length_m, width_m, height_m):
                BODY_M.check(side_m, location)
            box = Box(length_m, width_m, height_m)
            actors += actors_of_track(token, LABELS[letter], box, track)
    moving = tuple(actor for actor in actors if not actor.is_static and len(actor.track) > 1)
    notes.append(
        f"{len(moving)} road users move; boxes of {len(actors) - len(moving)} are not used"
    )
    return moving
