"""Traces of the Open Simulation Interface (``.osi``), as esmini and CARLA write them: a recorded drive
with its traffic, and the lanes where the trace holds them.

Positions are centres of boxes in the world's frame. The host vehicle is the ego. Lanes are those of
the first message that has any; a lane of the type intersection is an area, through which each pair
of lanes that it joins gets a lane.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    arc_lengths,
    centre_line,
    offset_trajectory,
    project,
    shifted,
    step_lengths,
    unit,
)
from alpasim_plugin.core.types import (
    F64,
    Actor,
    Box,
    HeightField,
    Lane,
    LaneMap,
    LaneMarkType,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.world.ground import flat, height_at
from scenarios.map_lines import bordered, corridor, ground_of, is_left_of, rails, same_way
from scenarios.osi_messages import OSI, UNREAD, ground_truths, met_fields
from scenarios.recorded import RecordedLog, SourceFiles, actors_of_track, checked_trajectory, near

# Types of moving objects.
VEHICLE = 2
PEDESTRIAN = 3
# Of vehicles; all else is "other".
LABELS = {
    **dict.fromkeys((2, 3, 4, 5, 6), "car"),
    **dict.fromkeys((7, 8, 9, 16), "truck"),
    10: "motorcycle",
    **dict.fromkeys((11, 17, 18), "cyclist"),
    12: "bus",
}
# Types of lanes.
DRIVING = 2
INTERSECTION = 4
# Kinds of other lanes by their subtype.
KINDS = {3: "bike", 5: "parking", 6: "shoulder", 9: "shoulder"}
# Types of boundaries.
SOLID = 3
DASHED = 4
DOTS = 5
YELLOW = 4
OVERHANG_M = 0.2  # of a car beyond an axle, at least: its wheels have a radius
ROAD_HEIGHT_M = 0.3  # wheels that are farther above or below the lanes are not on the road
JOIN_STEPS = 16  # of a lane through an intersection
DEFAULT = Vehicle()
NO_LANES = "the trace holds no lanes to drive on: the driven path is one lane without lane markings"


@dataclass
class _Track:
    """One moving object as it is collected."""

    first: Any  # its first message
    rows: list[tuple[float, ...]] = field(default_factory=list)  # t_us, x, y, z, yaw, pitch, roll
    raised_m: float = 0.0  # of the box's centre above the places that the file states

    @property
    def label(self) -> str:
        """Return the class of road user."""
        of_type = {VEHICLE: LABELS.get(self.first.vehicle_classification.type, "car")}
        return {**of_type, PEDESTRIAN: "pedestrian"}.get(self.first.type, "other")

    @property
    def box(self) -> Box:
        size = self.first.base.dimension
        return Box(size.length, size.width, size.height)

    def trajectory(self, location: str, origin: F64, least: int = 1) -> Trajectory:
        """Return the poses of the box centre."""
        table = np.array(self.rows)
        table[:, 3] += self.raised_m
        turns = scipy.spatial.transform.Rotation.from_euler("ZYX", np.nan_to_num(table[:, 4:]))
        return checked_trajectory(
            location,
            table[:, 0].astype(np.int64),
            near(location, table[:, 1:4] - origin),
            turns.as_quat(scalar_first=True),
            least,
        )


def read_osi(path: str | Path, ego: str | None = None) -> RecordedLog:
    """Read a trace of GroundTruth or SensorView messages.

    Args:
        path: The file.
        ego: Id of the moving object that becomes the ego; None takes the host vehicle, where the
            trace names none the vehicle of the smallest id that is present all the time.

    Raises:
        InputError: The file is broken, holds no moving object, or ``ego`` names none.
    """
    file = Path(path)
    files = SourceFiles()
    trace = _read_trace(files, file)
    chosen, why = _choose_ego(file, trace, ego)
    tracks = trace.tracks
    origin = np.array([*np.round(tracks[chosen].rows[0][1:3]), 0.0])
    lanes, lane_notes = ({}, []) if trace.roads is None else _lanes(file, trace.roads, origin)
    has_lanes = any(lane.kind == "vehicle" for lane in lanes.values())
    vehicle, axle_notes = _vehicle(tracks[chosen])
    notes = [f"ego is {why}: {chosen}", *trace.notes, *lane_notes, *axle_notes]
    if has_lanes:
        points = np.array(tracks[chosen].rows)[:, 1:4] - origin
        near(f"{file}, object {chosen}", points)
        lanes, on_ground, height_notes = _at_one_height(file, lanes, points, vehicle.box.height_m)
        notes += height_notes
        for track in tracks.values():
            track.raised_m = track.box.height_m / 2 if on_ground else 0.0
    centres = {
        key: track.trajectory(f"{file}, object {key}", origin, 2 if key == chosen else 1)
        for key, track in tracks.items()
    }
    T_centre_rig = shifted(-vehicle.rear_axle_to_centre_m, 0.0, -vehicle.box.height_m / 2)
    ego_log = offset_trajectory(centres.pop(chosen), T_centre_rig)
    if has_lanes:
        lane_map = bordered(lanes, LaneMap({}))
        ground = ground_of(lane_map, ego_log.xyz)
    else:
        notes.append(NO_LANES)
        lane_map, ground = _driven_lane(ego_log)
    return RecordedLog(
        f"osi-{file.stem}",
        "osi",
        lane_map,
        ground,
        ego_log,
        vehicle,
        _actors(tracks, centres),
        (),
        (float(origin[0]), float(origin[1]), 0.0),
        files.content_hash,
        tuple(notes),
    )


def _actors(tracks: Mapping[int, _Track], centres: Mapping[int, Trajectory]) -> tuple[Actor, ...]:
    """Return the road users of the objects whose centres are given."""
    return tuple(
        actor
        for key, centre in centres.items()
        for actor in actors_of_track(str(key), tracks[key].label, tracks[key].box, centre)
    )


def _driven_lane(ego_log: Trajectory) -> tuple[LaneMap, HeightField]:
    """Return one lane along a drive on level ground."""
    ground = flat(float(np.median(ego_log.xyz[:, 2])))
    lane_map = corridor(ego_log, ground)
    return bordered(lane_map.lanes, lane_map), ground


@dataclass
class _Trace:
    """What the messages of a trace say.

    Attributes:
        tracks: Moving objects by id.
        n_messages: How many messages there are.
        host: Id of the host vehicle that the first message with one names.
        roads: The first message with lanes.
        later_lanes: Ids of lanes that only later messages have.
        notes: What was left out.
    """

    tracks: dict[int, _Track] = field(default_factory=dict)
    n_messages: int = 0
    host: str | None = None
    roads: Any = None
    later_lanes: set[int] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)


def _read_trace(files: SourceFiles, path: Path) -> _Trace:
    """Collect the moving objects of all messages."""
    trace = _Trace()
    first_lanes: set[int] = set()
    for truth in ground_truths(files, path):
        message = truth.message
        if not trace.n_messages:
            unread = {name: len(getattr(message, name)) for name in UNREAD}
            trace.notes += [f"{name} left out: {n}" for name, n in sorted(unread.items()) if n]
            trace.notes += OSI.notes(met_fields(message))
        trace.n_messages += 1
        if trace.host is None and truth.host is not None:
            trace.host = str(truth.host)
        if trace.roads is None and message.lane:
            trace.roads = message
            first_lanes = {road_lane.id.value for road_lane in message.lane}
        elif trace.roads is not None:
            lanes = {road_lane.id.value for road_lane in message.lane}
            trace.later_lanes |= lanes - first_lanes
        t_us = message.timestamp.seconds * 1_000_000 + round(message.timestamp.nanos / 1000)
        for moving_object in message.moving_object:
            place = moving_object.base.position
            turn = moving_object.base.orientation
            row = (t_us, place.x, place.y, place.z, turn.yaw, turn.pitch, turn.roll)
            key = moving_object.id.value
            trace.tracks.setdefault(key, _Track(moving_object)).rows.append(row)
    if trace.later_lanes:
        trace.notes.append(
            f"lanes are those of the first message that has some: {len(trace.later_lanes)} lanes of later ones left out"
        )
    return trace


def _choose_ego(path: Path, trace: _Trace, ego: str | None) -> tuple[int, str]:
    """Return the id of the moving object that becomes the ego, and why it does.

    Raises:
        InputError: There is no such object, or none can be chosen.
    """
    if ego is not None:
        why = f"object {ego}"
    elif trace.host is not None:
        ego = trace.host
        why = "the host vehicle"
    else:
        ego = _usual_ego(path, trace.tracks, trace.n_messages)
        why = "the first vehicle that is always there"
    chosen = next((key for key in trace.tracks if str(key) == ego), None)
    if chosen is None:
        raise InputError(
            f"{path}: no moving object {ego!r} for the ego",
            f"choose it by ego among {', '.join(map(str, sorted(trace.tracks))) or 'none'}",
        )
    return chosen, why


def _usual_ego(path: Path, tracks: Mapping[int, _Track], n_messages: int) -> str:
    """Return the vehicle of the smallest id that is present all the time."""
    always = [
        key
        for key, track in tracks.items()
        if track.first.type == VEHICLE and len(track.rows) == n_messages
    ]
    if not always:
        raise InputError(
            f"{path}: {len(tracks)} moving objects, none a vehicle that is present all the time",
            "name the ego: log: {osi: FILE, ego: ID}",
        )
    return str(min(always))


def _vehicle(track: _Track) -> tuple[Vehicle, list[str]]:
    """Return the ego's body, and notes on axles that cannot be as written; those that the trace does
    not place are in proportion to its length.

    The vector to the rear axle points backwards. esmini once wrote its length instead.
    """
    scale = track.box.length_m / DEFAULT.box.length_m
    usual = Vehicle(track.box, DEFAULT.rear_axle_to_centre_m * scale, DEFAULT.wheelbase_m * scale)
    attributes = track.first.vehicle_attributes
    if not attributes.HasField("bbcenter_to_rear"):
        return usual, []
    notes = []
    rear_m = -attributes.bbcenter_to_rear.x
    if rear_m < 0:
        rear_m = -rear_m
        notes.append(
            f"the rear axle of the ego lies {rear_m:g} m ahead of its middle, which cannot be: it is taken as behind it"
        )
    wheelbase_m = usual.wheelbase_m
    if attributes.HasField("bbcenter_to_front"):
        wheelbase_m = abs(attributes.bbcenter_to_front.x) + rear_m
    half_m = track.box.length_m / 2
    farthest_m = half_m - OVERHANG_M
    if not (0 < rear_m <= farthest_m and 0 < wheelbase_m <= rear_m + farthest_m):
        notes.append(
            f"axles of the ego {rear_m:g} m behind its middle and {wheelbase_m:g} m apart do not fit a length of {track.box.length_m:g} m: they are placed in proportion"
        )
        return usual, notes
    return Vehicle(track.box, rear_m, wheelbase_m), notes


def _at_one_height(
    path: Path, lanes: dict[str, Lane], centres: F64, height_m: float
) -> tuple[dict[str, Lane], bool, list[str]]:
    """Bring a drive and its lanes to one height, where the trace has them apart.

    Args:
        path: The trace.
        lanes: All lanes.
        centres: ``(T, 3)`` places of the ego, metres.
        height_m: Of the ego.

    Returns:
        The lanes, whether places are those of the ground under the boxes, and notes.

    Raises:
        InputError: The wheels of the ego are at no constant height above the lanes.
    """
    ground = ground_of(LaneMap(lanes), centres)
    above_m = centres[:, 2] - height_m / 2 - height_at(ground, centres)
    offset_m = float(np.median(above_m))
    spread_m = float(np.quantile(np.abs(above_m - offset_m), 0.9))
    if max(abs(offset_m), spread_m) <= ROAD_HEIGHT_M:
        return lanes, False, []
    if spread_m > ROAD_HEIGHT_M:
        raise InputError(
            f"{path}: the wheels of the ego are {above_m.min():.2f} to {above_m.max():.2f} m above the lanes",
            "record heights of lanes and of objects in one frame, or a trace without lanes",
        )
    if abs(offset_m + height_m / 2) <= ROAD_HEIGHT_M / 3:
        return (
            lanes,
            True,
            [
                f"objects stand {-offset_m:.2f} m in the road: their places are taken as those of the ground under their boxes"
            ],
        )
    shift = np.array([0.0, 0.0, offset_m])
    return (
        {key: _moved(lane, shift) for key, lane in lanes.items()},
        False,
        [
            f"the lanes lie {offset_m:+.2f} m from the wheels of the ego: they are moved by that height"
        ],
    )


def _moved(lane: Lane, shift: F64) -> Lane:
    """Return a lane of a trace, which has both edges, moved by ``(3,)`` metres."""
    assert lane.left is not None
    assert lane.right is not None
    return replace(
        lane, centre=lane.centre + shift, left=lane.left + shift, right=lane.right + shift
    )


def _lanes(path: Path, roads: Any, origin: F64) -> tuple[dict[str, Lane], list[str]]:
    """Return the lanes of a message, linked, and notes on those that were left out."""
    borders = {border.id.value: border for border in roads.lane_boundary}
    lanes: dict[str, Lane] = {}
    left_out: Counter[str] = Counter()
    for road_lane in roads.lane:
        location = f"{path}, lane {road_lane.id.value}"
        lane = _lane(location, road_lane, borders, origin, left_out)
        if lane is not None:
            lanes[lane.lane_id] = lane
    after = {key: list(lane.successors) for key, lane in lanes.items()}
    for road_lane in roads.lane:
        if road_lane.classification.type != INTERSECTION:
            continue
        for pair in road_lane.classification.lane_pairing:
            begin = str(pair.antecessor_lane_id.value)
            end = str(pair.successor_lane_id.value)
            if begin in lanes and end in lanes and begin != end:
                # From the end of one lane to the start of another.
                sides = zip(rails(lanes[begin]), rails(lanes[end]), strict=True)
                left, right = (_curve(*edges) for edges in sides)
                lane = Lane(
                    f"{road_lane.id.value}.{begin}.{end}",
                    (left + right) / 2,
                    left,
                    right,
                    successors=(end,),
                    left_mark_type="none",
                    right_mark_type="none",
                    is_intersection=True,
                )
                after[begin].append(lane.lane_id)
                lanes[lane.lane_id] = lane
    out = {}
    for key, lane in lanes.items():
        successors = after.get(key, list(lane.successors))
        out[key] = replace(
            lane,
            successors=tuple(name for name in successors if name in lanes),
            left_neighbour=same_way(lane, lanes, lane.left_neighbour),
            right_neighbour=same_way(lane, lanes, lane.right_neighbour),
        )
    return out, [f"lanes {why} left out: {n}" for why, n in sorted((+left_out).items())]


def _lane(
    location: str,
    road_lane: Any,
    borders: Mapping[int, Any],
    origin: F64,
    left_out: Counter[str],
) -> Lane | None:
    """Return a lane in driving direction; None for one that is not driven, whose pieces link others,
    or that lacks a line, which is counted in ``left_out`` by the reason.
    """
    facts = road_lane.classification
    kind = "vehicle" if facts.type == DRIVING else KINDS.get(facts.subtype)
    if kind is None:
        left_out["that are not driven"] += facts.type != INTERSECTION
        return None
    if len(facts.centerline) < 2:
        left_out["without a centre line"] += 1
        return None
    centre = near(location, _points(facts.centerline) - origin)
    sides = []
    for ids in (facts.left_lane_boundary_id, facts.right_lane_boundary_id):
        lane_borders = [borders[ref.value] for ref in ids if ref.value in borders]
        edge = _edge(lane_borders, centre, origin)
        if edge is None:
            left_out["without a boundary on both sides"] += 1
            return None
        sides.append((near(location, edge), _mark_type(lane_borders[0])))
    ahead, beside = _links(facts)
    if not facts.centerline_is_driving_direction:
        sides = [(edge[::-1], mark_type) for edge, mark_type in reversed(sides)]
    if not is_left_of(sides[0][0], sides[1][0]):
        sides = sides[::-1]
    (left, left_mark_type), (right, right_mark_type) = sides
    if arc_lengths(left)[-1] <= 0.0 or arc_lengths(right)[-1] <= 0.0:
        left_out["without a length"] += 1
        return None
    return Lane(
        str(road_lane.id.value),
        centre_line(left, right),
        left,
        right,
        kind,
        successors=tuple(dict.fromkeys(ahead)),
        left_neighbour=beside[0],
        right_neighbour=beside[1],
        left_mark_type=left_mark_type,
        right_mark_type=right_mark_type,
    )


def _links(facts: Any) -> tuple[list[str], list[str | None]]:
    """Return the lanes that follow a lane in driving direction, and those on its left and right."""
    beside = [
        str(ids[0].value) if ids else None
        for ids in (facts.left_adjacent_lane_id, facts.right_adjacent_lane_id)
    ]
    if facts.centerline_is_driving_direction:
        return [str(pair.successor_lane_id.value) for pair in facts.lane_pairing], beside
    return [str(pair.antecessor_lane_id.value) for pair in facts.lane_pairing], beside[::-1]


def _edge(lane_borders: Sequence[Any], centre: F64, origin: F64) -> F64 | None:
    """Join the boundaries of one side of a lane along its centre ``(N, 3)``; None for no line."""
    points = [_points(point.position for point in border.boundary_line) for border in lane_borders]
    border_points = np.concatenate([np.zeros((0, 3)), *points]) - origin
    s_m = np.array([project(centre, point)[0] for point in border_points])
    line = border_points[np.argsort(s_m, kind="stable")]
    if len(line):
        line = line[np.concatenate([[True], step_lengths(line) > 1e-6])]
    return line if len(line) > 1 else None


def _points(vectors: Any) -> F64:
    return np.array(
        [(vector.x, vector.y, vector.z) for vector in vectors], dtype=np.float64
    ).reshape(-1, 3)


def _mark_type(border: Any) -> LaneMarkType:
    """Return the lane marking of a boundary; colours other than yellow are white."""
    yellow = border.classification.color == YELLOW
    if border.classification.type == SOLID:
        return "solid_yellow" if yellow else "solid_white"
    if border.classification.type in (DASHED, DOTS):
        return "dashed_yellow" if yellow else "dashed_white"
    return "none"


def _curve(begin: F64, end: F64) -> F64:
    """Return the cubic ``(N, 3)`` that leaves one line's end and meets another line's start in
    their directions.
    """
    first = begin[-1]
    last = end[0]
    reach_m = float(np.linalg.norm(last - first))
    out = begin[-1] - begin[-2]
    into = end[1] - end[0]
    out, into = (reach_m * unit(way) for way in (out, into))
    t = np.linspace(0.0, 1.0, JOIN_STEPS)[:, None]
    return np.asarray(
        (1 - t) ** 2 * (1 + 2 * t) * first
        + t**2 * (3 - 2 * t) * last
        + t * (1 - t) ** 2 * out
        - t**2 * (1 - t) * into
    )
