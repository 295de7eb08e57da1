"""Imported drives: the folder that ``simrun import`` writes and reads again (docs/real-drives.md
says what stands in it).

Coordinates are metres in the scenario's world, rotations are matrices or ``wxyz``, cameras are
OpenCV's. Photographs are the frames of the folder's ``transforms.json``: pinhole pictures without
distortion, each with its time, camera and use.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NotRequired

import numpy as np
from typing_extensions import TypedDict

from alpasim_plugin.core.atomic import write_array, write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.reading import file_sha256
from alpasim_plugin.core.reading.arrays import open_npy
from alpasim_plugin.core.reading.files import as_shape
from alpasim_plugin.core.types import (
    F64,
    Actor,
    Box,
    CameraSpec,
    HeightField,
    Lane,
    LaneMap,
    Marking,
    Paint,
    Photograph,
    Trajectory,
    Vehicle,
)
from scenarios.recorded import RecordedLog, SourceFiles, checked_trajectory, stands_still

DRIVE_FILE = "drive.json"
TRANSFORMS_FILE = "transforms.json"
GROUND_FILE = "ground.npy"
MODEL_FOLDER = "model"
DO_THIS = "import the drive again: simrun import drive FOLDER -o OUT"
LINES: tuple[Literal["road_edges", "crosswalks", "stop_lines"], ...] = (
    "road_edges",
    "crosswalks",
    "stop_lines",
)
Numbers = list[float]
Rows = list[list[float]]


class _Poses(TypedDict):
    t_us: list[int]
    xyz: Rows
    quat: Rows


class _Camera(TypedDict):
    name: str
    width: int
    height: int
    K: Rows
    T_rig_camera: Rows


class _Lane(TypedDict):
    lane_id: str
    centre: Rows
    left: Rows | None
    right: Rows | None
    kind: str
    successors: list[str]
    left_neighbour: str | None
    right_neighbour: str | None
    left_paint: Paint
    right_paint: Paint
    is_intersection: bool
    speed_limit_mps: float | None


class _Marking(TypedDict):
    xyz: Rows
    paint: Paint


class _Map(TypedDict):
    lanes: list[_Lane]
    road_edges: list[Rows]
    crosswalks: list[Rows]
    stop_lines: list[Rows]
    markings: list[_Marking]


class _Track(TypedDict):
    id: str
    label: str
    size_m: Numbers
    poses: _Poses


class _Obstacle(TypedDict):
    id: str
    size_m: Numbers
    xyz: Numbers  # of the box's middle
    yaw_rad: float
    uncertainty_m: float


class _Grid(TypedDict):
    x0_m: float
    y0_m: float
    cell_m: float


class _Body(TypedDict):
    length_m: float
    width_m: float
    height_m: float
    rear_axle_to_centre_m: float


class DriveDocument(TypedDict):
    """What ``drive.json`` holds."""

    format: Literal["simrun drive"]
    version: Literal[1]
    scene_id: str
    ego: _Poses
    vehicle: NotRequired[_Body]
    cameras: list[_Camera]
    map: _Map
    ground: _Grid
    tracks: list[_Track]
    obstacles: list[_Obstacle] | None  # None: not looked for
    world_origin: Numbers
    notes: list[str]


class _Frame(TypedDict):
    file_path: str
    transform_matrix: Rows
    w: int
    h: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    t_us: int
    camera: str
    use: Literal["fitted", "held-out", "never-fitted"]
    exposure: NotRequired[Numbers]


class _Transforms(TypedDict):
    axes: Literal["opencv"]
    frames: list[_Frame]


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


def write_drive(
    folder: Path, log: RecordedLog, tracks: Sequence[Actor], obstacles: Sequence[Obstacle] | None
) -> None:
    """Write ``drive.json`` and ``ground.npy``; pictures and model are written by who makes them.

    Args:
        folder: Of the drive, which exists.
        log: Map, ground, ego, vehicle, cameras, origin and notes; its actors are not read.
        tracks: Recorded road users.
        obstacles: What stands in the model; None where it was not looked for.
    """
    write_array(folder / GROUND_FILE, log.ground.z)
    box = log.vehicle.box
    document = {
        "format": "simrun drive",
        "version": 1,
        "scene_id": log.scene_id,
        "ego": _poses(log.ego_log),
        "vehicle": {
            "length_m": box.length_m,
            "width_m": box.width_m,
            "height_m": box.height_m,
            "rear_axle_to_centre_m": log.vehicle.rear_axle_to_centre_m,
        },
        "cameras": [
            {
                "name": c.name,
                "width": c.width,
                "height": c.height,
                "K": c.K.tolist(),
                "T_rig_camera": c.T_rig_camera.tolist(),
            }
            for c in log.cameras
        ],
        "map": _map_document(log.lane_map),
        "ground": {"x0_m": log.ground.x0_m, "y0_m": log.ground.y0_m, "cell_m": log.ground.cell_m},
        "tracks": [
            {"id": a.actor_id, "label": a.label, "size_m": _size(a.box), "poses": _poses(a.track)}
            for a in tracks
        ],
        "obstacles": None
        if obstacles is None
        else [
            {
                "id": one.obstacle_id,
                "size_m": _size(one.box),
                "xyz": one.xyz.tolist(),
                "yaw_rad": one.yaw_rad,
                "uncertainty_m": one.uncertainty_m,
            }
            for one in obstacles
        ],
        "world_origin": list(log.world_origin),
        "notes": list(log.notes),
    }
    write_json(folder / DRIVE_FILE, document)


def read_drive(folder: Path) -> RecordedLog:
    """Read what ``simrun import`` has written, as a recorded log with its photographs and the
    folder of its model.

    Raises:
        InputError: A file is missing or damaged, or holds what no drive may hold; the message names
            it.
    """
    files = SourceFiles()
    path = folder / DRIVE_FILE
    document = as_shape(DriveDocument, files.read_json(path), path, DO_THIS)
    ego = document["ego"]
    log = checked_trajectory(
        path,
        np.array(ego["t_us"], np.int64),
        _rows(ego["xyz"]),
        _rows(ego["quat"], 4),
        least=2,
    )
    model = folder / MODEL_FOLDER
    _note_files(files, model)
    obstacles = [_obstacle_actor(one, log) for one in document["obstacles"] or ()]
    tracks = [_track_actor(files, path, track) for track in document["tracks"]]
    body = document.get("vehicle")
    return RecordedLog(
        scene_id=document["scene_id"],
        source="drive",
        lane_map=_map_of(document["map"]),
        ground=_ground_of(files, folder, document["ground"]),
        ego_log=log,
        vehicle=Vehicle(
            Box(body["length_m"], body["width_m"], body["height_m"]), body["rear_axle_to_centre_m"]
        )
        if body
        else Vehicle(),
        actors=(*tracks, *obstacles),
        cameras=tuple(
            CameraSpec(
                c["name"], c["width"], c["height"], _rows(c["K"]), _rows(c["T_rig_camera"], 4)
            )
            for c in document["cameras"]
        ),
        world_origin=(*document["world_origin"],),  # type: ignore[arg-type]  # three numbers
        content_hash=files.content_hash,
        notes=tuple(document["notes"]),
        recording=_recording(files, folder),
        model=str(model),
        standing="unknown" if document["obstacles"] is None else "found",
    )


def _poses(track: Trajectory) -> _Poses:
    return {"t_us": track.t_us.tolist(), "xyz": track.xyz.tolist(), "quat": track.quat.tolist()}


def _size(box: Box) -> Numbers:
    return [box.length_m, box.width_m, box.height_m]


def _rows(values: Any, width: int = 3) -> F64:
    """Return rows ``(N, width)``; rows of different lengths are an error of shape."""
    return np.array(values, dtype=np.float64).reshape(-1, width)


def _map_document(lane_map: LaneMap) -> JsonObject:
    return {
        "lanes": [
            {name: _plain(getattr(lane, name)) for name in _Lane.__annotations__}
            for lane in lane_map.lanes.values()
        ],
        **{name: [line.tolist() for line in getattr(lane_map, name)] for name in LINES},
        "markings": [{"xyz": m.xyz.tolist(), "paint": m.paint} for m in lane_map.markings],
    }


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


def _map_of(document: _Map) -> LaneMap:
    lanes = {}
    for lane in document["lanes"]:
        fields: JsonObject = {**lane, "successors": tuple(lane["successors"])}
        for name in ("centre", "left", "right"):
            fields[name] = None if fields[name] is None else _rows(fields[name])
        lanes[lane["lane_id"]] = Lane(**fields)
    lines: JsonObject = {name: tuple(map(_rows, document[name])) for name in LINES}
    markings = tuple(Marking(_rows(one["xyz"]), one["paint"]) for one in document["markings"])
    return LaneMap(lanes, **lines, markings=markings)


def _ground_of(files: SourceFiles, folder: Path, grid: _Grid) -> HeightField:
    path = folder / GROUND_FILE
    files.note_bytes(GROUND_FILE, files.read_bytes(path))
    z = np.asarray(open_npy(path, DO_THIS))
    if z.ndim != 2 or min(z.shape) < 2:
        raise InputError(f"{path}: heights of shape {z.shape}", DO_THIS)
    return HeightField(grid["x0_m"], grid["y0_m"], grid["cell_m"], np.array(z, dtype=np.float64))


def _track_actor(files: SourceFiles, path: Path, track: _Track) -> Actor:
    poses, where = track["poses"], f"{path}, track {track['id']}"
    one = checked_trajectory(
        where,
        np.array(poses["t_us"], np.int64),
        _rows(poses["xyz"]),
        _rows(poses["quat"], 4),
    )
    return Actor(
        track["id"],
        track["label"],
        Box(*track["size_m"]),
        one,
        stands_still(one.t_us, one.xyz, track["label"]),
    )


def _obstacle_actor(one: _Obstacle, ego: Trajectory) -> Actor:
    """Return an obstacle as an actor that stands for the whole drive."""
    half = one["yaw_rad"] / 2
    ends = np.array([ego.t_us[0], ego.t_us[-1]])
    quat = np.tile([np.cos(half), 0.0, 0.0, np.sin(half)], (2, 1))
    return Actor(
        one["id"],
        "other",
        Box(*one["size_m"]),
        Trajectory(ends, np.tile(_rows(one["xyz"]), (2, 1)), quat),
        is_static=True,
    )


def _recording(files: SourceFiles, folder: Path) -> tuple[Photograph, ...]:
    path = folder / TRANSFORMS_FILE
    frames = as_shape(_Transforms, files.read_json(path), path, DO_THIS)["frames"]
    return tuple(_photograph(folder, frame) for frame in frames)


def _photograph(folder: Path, frame: _Frame) -> Photograph:
    K = np.array(
        [[frame["fl_x"], 0.0, frame["cx"]], [0.0, frame["fl_y"], frame["cy"]], [0.0, 0.0, 1.0]]
    )
    one = Photograph(
        frame["t_us"],
        frame["camera"],
        frame["w"],
        frame["h"],
        K,
        _rows(frame["transform_matrix"], 4),
        str(folder / frame["file_path"]),
        frame["use"],
    )
    gains = frame.get("exposure")
    return one if gains is None else replace(one, exposure=(gains[0], gains[1], gains[2]))


def _note_files(files: SourceFiles, model: Path) -> None:
    """Enter the files of the model into the content, each by its digest: they are large."""
    found = (
        sorted(path for path in model.rglob("*") if os.path.isfile(path))
        if os.path.isdir(model)
        else []
    )
    if not found:
        raise InputError(
            f"{model}: no model: the import was not finished",
            "give the same import command again; it goes on where it stopped",
        )
    for path in found:
        files.note_bytes(path.relative_to(model).as_posix(), bytes.fromhex(file_sha256(path)))
