"""AlpaSim scenes (``.usdz``): map, recorded drive, traffic, vehicle and front camera.

The local frame of the scene is kept, so rollout logs of AlpaSim and of this package fit the same
map. A scene's 3D reconstruction is a checkpoint of a closed renderer and is not read: the map is
dressed instead.

An OpenDRIVE map is also read as AlpaSim's own loader reads it (`alpasim_map`), so that its road
metrics can be reproduced. Facts from its copy of trajdata (Apache-2.0, ``dataset_specific/xodr``).
Where it departs from OpenDRIVE:

- Only lines and arcs are sampled; other records are passed over, and elevations after them slip by
  their length.
- Records are sampled at ``max(2, ceil(length / 0.5))`` stations, both ends included; widths and
  lane offsets are read at multiples of 0.5 m by station number, which drifts from the true arc
  length with every record.
- A lane exists along the whole road with the widths of all sections together; a sidewalk is none,
  every other type is one.
- Road edges are the outer borders of the outermost lanes on each side, sidewalks included. A road
  outside junctions without lanes on a side gets an edge 1 cm beside its reference line there, at
  height 0. Edges that come within 0.2 m of a coarsened lane centre are dropped, and of two edges
  with nearly the same middle the shorter one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.files.fields import field_name, met_in
from alpasim_plugin.core.files.reading import parse_xml
from alpasim_plugin.core.geometry import heading_of, quat_from_matrix, transform_points
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import F64, Actor, Box, Lane, LaneMap, Trajectory, Vehicle
from alpasim_plugin.world.ground import from_points
from scenarios.ftheta import FRONT_WIDE, front_wide
from scenarios.map_borders import lane_edges
from scenarios.map_lines import with_vertices
from scenarios.opendrive import T_local_map, lane_map_of
from scenarios.opendrive_road import MAX_ROAD_M, OdrMap, Road, beside, cubics_at, parse_map
from scenarios.recorded import RecordedLog, SourceFiles, checked_trajectory
from scenarios.usdz_archive import Archive
from scenarios.usdz_fields import META, RIG, USDZ, met_in_rig, met_in_sequence
from scenarios.usdz_tables import clipgt_map

RECONSTRUCTIONS = ("checkpoint.ckpt", "nerf.ingp", "volume.nurec")
GROUND_CELL_M = 2.0
MOST_TURNED = 1e-3  # by which the ego's body may be turned against the rig
# Words in AlpaSim's free-text labels, the first match deciding; all else is "other".
LABELS = (
    ("motor", "motorcycle"),  # a motorcyclist is no cyclist
    ("cyclist", "cyclist"),
    ("bicycle", "cyclist"),
    ("bike", "cyclist"),
    ("rider", "cyclist"),
    ("pedestrian", "pedestrian"),
    ("person", "pedestrian"),
    ("bus", "bus"),
    ("truck", "truck"),
    ("trailer", "truck"),
    ("automobile", "car"),
    ("car", "car"),
    ("vehicle", "car"),
)

STEP_M = 0.5
CROSSING_M = 0.2  # an edge nearer than this to a lane centre crosses it
LANE_STRIDE = 3
SAME_MIDDLE_M = 2.0
PARALLEL_RAD = math.radians(11.0)
LONE_EDGE_M = 0.01


@dataclass(frozen=True)
class RoadMap:
    """The map of a scene as read by its own rules, and as AlpaSim's loader reads it where that
    differs.
    """

    lane_map: LaneMap
    alpasim: LaneMap | None
    notes: tuple[str, ...]


def read_usdz(path: str | Path, needs_map: bool = True) -> RecordedLog:
    """Read a scene as a recorded log, to drive in or to score logs against.

    Args:
        path: The scene.
        needs_map: False accepts a scene without a map: scorers say what they lack.

    Raises:
        InputError: A member is missing or damaged, or there is no map.
    """
    path = Path(path)
    files = SourceFiles()
    with Archive(files, path) as archive:
        scene_id = _scene_id(archive)
        location = f"{path}, {RIG}"
        rig = archive.json(RIG)
        with parsing(location, "give exactly one rig trajectory, as AlpaSim writes it"):
            files.met += met_in_rig(rig)
            (trajectory,) = rig["rig_trajectories"]
            ego_log = _ego_log(trajectory, location)
            vehicle, vehicle_notes = _vehicle(trajectory, location)
            first_frame_us = _first_frame_us(rig)
        road = _road(archive, rig)
        if needs_map and not road.lane_map.lanes:
            raise InputError(
                f"{path}: a scene without a map",
                "use a scene with map tables or map.xodr: its road is what gets dressed",
            )
        actors = _actors(archive)
        cameras, camera_notes = front_wide(archive)
        files.met += [
            part if "/" in part else field_name("archive", part) for part in archive.parts
        ]
        model_note = _model_note(archive)
    surface = [*lane_edges(road.lane_map.lanes), *road.lane_map.road_edges, ego_log.xyz]
    ground = from_points(np.concatenate(surface), GROUND_CELL_M, ego_log.xyz)
    notes = [
        model_note,
        "tracks are replayed as stored, without AlpaSim's smoothing",
        *road.notes,
        *camera_notes,
        *vehicle_notes,
        *USDZ.notes(files.met),
    ]
    notes += _static_notes(actors)
    return RecordedLog(
        scene_id=scene_id,
        source="usdz",
        lane_map=road.lane_map,
        ground=ground,
        ego_log=ego_log,
        vehicle=vehicle,
        actors=actors,
        cameras=cameras,
        world_origin=(0.0, 0.0, 0.0),
        content_hash=files.content_hash,
        notes=tuple(notes),
        first_frame_us=first_frame_us,
        alpasim_map=road.alpasim,
    )


def _static_notes(actors: Sequence[Actor]) -> list[str]:
    """Return a note on tracks that stand still, if any do."""
    n_static = sum(actor.is_static for actor in actors)
    if not n_static:
        return []
    return [f"{n_static} of {len(actors)} tracks are not marked CONTROLLABLE and stand still"]


def _model_note(archive: Archive) -> str:
    """Say which reconstruction a scene holds; none of them is read."""
    inside = ", ".join(
        f"{name} ({archive.sizes[name]} bytes)" for name in RECONSTRUCTIONS if name in archive
    )
    model = "no reconstruction in this scene"
    if inside:
        model = f"{inside} is a checkpoint of a closed renderer and is not read"
    return f"{model}; the map is dressed instead"


def usdz_scene_id(path: str | Path) -> str:
    """Return the scene id of a scene without reading the rest.

    Raises:
        InputError: No archive, or no usable metadata.yaml in it.
    """
    with Archive(SourceFiles(), Path(path)) as archive:
        return _scene_id(archive)


def _scene_id(archive: Archive) -> str:
    document = archive.yaml(META)
    if isinstance(document, dict):
        archive.files.met += met_in(META, document)
    scene_id = document.get("scene_id") if isinstance(document, dict) else None
    if not isinstance(scene_id, str) or not scene_id:
        raise InputError(f"{archive.path}, {META}: scene_id {scene_id!r}", "state the scene's id")
    return scene_id


def _road(archive: Archive, rig: JsonObject) -> RoadMap:
    tables, notes = clipgt_map(archive)
    if tables is not None:
        return RoadMap(tables, None, notes)
    if "map.xodr" not in archive:
        return RoadMap(LaneMap({}), None, (*notes, "no map: neither tables nor map.xodr"))
    location = f"{archive.path}, map.xodr"
    odr = parse_map(location, parse_xml(archive.read("map.xodr"), location))
    with parsing(f"{archive.path}, {RIG}", "give T_world_base, 4 x 4"):
        T_earth_local = np.array(rig["T_world_base"], dtype=np.float64).reshape(4, 4)
        place = T_local_map(odr.geo_reference, T_earth_local)
    lane_map, more = lane_map_of(location, odr, place)
    return RoadMap(lane_map, alpasim_map(odr, place), (*notes, *more))


def _ego_log(rig: JsonObject, location: str) -> Trajectory:
    """Return the recorded drive."""
    t_us = np.array(rig["T_rig_world_timestamps_us"], dtype=np.int64)
    poses = np.array(rig["T_rig_worlds"], dtype=np.float64).reshape(len(t_us), 4, 4)
    turned = np.abs(np.linalg.det(poses[:, :3, :3]) - 1.0)
    if not turned.max(initial=0.0) < 1e-3:
        raise InputError(
            f"{location}: pose {int(np.argmax(turned))} is not a rigid motion",
            "give rotation matrices",
        )
    quat = quat_from_matrix(poses[:, :3, :3])
    return checked_trajectory(location, t_us, poses[:, :3, 3].copy(), quat, least=2)


def _first_frame_us(rig: JsonObject) -> int | None:
    """Return when the first frame of the front wide camera ends, of all cameras where it has none;
    None without frames.
    """
    frames = rig["rig_trajectories"][0].get("cameras_frame_timestamps_us") or {}
    calibrated = rig.get("camera_calibrations") or {}
    ends = {
        calibrated[uid]["logical_sensor_name"]: times[0][1]
        for uid, times in frames.items()
        if times
    }
    return ends.get(FRONT_WIDE, min(ends.values(), default=None))


def _vehicle(rig: JsonObject, location: str) -> tuple[Vehicle, tuple[str, ...]]:
    """Return the ego's body and notes.

    Raises:
        InputError: The body is turned against the rig.
    """
    box = rig.get("rig_bbox")
    if box is None:
        return Vehicle(), (
            "no rig_bbox: the default vehicle is assumed; AlpaSim wants its size in the run's settings",
        )
    ahead, left, up = map(float, box["centroid"])
    length, width, height = (round(float(side), 6) for side in box["dim"])
    above = up - height / 2
    turn = np.abs(np.array(box.get("rot") or (0.0, 0.0, 0.0), dtype=np.float64))
    if not turn.max(initial=0.0) < MOST_TURNED:
        raise InputError(
            f"{location}: rig_bbox, rot: {box['rot']}, a body that is turned against the rig",
            "give a rig along the body, with rot 0",
        )
    notes: tuple[str, ...] = ()
    if max(abs(left), abs(above)) > 1e-3:
        notes = (
            f"the box is {left:.3f} m left of and {above:.3f} m above the rig's origin; both are ignored",
        )
    return Vehicle(Box(length, width, height), round(ahead, 6)), notes


def _actors(archive: Archive) -> tuple[Actor, ...]:
    """Return the tracks as actors."""
    location = f"{archive.path}, sequence_tracks.json"
    document = archive.json("sequence_tracks.json")
    actors: dict[str, Actor] = {}
    with parsing(location, "give one sequence, with lists of equal length, 7 numbers a pose"):
        (sequence,) = document.values()
        archive.files.met += met_in_sequence(sequence)
        tracks = sequence["tracks_data"]
        columns = [
            tracks[f"tracks_{name}"]
            for name in ("id", "label_class", "flags", "timestamps_us", "poses")
        ]
        sizes = sequence["cuboidtracks_data"]["cuboids_dims"]
        for name, label, flags, times, poses, size in zip(*columns, sizes, strict=True):
            if str(name) in actors:
                raise InputError(f"{location}: track {name!r} twice", "give each track its own id")
            table = np.array(poses, dtype=np.float64).reshape(len(times), 7)
            t_us = np.array(times, dtype=np.int64)
            xyz = table[:, :3].copy()
            quat = table[:, [6, 3, 4, 5]].copy()
            track = checked_trajectory(f"{location}, track {name}", t_us, xyz, quat)
            box = Box(*map(float, size))
            still = "CONTROLLABLE" not in flags
            actor = Actor(str(name), label_of(str(label)), box, track, is_static=still)
            actors[actor.actor_id] = actor
    return tuple(actors.values())


def label_of(text: str) -> str:
    """Return our label for a free-text class of AlpaSim.

    Example:
        >>> label_of("heavy_truck"), label_of("person"), label_of("stroller")
        ('truck', 'pedestrian', 'other')
        >>> label_of("motorcyclist"), label_of("motorbike"), label_of("bicyclist")
        ('motorcycle', 'motorcycle', 'cyclist')
    """
    return next((label for word, label in LABELS if word in text.lower()), "other")


def alpasim_map(odr: OdrMap, T_local_map: F64) -> LaneMap:
    """Return lanes and road edges in the local frame; empty where no road has a line or an arc."""
    lanes: dict[str, tuple[F64, F64, F64]] = {}
    edges: dict[str, F64] = {}
    for road in odr.roads:
        _add_road(road, lanes, edges)
    kept = _without_duplicates(_without_crossing(edges, lanes))

    def local(line: F64) -> F64:
        moved = transform_points(T_local_map, line)
        # A width that is read far beyond its section can be very large; AlpaSim would then fill the
        # memory with vertices.
        return with_vertices(moved) if np.abs(moved - moved[0]).max() <= MAX_ROAD_M else moved

    return LaneMap(
        {
            key: Lane(key, local(centre), local(left), local(right))
            for key, (centre, left, right) in lanes.items()
        },
        tuple(local(edge) for edge in kept.values()),
    )


def _reference_line(road: Road) -> F64:
    """Return the points ``(N, 4)`` of a road's lines and arcs: x, y, heading, height."""
    rows = []
    passed_m = 0.0
    for record in road.records:
        if record.kind not in ("line", "arc"):
            continue
        s = np.linspace(
            0.0, record.length_m, max(2, math.ceil(record.length_m / STEP_M)), dtype=np.float64
        )
        rows.append(np.column_stack([record.at(s), cubics_at(road.elevation, passed_m + s)]))
        passed_m += record.length_m
    return np.concatenate(rows) if rows else np.zeros((0, 4))


