"""Argoverse 2 sensor logs: HD map, ego poses, tracked actors, calibration.

Formats and facts: the Argoverse 2 sensor data set (Wilson et al. 2021) and its public
documentation. The data are licensed CC BY-NC-SA 4.0 and do not ship with this package.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, real
from alpasim_plugin.core.files.arrays import parse_npy
from alpasim_plugin.core.files.fields import Fields, met_in
from alpasim_plugin.core.files.tables import Kind
from alpasim_plugin.core.geometry import (
    centre_line,
    intrinsics,
    matrix_from_quat,
    quat_from_matrix,
    se3,
)
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    Box,
    CameraSpec,
    HeightField,
    Lane,
    LaneMap,
    LaneMarkType,
    LensModel,
    Vehicle,
)
from alpasim_plugin.world.ground import from_points
from scenarios.map_borders import lane_edges, surface_borders
from scenarios.map_lines import same_way
from scenarios.recorded import RecordedLog, SourceFiles, actors_of_track, checked_trajectory, near

# Argoverse 2 mark types -> the markings a scene can show. Mixed lines take their solid half; double
# white is drawn as one line.
MARK_TYPES: dict[str, LaneMarkType] = {
    "NONE": "none",
    "UNKNOWN": "unknown",
    "SOLID_WHITE": "solid_white",
    "DASHED_WHITE": "dashed_white",
    "DOUBLE_SOLID_WHITE": "solid_white",
    "DOUBLE_DASH_WHITE": "dashed_white",
    "DASH_SOLID_WHITE": "solid_white",
    "SOLID_DASH_WHITE": "solid_white",
    "SOLID_YELLOW": "solid_yellow",
    "DASHED_YELLOW": "dashed_yellow",
    "DOUBLE_SOLID_YELLOW": "double_yellow",
    "DOUBLE_DASH_YELLOW": "double_yellow",
    "DASH_SOLID_YELLOW": "double_yellow",
    "SOLID_DASH_YELLOW": "double_yellow",
    "SOLID_BLUE": "unknown",
}
KINDS = {"VEHICLE": "vehicle", "BIKE": "bike", "BUS": "bus"}
# 0.3 m pixels are averaged in blocks: float16 heights near 64 m come in steps of 0.03 to 0.06 m
RASTER_BLOCK = 5
GROUND_CELL_M = 1.5

EGO_CATEGORY = "EGO_VEHICLE"
NOBODY = "no annotations of other road users, as in the test split: the ego drives alone"
# Ford Fusion Hybrid of the recording fleet; size as annotated in logs that carry EGO_VEHICLE rows.
VEHICLE = Vehicle(box=Box(4.877, 2.0, 1.473), rear_axle_to_centre_m=1.422, wheelbase_m=2.85)
# The recorded frame sits in the rear axle, one wheel radius above the road: measured against the
# ground rasters of three logs the median height is 0.324, 0.324 and 0.321 m.
WHEEL_RADIUS_M = 0.33
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_NUMBERS: dict[str, Kind] = dict.fromkeys(POSE, "number")
_CATEGORIES = {
    "car": "REGULAR_VEHICLE",
    "truck": "LARGE_VEHICLE BOX_TRUCK TRUCK TRUCK_CAB VEHICULAR_TRAILER",
    "bus": "BUS ARTICULATED_BUS SCHOOL_BUS",
    "pedestrian": "PEDESTRIAN OFFICIAL_SIGNALER WHEELCHAIR",
    "cyclist": "BICYCLE BICYCLIST WHEELED_RIDER",
    "motorcycle": "MOTORCYCLE MOTORCYCLIST",
    "other": "RAILED_VEHICLE ANIMAL DOG STROLLER WHEELED_DEVICE MESSAGE_BOARD_TRAILER TRAFFIC_LIGHT_TRAILER BOLLARD "
    "CONSTRUCTION_BARREL CONSTRUCTION_CONE MOBILE_PEDESTRIAN_CROSSING_SIGN SIGN STOP_SIGN",
}
LABELS = {category: label for label, names in _CATEGORIES.items() for category in names.split()}
FIXED = frozenset(
    {
        "BOLLARD",
        "CONSTRUCTION_BARREL",
        "CONSTRUCTION_CONE",
        "MOBILE_PEDESTRIAN_CROSSING_SIGN",
        "SIGN",
        "STOP_SIGN",
    }
)


ARGOVERSE = Fields(
    "Argoverse 2",
    read={
        "log": "city_SE3_egovehicle.feather map annotations.feather calibration",
        "poses": f"timestamp_ns {' '.join(POSE)}",
        "annotations": f"""timestamp_ns track_uuid category length_m width_m height_m
            {" ".join(POSE)}""",
        "map": "lane_segments drivable_areas pedestrian_crossings",
        "lane_segment": """left_lane_boundary right_lane_boundary lane_type successors is_intersection
            left_neighbor_id right_neighbor_id left_lane_mark_type right_lane_mark_type""",
        "drivable_area": "area_boundary",
        "pedestrian_crossing": "edge1 edge2",
    },
    harmless={
        "log": "sensors",
        "annotations": "num_interior_pts",
        "lane_segment": "id predecessors",
        "drivable_area": "id",
        "pedestrian_crossing": "id",
    },
)


CALIBRATION = Fields(
    "Argoverse 2 calibration",
    read={
        "intrinsics": "sensor_name fx_px fy_px cx_px cy_px k1 k2 k3 height_px width_px",
        "mounts": f"sensor_name {' '.join(POSE)}",
    },
    harmless={},
    others="refused",
)


def read_map(files: SourceFiles, path: Path, origin: F64) -> tuple[LaneMap, tuple[str, ...]]:
    """Read ``log_map_archive_*.json`` into a lane map around ``origin (3,)``, with notes on what
    could not be kept.

    Raises:
        InputError: A layer or a lane's edge is missing, or a lane type is unknown to Argoverse 2.
    """
    document = files.read_json(path)
    with parsing(path, "use a log_map_archive file of the Argoverse 2 sensor set"):
        raw_lanes = document["lane_segments"]
        raw_areas = document["drivable_areas"]
        raw_crossings = document["pedestrian_crossings"]
        files.met += _fields_of(document)
        if not raw_lanes or not raw_areas:
            raise ValueError("a map without lanes or without drivable areas")
        raw_marks = [
            str(raw.get(f"{side}_lane_mark_type"))
            for raw in raw_lanes.values()
            for side in ("left", "right")
        ]
        lanes = {
            str(key): _lane(files, path, str(key), raw, origin) for key, raw in raw_lanes.items()
        }
        areas = tuple(
            _closed(_line(files, f"{path}, drivable area {key}", raw, "area_boundary", origin))
            for key, raw in raw_areas.items()
        )
        crossings = tuple(
            _crossing(files, f"{path}, crossing {key}", raw, origin)
            for key, raw in raw_crossings.items()
        )
        edges = surface_borders([shapely.Polygon(area[:, :2]) for area in areas], areas, areas)
    lane_map = LaneMap(
        {
            key: replace(
                lane,
                left_neighbour=same_way(lane, lanes, lane.left_neighbour),
                right_neighbour=same_way(lane, lanes, lane.right_neighbour),
            )
            for key, lane in lanes.items()
        },
        road_edges=edges,
        drivable_areas=areas,
        crosswalks=crossings,
    )
    notes = [
        "road edges are the border of the union of the drivable areas; where the map is cut off, its border is an edge too"
    ]
    strange = Counter(mark for mark in raw_marks if mark not in MARK_TYPES)
    notes += [
        f"{count} lane edges have the mark type {mark!r}: taken as unknown lane markings"
        for mark, count in sorted(strange.items())
    ]
    return lane_map, tuple(notes)


def _fields_of(document: JsonObject) -> list[str]:
    """Return the names of the fields of a map and of the things in it."""
    names = [*met_in("map", document)]
    for holder, layer in (
        ("lane_segment", "lane_segments"),
        ("drivable_area", "drivable_areas"),
        ("pedestrian_crossing", "pedestrian_crossings"),
    ):
        for thing in document[layer].values():
            names += met_in(holder, thing)
    return names


def _crossing(files: SourceFiles, location: str, raw: JsonObject, origin: F64) -> F64:
    """Return the outline ``(N, 3)`` of a pedestrian crossing between its two edges."""
    edges = [_line(files, location, raw, edge, origin) for edge in ("edge1", "edge2")]
    return _closed(np.concatenate([edges[0], edges[1][::-1]]))


def _lane(files: SourceFiles, path: Path, key: str, raw: JsonObject, origin: F64) -> Lane:
    location = f"{path}, lane {key}"
    left = _line(files, location, raw, "left_lane_boundary", origin)
    right = _line(files, location, raw, "right_lane_boundary", origin)
    return Lane(
        lane_id=key,
        centre=centre_line(left, right),
        left=left,
        right=right,
        kind=KINDS[raw["lane_type"]],
        successors=tuple(str(i) for i in raw.get("successors", ())),
        left_neighbour=str(raw.get("left_neighbor_id")),
        right_neighbour=str(raw.get("right_neighbor_id")),
        left_mark_type=MARK_TYPES.get(str(raw.get("left_lane_mark_type")), "unknown"),
        right_mark_type=MARK_TYPES.get(str(raw.get("right_lane_mark_type")), "unknown"),
        is_intersection=bool(raw.get("is_intersection")),
    )


def read_ground(
    files: SourceFiles, folder: Path, lane_map: LaneMap, wheels: F64, origin: F64
) -> HeightField:
    """Fit the ground to the log's own height raster, the lanes' edges and the wheels' path ``(N,
    3)``.

    The raster is averaged over blocks of 1.5 m; its holes are bridged by the fit. Edges and path
    carry centimetres where it matters.
    """
    description = "the ground height raster and its Sim2 transform"
    transform_path = files.only(folder, ("*___img_Sim2_city.json",), description)
    raster_path = files.only(folder, ("*_ground_height_surface____*.npy",), description)
    sim2 = files.read_json(transform_path)
    raster = parse_npy(files.read_bytes(raster_path), raster_path)
    with parsing(transform_path, "give the keys R, t and s, and a raster of 2-D floats"):
        if raster.ndim != 2 or raster.dtype.kind != "f":
            raise ValueError(f"a raster of {raster.dtype} {raster.shape}")
        heights, rows, columns = _block_means(raster.astype(np.float64), RASTER_BLOCK)
        # Pixel = s * (R city + t), so city = R^T (pixel / s - t); block centres lie at half-integer
        # pixels.
        pixel = np.stack([columns, rows], axis=1)
        city = (pixel / float(sim2["s"]) - np.array(sim2["t"], dtype=np.float64)) @ np.array(
            sim2["R"], dtype=np.float64
        ).reshape(2, 2)
    grid = near(raster_path, np.column_stack([city, heights]) - origin)
    return from_points(
        np.concatenate([grid, *lane_edges(lane_map.lanes), *lane_map.drivable_areas, wheels]),
        GROUND_CELL_M,
        wheels,
    )


def _block_means(raster: F64, block: int) -> tuple[F64, F64, F64]:
    """Return means of the finite pixels of square blocks that have any, and of their places in
    pixels: heights, rows, columns, each ``(B,)``.
    """
    ny, nx = raster.shape
    shape = -(-ny // block), block, -(-nx // block), block
    padded = np.full((shape[0] * block, shape[2] * block), np.nan)
    padded[:ny, :nx] = raster
    finite = np.isfinite(padded).reshape(shape)
    count = finite.sum(axis=(1, 3))
    row, column = np.indices(padded.shape, dtype=np.float64) + 0.5

    def mean(values: F64) -> F64:
        total = np.where(finite, values.reshape(shape), 0.0).sum(axis=(1, 3))
        return total[count > 0] / count[count > 0]

    return mean(padded), mean(row), mean(column)


def _line(files: SourceFiles, location: str, raw: JsonObject, key: str, origin: F64) -> F64:
    """Return a polyline ``(N, 3)`` minus the origin."""
    with parsing(f"{location}, {key}", "give a list of at least two points with x, y and z"):
        points = np.array(
            [[point["x"], point["y"], point["z"]] for point in raw[key]], dtype=np.float64
        )
        if len(points) < 2:
            raise ValueError(f"{len(points)} points")
        return near(location, points - origin)


def _closed(ring: F64) -> F64:
    return ring if np.array_equal(ring[0], ring[-1]) else np.concatenate([ring, ring[:1]])


@dataclass(frozen=True)
class EgoPoses:
    """The ego's recorded poses as they stand in the file."""

    t_ns: I64  # (T,) nanoseconds, strictly increasing
    xyz: F64  # (T, 3) metres, city; rear axle
    quat: F64  # (T, 4) wxyz, ego to city


