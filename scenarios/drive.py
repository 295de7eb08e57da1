"""Imported drives: the folder that ``simrun import`` writes and reads again (docs/real-drives.md
says what stands in it).

Coordinates are metres in the scenario's world, rotations are matrices or ``wxyz``, cameras are
OpenCV's. Photographs are the frames of the folder's ``transforms.json``: pinhole images without
distortion, each with its time, camera and use.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256, parsing
from alpasim_plugin.core.files.arrays import open_npy
from alpasim_plugin.core.files.atomic import write_array, write_json
from alpasim_plugin.core.geometry import intrinsics, quat_from_yaw
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import (
    F64,
    Actor,
    Box,
    CameraSpec,
    HeightField,
    Lane,
    LaneMap,
    Marking,
    Photograph,
    Signal,
    Trajectory,
    Vehicle,
)
from scenarios.recorded import RecordedLog, SourceFiles, checked_trajectory

DRIVE_FILE = "drive.json"
TRANSFORMS_FILE = "transforms.json"
GROUND_FILE = "ground.npy"
MODEL_FOLDER = "model"
DO_THIS = "import the drive again: simrun import drive FOLDER -o OUT"
LINES = ("road_edges", "crosswalks", "stop_lines")
MORE_LINES = ("drivable_areas", "poles")  # that older imports left out, with all below
SIGNALS = ("signals", "give_way")


@dataclass(frozen=True)
class Obstacle:
    """Something that stands in the model and can be hit, as an upright box.

    Attributes:
        obstacle_id: Begins with `STANDING_ID`.
        box: Its full sizes, metres.
        xyz: ``(3,)`` the box's middle, metres, world.
        yaw_rad: Turned from east to the left.
        uncertainty_m: How far its sides may be from the body's.
    """

    obstacle_id: str
    box: Box
    xyz: F64
    yaw_rad: float
    uncertainty_m: float


def write_drive(folder: Path, log: RecordedLog, obstacles: Sequence[Obstacle]) -> None:
    """Write ``drive.json`` and ``ground.npy``; images and model are written by who makes them.

    Args:
        folder: Of the drive, which exists.
        log: Map, ground, ego, vehicle, actors, cameras, origin and notes.
        obstacles: What stands in the model.
    """
    write_array(folder / GROUND_FILE, log.ground.z)
    lane_map = log.lane_map
    document = {
        "format": "simrun drive",
        "version": 1,
        "scene_id": log.scene_id,
        "ego": _track(log.ego_log),
        "vehicle": {
            **vars(log.vehicle.box),
            "rear_axle_to_centre_m": log.vehicle.rear_axle_to_centre_m,
            "wheelbase_m": log.vehicle.wheelbase_m,
        },
        "actors": [
            {
                "id": actor.actor_id,
                "label": actor.label,
                "box": vars(actor.box),
                "track": _track(actor.track),
            }
            for actor in log.actors
        ],
        "cameras": [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "T_rig_camera": camera.T_rig_camera.tolist(),
            }
            for camera in log.cameras
        ],
        "map": _map_document(lane_map),
        "ground": {"x0_m": log.ground.x0_m, "y0_m": log.ground.y0_m, "cell_m": log.ground.cell_m},
        "obstacles": [
            {
                "id": obstacle.obstacle_id,
                "size_m": [obstacle.box.length_m, obstacle.box.width_m, obstacle.box.height_m],
                "xyz": obstacle.xyz.tolist(),
                "yaw_rad": obstacle.yaw_rad,
                "uncertainty_m": obstacle.uncertainty_m,
            }
            for obstacle in obstacles
        ],
        "world_origin": list(log.world_origin),
        "notes": list(log.notes),
    }
    write_json(folder / DRIVE_FILE, document)


def _map_document(lane_map: LaneMap) -> JsonObject:
    lines = {
        name: [line.tolist() for line in getattr(lane_map, name)] for name in (*LINES, *MORE_LINES)
    }
    signals: JsonObject = {}
    for name in SIGNALS:
        records = getattr(lane_map, name)
        signals[name] = None if records is None else [_record(record) for record in records]
    return {
        "lanes": [_record(lane) for lane in lane_map.lanes.values()],
        **lines,
        "markings": [_record(marking) for marking in lane_map.markings],
        "signs": [
            {"T_world_sign": pose.tolist(), "box": vars(box)} for pose, box in lane_map.signs
        ],
        **signals,
    }


def _record(element: Lane | Marking | Signal) -> JsonObject:
    return {name: _plain(value) for name, value in vars(element).items()}


def _track(track: Trajectory) -> JsonObject:
    return {name: values.tolist() for name, values in vars(track).items()}


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def read_drive(folder: Path) -> RecordedLog:
    """Read what ``simrun import`` has written, as a recorded log with its photographs and the
    folder of its model.

    Raises:
        InputError: A file is missing or damaged, or holds what no drive may hold; the message names
            it.
    """
    files = SourceFiles()
    path = folder / DRIVE_FILE
    model = folder / MODEL_FOLDER
    document = files.read_json(path)
    _note_files(files, model)
    with parsing(path, DO_THIS, "no drive of simrun"):
        if (document["format"], document["version"]) != ("simrun drive", 1):
            raise ValueError(f"version {document['version']!r}")
        log = _trajectory(path, document["ego"])
        body = document["vehicle"]
        size = body["length_m"], body["width_m"], body["height_m"]
        wheelbase_m = body.get("wheelbase_m", Vehicle.wheelbase_m)
        actors = [
            Actor(
                entry["id"], entry["label"], Box(**entry["box"]), _trajectory(path, entry["track"])
            )
            for entry in document.get("actors", [])
        ]
        cameras = [
            CameraSpec(
                entry["name"],
                entry["width"],
                entry["height"],
                _rows(entry["K"]),
                _rows(entry["T_rig_camera"], 4),
            )
            for entry in document["cameras"]
        ]
        x, y, z = document["world_origin"]
        return RecordedLog(
            scene_id=document["scene_id"],
            source="drive",
            lane_map=_map_of(document["map"]),
            ground=_ground_of(files, folder, document["ground"]),
            ego_log=log,
            vehicle=Vehicle(Box(*size), body["rear_axle_to_centre_m"], wheelbase_m),
            actors=(*actors, *(_obstacle_actor(entry, log) for entry in document["obstacles"])),
            cameras=tuple(cameras),
            world_origin=(x, y, z),
            content_hash=files.content_hash,
            notes=tuple(document["notes"]),
            recording=_recording(files, folder),
            model=str(model),
            standing="found",
        )


def _trajectory(path: Path, track: JsonObject) -> Trajectory:
    t_us = np.array(track["t_us"], dtype=np.int64)
    return checked_trajectory(path, t_us, _rows(track["xyz"]), _rows(track["quat"], 4), least=2)


def _rows(values: Any, width: int = 3) -> F64:
    """Return rows ``(N, width)``; rows of different lengths are an error of shape."""
    return np.array(values, dtype=np.float64).reshape(-1, width)


def _map_of(document: JsonObject) -> LaneMap:
    lanes = {}
    for fields in document["lanes"]:
        edges = {name: _rows(fields[name]) for name in ("centre", "left", "right")}
        lane = Lane(**{**fields, **edges, "successors": tuple(fields["successors"])})
        lanes[lane.lane_id] = lane
    lines: dict[str, Any] = {name: tuple(map(_rows, document[name])) for name in LINES}
    lines |= {name: tuple(map(_rows, document.get(name, ()))) for name in MORE_LINES}
    signals = document.get("signals")
    return LaneMap(
        lanes,
        markings=tuple(
            Marking(_rows(entry["xyz"]), entry["mark_type"])
            for entry in document.get("markings", ())
        ),
        signs=tuple(
            (_rows(entry["T_world_sign"], 4), Box(**entry["box"]))
            for entry in document.get("signs", ())
        ),
        signals=None if signals is None else tuple(map(_signal, signals)),
        give_way=tuple(map(_signal, document.get("give_way", ()))),
        **lines,
    )


def _signal(fields: JsonObject) -> Signal:
    head = fields["head"]
    phases = tuple((colour, lasts_us) for colour, lasts_us in fields["phases"])
    return Signal(
        **{
            **fields,
            "stop": _rows(fields["stop"]),
            "phases": phases,
            "lanes": tuple(fields["lanes"]),
            "yields_to": tuple(fields.get("yields_to", ())),
            "yields_to_waiting": tuple(fields.get("yields_to_waiting", ())),
            "head": None if head is None else np.array(head, dtype=np.float64),
        }
    )


def _ground_of(files: SourceFiles, folder: Path, grid: JsonObject) -> HeightField:
    path = folder / GROUND_FILE
    files.note_bytes(GROUND_FILE, files.read_bytes(path))
    z = np.array(open_npy(path, DO_THIS), dtype=np.float64)
    if z.ndim != 2 or min(z.shape) < 2:
        raise InputError(f"{path}: heights of shape {z.shape}", DO_THIS)
    return HeightField(grid["x0_m"], grid["y0_m"], grid["cell_m"], z)


def _obstacle_actor(entry: JsonObject, ego: Trajectory) -> Actor:
    """Return an obstacle as an actor that stands for the whole drive."""
    xyz = np.tile(_rows(entry["xyz"]), (2, 1))
    quat = quat_from_yaw([entry["yaw_rad"]] * 2)
    track = Trajectory(ego.t_us[[0, -1]], xyz, quat)
    return Actor(entry["id"], "other", Box(*entry["size_m"]), track, is_static=True)


def _recording(files: SourceFiles, folder: Path) -> tuple[Photograph, ...]:
    path = folder / TRANSFORMS_FILE
    document = files.read_json(path)
    with parsing(path, DO_THIS):
        return tuple(_photograph(folder, frame) for frame in document["frames"])


def _photograph(folder: Path, frame: JsonObject) -> Photograph:
    K = intrinsics(*(frame[name] for name in ("fl_x", "fl_y", "cx", "cy")))
    return Photograph(
        frame["t_us"],
        frame["camera"],
        frame["w"],
        frame["h"],
        np.array(K),
        _rows(frame["transform_matrix"], 4),
        str(folder / frame["file_path"]),
        frame["use"],
        tuple(frame.get("exposure", (1.0, 1.0, 1.0))),  # three gains
    )


def _note_files(files: SourceFiles, model: Path) -> None:
    """Enter the files of the model into the content, each by its digest: they are large."""
    paths = (
        sorted(path for path in model.rglob("*") if os.path.isfile(path))
        if os.path.isdir(model)
        else []
    )
    if not paths:
        raise InputError(
            f"{model}: no model: the import was not finished",
            "give the same import command again; it goes on where it stopped",
        )
    for path in paths:
        files.note_bytes(path.relative_to(model).as_posix(), bytes.fromhex(file_sha256(path)))