def _add_road(road: Road, lanes: dict[str, tuple[F64, F64, F64]], edges: dict[str, F64]) -> None:
    """Add a road's lanes (centre, left and right edge) and its two road edges to those before."""
    line = _reference_line(road)
    if not len(line) or not road.sections:
        return
    s = np.asarray(STEP_M * np.arange(len(line)), dtype=np.float64)
    line[:, :2] = beside(line[:, :3], cubics_at(road.lane_offset, s))
    z = line[:, 3]
    widths_of, kinds = _lane_widths(road)
    for sign, name in ((1, "L"), (-1, "R")):
        inner = line[:, :2]
        for lane_id in sorted((i for i in widths_of if i * sign > 0), key=abs):
            widths = np.concatenate(widths_of[lane_id])
            width = cubics_at(widths[np.argsort(widths[:, 0], kind="stable")], s)
            inner_xyz = np.column_stack([inner, line[:, 2]])
            rows = [
                np.column_stack([xy, z])
                for xy in (
                    beside(inner_xyz, sign * width / 2),
                    inner,
                    beside(inner_xyz, sign * width),
                )
            ]
            centre, left, right = (row[::-1] for row in rows) if sign > 0 else rows
            if kinds[lane_id] != "sidewalk":
                lanes[f"{road.road_id}_{lane_id}"] = (centre, left, right)
            inner = rows[2][:, :2]
            edges[f"{road.road_id}_{name}"] = rows[2]
    if widths_of and road.junction == "-1":
        for sign, name in ((1, "L"), (-1, "R")):
            lone = np.column_stack(
                [beside(line[:, :3], np.full(len(line), sign * LONE_EDGE_M)), np.zeros(len(line))]
            )
            edges.setdefault(f"{road.road_id}_{name}", lone)