def read_argoverse(path: str | Path) -> RecordedLog:
    """Read one log folder.

    The folder holds ``city_SE3_egovehicle.feather``, ``map/`` with the vector map, the ground
    raster and its transform, and, except in the test split, ``annotations*.feather``. Cuboids come in the ego frame of their sweep
    and are brought to the world with the pose of exactly that time.

    Raises:
        InputError: A file is missing, damaged, or holds what no log may hold; the message names it.
    """
    folder = Path(path)
    files = SourceFiles()
    pose_path = files.only(folder, ("city_SE3_egovehicle.feather",), "the ego poses")
    map_path = files.only(folder / "map", ("log_map_archive_*.json",), "the vector map")
    poses = read_ego_poses(files, pose_path)
    origin = np.round(poses.xyz[0])  # whole metres: the subtraction loses nothing
    t_us = poses.t_ns // 1000
    keep = np.concatenate([[True], np.diff(t_us) > 0])
    up = matrix_from_quat(poses.quat)[:, :, 2]  # (T, 3) body z in the city
    xyz = near(pose_path, poses.xyz - origin - WHEEL_RADIUS_M * up)
    ego_log = checked_trajectory(pose_path, t_us[keep], xyz[keep], poses.quat[keep], least=2)
    dropped = int((~keep).sum())
    lane_map, notes = read_map(files, map_path, origin)
    ground = read_ground(files, folder / "map", lane_map, ego_log.xyz, origin)
    actors: tuple[Actor, ...] = ()
    actor_notes: tuple[str, ...] = (NOBODY,)
    box_path = None
    if any(folder.glob("annotations*.feather")):
        box_path = files.only(
            folder, ("annotations.feather", "annotations*.feather"), "the annotated cuboids"
        )
        actors, actor_notes = read_actors(files, box_path, poses, origin)
    entries = sorted(entry for entry in folder.iterdir() if entry != box_path)
    files.met += met_in("log", (entry.name for entry in entries))
    log_notes = (
        [f"{dropped} ego poses share their microsecond with the pose before and were dropped"]
        if dropped
        else []
    )
    log_notes += [
        f"ego poses lowered by {WHEEL_RADIUS_M} m along the body's z axis: from the rear axle to the ground under it",
        "no camera taken from the calibration: the fleet's front camera is a portrait of 47 degrees width; see read_calibration",
        "no speed limits, stop lines or traffic signals: the map has none",
    ]
    return RecordedLog(
        scene_id=f"av2-{real(folder).name}",
        source="argoverse",
        lane_map=lane_map,
        ground=ground,
        ego_log=ego_log,
        vehicle=VEHICLE,
        actors=actors,
        cameras=(),
        world_origin=(float(origin[0]), float(origin[1]), float(origin[2])),
        content_hash=files.content_hash,
        notes=(*log_notes, *notes, *actor_notes, *ARGOVERSE.notes(files.met)),
    )


