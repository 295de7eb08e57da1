"""The street as a log of py123d: its files, columns and metadata as its writers make them."""

from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import pyarrow as pa

from alpasim_plugin.core.geometry import inverse, quat_from_matrix
from tests.drives.street import COUNT, HEIGHT, WIDTH, K, Street, stations

START_US = 1_600_000_000_000_000
ORIGIN = np.array([664_000.0, 3_997_000.0, 600.0])  # of a UTM zone
T_IMU_CAMERA = np.eye(4)
T_IMU_CAMERA[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
T_IMU_CAMERA[:3, 3] = 1.2, 0.1, 1.5
TYPES = {
    "jpeg_binary": pa.binary(),
    "png_binary": pa.binary(),
    "path": pa.string(),
    "mp4": pa.int32(),
}
POSE = pa.list_(pa.float64(), 7)


def write_modality(
    folder: Path, key: str, facts: Any, columns: dict[str, tuple[pa.DataType, list[Any]]]
) -> None:
    """Write one file; the schema carries its metadata."""
    schema = pa.schema([(f"{key}.{name}", kind) for name, (kind, _) in columns.items()])
    schema = schema.with_metadata({b"metadata": msgpack.packb(facts)})
    arrays = [pa.array(values, kind) for kind, values in columns.values()]
    with pa.ipc.new_file(str(folder / f"{key}.arrow"), schema) as file:
        file.write_table(pa.Table.from_arrays(arrays, schema=schema))


def write_py123d(
    folder: Path,
    codec: str = "jpeg_binary",
    implicit_poses: bool = False,
    label: int = 0,
    first_frame: int = 0,
    classes: str = "NuScenes",
) -> Path:
    """Write the street with a car that drives ahead at 5 m/s and one that stands.

    Args:
        folder: Of the log.
        codec: How images are kept.
        implicit_poses: Leave the cameras' poses to those of the ego.
        label: Number of the moving car's class.
        first_frame: Of the film, by the log's numbers.
        classes: Data set whose classes the numbers are.
    """
    (folder / "samples").mkdir(parents=True)
    street = Street()
    times = [START_US + 100_000 * i for i in range(COUNT)]
    cameras = [street.pose(x) for x in stations()]
    images = [street.photograph(T) for T in cameras]
    endings = {"png_binary": ".png", "path": ".png"}
    data: list[Any] = [
        cv2.imencode(endings.get(codec, ".jpg"), one, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        for one in images
    ]
    if codec == "path":
        names = [f"samples/{i:03d}.png" for i in range(COUNT)]
        for name, image in zip(names, data, strict=True):
            (folder / name).write_bytes(image)
        data = names
    if codec == "mp4":
        film = cv2.VideoWriter(
            str(folder / "camera.pcam_f0.mp4"),
            cv2.VideoWriter_fourcc(*"mp4v"),
            30.0,
            (WIDTH, HEIGHT),
        )
        for image in images:
            film.write(image)
        film.release()
        data = [first_frame + i for i in range(COUNT)]
    write_modality(folder, "sync", {"log_name": "street-1"}, {"timestamp_us": (pa.int64(), times)})
    body = {"length": 5.0, "width": 2.0, "height": 1.7, "wheel_base": 3.0}
    mounts = {
        "rear_axle_to_imu_se3": _pose(np.eye(4)),
        "center_to_imu_se3": [1.5, 0, 0.5, 1, 0, 0, 0],
    }
    egos = [_placed(T @ inverse(T_IMU_CAMERA)) for T in cameras]
    write_modality(
        folder,
        "ego_state_se3",
        body | mounts,
        {"timestamp_us": (pa.int64(), times), "imu_se3": (POSE, egos)},
    )
    facts = {
        "camera_model": "pinhole",
        "intrinsics": [K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5, 0.0],
        "distortion": [0.0] * 5,
        "width": WIDTH,
        "height": HEIGHT,
        "camera_to_imu_se3": _pose(T_IMU_CAMERA),
        "is_undistorted": False,
    }
    poses = [None if implicit_poses else _placed(T) for T in cameras]
    columns = {
        "timestamp_us": (pa.int64(), times),
        "data": (TYPES[codec], data),
        "camera_to_global_se3": (POSE, poses),
    }
    write_modality(folder, "camera.pcam_f0", facts, columns)
    boxes = []
    for i, x in enumerate(stations()):
        mover = np.eye(4)
        mover[:3, 3] = 8.0 + 0.5 * i, 0.0, 0.75 + float(street.ground(np.array(8.0 + x)))
        parked = np.eye(4)
        parked[:3, 3] = 16.0, 2.9, 1.0
        boxes.append([[*_placed(T), 4.0, 1.8, 1.5] for T in (mover, parked)])
    write_modality(
        folder,
        "box_detections_se3",
        {"box_detection_label_class": f"py123d.parser.registry.{classes}BoxDetectionLabel"},
        {
            "timestamp_us": (pa.int64(), times),
            "bounding_box_se3": (pa.list_(pa.list_(pa.float64(), 10)), boxes),
            "track_token": (pa.list_(pa.string()), [["a1", "b2"]] * COUNT),
            "label": (pa.list_(pa.uint16()), [[label, 1]] * COUNT),
        },
    )
    write_modality(folder, "lidar.lidar_top", {}, {"timestamp_us": (pa.int64(), times)})
    return folder


def _pose(T: np.ndarray) -> list[float]:
    return [*T[:3, 3].tolist(), *quat_from_matrix(T[:3, :3]).tolist()]


def _placed(T: np.ndarray) -> list[float]:
    moved = T.copy()
    moved[:3, 3] += ORIGIN
    return _pose(moved)