def _lane_widths(road: Road) -> tuple[dict[int, list[F64]], dict[int, str]]:
    """Return the records of width of each lane over all sections, and its kind in the first."""
    widths_of: dict[int, list[F64]] = {}
    kinds: dict[int, str] = {}
    for section in road.sections:
        for lane in (*section.side(1), *section.side(-1)):
            kinds.setdefault(lane.lane_id, lane.kind.lower())
            if len(lane.widths):
                widths_of.setdefault(lane.lane_id, []).append(lane.widths)
    return widths_of, kinds


def _without_crossing(
    edges: Mapping[str, F64], lanes: Mapping[str, tuple[F64, F64, F64]]
) -> dict[str, F64]:
    coarse = [centre[::LANE_STRIDE, :2] for centre, _, _ in lanes.values()]
    pairs = [np.stack([line[:-1], line[1:]], axis=1) for line in coarse if len(line) > 1]
    if not pairs:
        return dict(edges)
    segments = shapely.linestrings(np.concatenate(pairs))
    tree = shapely.STRtree(segments)
    out = {}
    for key, edge in edges.items():
        line = shapely.linestrings(edge[:, :2])
        near = segments[tree.query(line, predicate="dwithin", distance=CROSSING_M)]
        low_x, low_y, high_x, high_y = shapely.bounds(line)
        box = shapely.bounds(near).reshape(-1, 4)
        # The loader queries its tree by bounding box only, and takes a segment with the edge's own
        # box for a parallel one.
        looked_at = (
            (box[:, 0] <= high_x)
            & (box[:, 2] >= low_x)
            & (box[:, 1] <= high_y)
            & (box[:, 3] >= low_y)
        )
        looked_at &= ~np.all(box == (low_x, low_y, high_x, high_y), axis=1)
        if not np.any(shapely.distance(line, near[looked_at]) < CROSSING_M):
            out[key] = edge
    return out