def read_ego_poses(files: SourceFiles, path: Path) -> EgoPoses:
    """Read ``city_SE3_egovehicle.feather`` without changing it.

    Raises:
        InputError: Fewer than two poses, times that do not increase, values that are not finite,
            quaternions that are not unit.
    """
    table = files.read_feather(path, {"timestamp_ns": "integer", **_NUMBERS}, "poses")
    t_ns = table["timestamp_ns"].astype(np.int64)
    xyz = _columns(table, POSE[4:])
    quat = _columns(table, POSE[:4])
    checked = checked_trajectory(path, t_ns, xyz, quat, least=2)
    return EgoPoses(checked.t_us, checked.xyz, checked.quat)


def read_actors(
    files: SourceFiles, path: Path, poses: EgoPoses, origin: F64
) -> tuple[tuple[Actor, ...], tuple[str, ...]]:
    """Read the annotated cuboids as actors in the world, in order of first appearance; rows of the
    ego itself are left out.

    Raises:
        InputError: A sweep without an ego pose at its time, a bad size, or a track whose
            times do not increase.
    """
    sizes = ("length_m", "width_m", "height_m")
    numbers: dict[str, Kind] = dict.fromkeys((*sizes, *POSE), "number")
    table = files.read_feather(
        path,
        {"timestamp_ns": "integer", "track_uuid": "text", "category": "text", **numbers},
        "annotations",
    )
    t_ns = table["timestamp_ns"].astype(np.int64)
    uuid = table["track_uuid"].astype(str)
    category = table["category"].astype(str)
    others = np.nonzero(category != EGO_CATEGORY)[0]
    if len(others) == 0:
        return (), (NOBODY,)
    T_local_ego = _poses_at(poses, t_ns, path, origin)
    quat = _columns(table, POSE[:4])
    unlike = np.abs(np.linalg.norm(quat, axis=1) - 1) > 1e-2
    if unlike[others].any():
        fault = f"a quaternion that is not of length 1 in row {int(np.argmax(unlike))}"
        raise InputError(f"{path}: {fault}", "give unit quaternions")
    T_local_box = T_local_ego @ se3(_columns(table, POSE[4:]), quat)
    xyz = T_local_box[:, :3, 3].copy()
    turns = quat_from_matrix(T_local_box[:, :3, :3])
    size = _columns(table, sizes)
    actors = []
    unknown: Counter[str] = Counter()
    split = 0
    order, first = np.unique(uuid[others], return_index=True)
    for name in order[np.argsort(first)]:
        track_rows = others[uuid[others] == name]
        location = f"{path}, track {name}"
        track = checked_trajectory(
            location, t_ns[track_rows] // 1000, xyz[track_rows], turns[track_rows]
        )
        kind = str(category[track_rows[0]])
        if kind not in LABELS:
            unknown[kind] += 1
        box = Box(*np.median(size[track_rows], axis=0).tolist())
        label = LABELS.get(kind, "other")
        fixed = kind in FIXED
        parts = actors_of_track(str(name), label, box, track, fixed=fixed)
        split += len(parts) > 1
        actors += parts
    notes = [
        f"{count} tracks of the unknown category {kind!r} are labelled 'other'"
        for kind, count in sorted(unknown.items())
    ]
    if split:
        notes.append(f"{split} tracks have holes longer than 0.5 s and were split")
    return tuple(actors), tuple(notes)