def _without_duplicates(edges: Mapping[str, F64]) -> dict[str, F64]:
    """Drop of two edges whose middles are within 2 m the shorter one, if they are within 11 degrees
    or their middles within 1 m.
    """
    keys = list(edges)
    lines = np.array([shapely.linestrings(edges[k][:, :2]) for k in keys], dtype=object)
    length = shapely.length(lines)
    middle = shapely.get_coordinates(shapely.centroid(lines))
    chord = np.array([edges[k][-1, :2] - edges[k][0, :2] for k in keys]).reshape(-1, 2)
    bearing = heading_of(chord)
    gone: set[int] = set()
    for a in range(len(keys)):
        if a in gone or length[a] < STEP_M:
            continue
        apart = np.hypot(*(middle[a + 1 :] - middle[a]).T)
        for b in a + 1 + np.flatnonzero(apart <= SAME_MIDDLE_M):
            if b in gone or length[b] < STEP_M:
                continue
            turn = abs((bearing[a] - bearing[b] + math.pi) % (2 * math.pi) - math.pi)
            if turn <= PARALLEL_RAD or apart[b - a - 1] <= SAME_MIDDLE_M / 2:
                gone.add(int(b) if length[a] >= length[b] else a)
    return {k: edges[k] for i, k in enumerate(keys) if i not in gone}