def _poses_at(poses: EgoPoses, t_ns: I64, path: Path, origin: F64) -> F64:
    """Return the ego's poses ``(N, 4, 4)`` around the origin at the times of sweeps.

    Raises:
        InputError: There is no pose at exactly such a time.
    """
    row = np.minimum(np.searchsorted(poses.t_ns, t_ns), len(poses.t_ns) - 1)
    lost = poses.t_ns[row] != t_ns
    if lost.any():
        raise InputError(
            f"{path}: a sweep at {int(t_ns[lost][0])} ns without an ego pose at that time",
            "use annotations and poses of the same log",
        )
    return se3(poses.xyz[row] - origin, poses.quat[row])


def read_calibration(path: str | Path) -> tuple[CameraSpec, ...]:
    """Read a log's camera calibration at full resolution, with its radial distortion.

    Raises:
        InputError: The log has no ``calibration`` folder, or a file in it is damaged.
    """
    folder = Path(path) / "calibration"
    files = SourceFiles()
    inner_path = files.only(folder, ("intrinsics.feather",), "the intrinsics")
    outer_path = files.only(folder, ("egovehicle_SE3_sensor.feather",), "the sensor poses")
    numbers: dict[str, Kind] = dict.fromkeys(
        ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px"), "number"
    )
    inner = files.read_feather(inner_path, {"sensor_name": "text", **numbers}, "intrinsics")
    outer = files.read_feather(outer_path, {"sensor_name": "text", **_NUMBERS}, "mounts")
    CALIBRATION.check(files.met, folder, "use a calibration of the Argoverse 2 sensor set")
    mounts = dict(
        zip(
            outer["sensor_name"].astype(str),
            se3(_columns(outer, POSE[4:]), _columns(outer, POSE[:4])),
            strict=True,
        )
    )
    cameras = []
    for i, name in enumerate(inner["sensor_name"].astype(str)):
        if name not in mounts:
            raise InputError(
                f"{outer_path}: no pose of camera {name!r}", "use calibration files of the same log"
            )
        fx, fy, cx, cy = (float(inner[k][i]) for k in ("fx_px", "fy_px", "cx_px", "cy_px"))
        T_rig_camera = mounts[name].copy()
        T_rig_camera[2, 3] += WHEEL_RADIUS_M  # the rig's origin is on the ground
        K = intrinsics(fx, fy, cx + 0.5, cy + 0.5)  # Argoverse counts from pixel centres
        k1, k2, k3 = (float(inner[k][i]) for k in ("k1", "k2", "k3"))
        lens = LensModel("opencv", (k1, k2, 0.0, 0.0, k3))
        size = int(inner["width_px"][i]), int(inner["height_px"][i])
        cameras.append(CameraSpec(str(name), *size, K, T_rig_camera, lens=lens))
    return tuple(cameras)


def _columns(table: dict[str, npt.NDArray[Any]], names: tuple[str, ...]) -> F64:
    return np.stack([table[n].astype(np.float64) for n in names], axis=1)
