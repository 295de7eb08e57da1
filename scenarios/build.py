"""A built road: from the specification to map, expert log and actors, and the check that the drive
is on the road and clear of all.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from functools import lru_cache

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.limits import ROAD_M
from alpasim_plugin.core.geometry import (
    arc_lengths,
    direction_of,
    heading_of,
    interpolate,
    rectangle_corners,
)
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.parts.spec import digest
from alpasim_plugin.core.path_end import PathTracker, remaining
from alpasim_plugin.core.types import F64, I64, Actor, Box, LaneMap, Route, Trajectory, Vehicle
from alpasim_plugin.world.ground import flat
from alpasim_plugin.world.road_strip import Curve, Element, Intersection, LaneTaper, Profile
from alpasim_plugin.world.roads import Road, build_road
from scenarios.budget import ACTORS
from scenarios.ego_path import EgoPath, make_ego_path
from scenarios.expert import drive
from scenarios.recorded import RecordedLog
from scenarios.schema import ScenarioSpec
from scenarios.schema_parts import (
    ArcSegment,
    ClothoidSegment,
    IntersectionSegment,
    MergeSegment,
    NarrowGapSegment,
    RoadSpec,
    SplitSegment,
    StraightSegment,
)
from scenarios.traffic import place_actors
from scenarios.variation import SceneDraft

MIN_GAP_M = 0.3
STEP_US = 50_000
SEAM_M = 1e-3  # lanes that share an edge are joined over rounding
# scripts go on for so long after the end, so that the expert's lookahead does not see them stop
TAIL_US = 4_000_000
UNPOSTED = 1.5
LEAST_MORE_M = 1.0
JOINT_M = 2.0  # behind the road's end, where a straight begins to be free
STRIP_M = 6.0  # to either side, in which a straight is free
STEP_M = 4.0  # what a fast car moves from one control step to the next
TRACKED_EVERY = 20  # poses of the log
KEPT_DRIVES = 64  # as many as the largest suite that is shipped has scenes, and some


@dataclass(frozen=True)
class _Request:
    """What a drive is built of; its digest stands for all of it."""

    digest: str
    draft: SceneDraft = field(compare=False)
    vehicle: Vehicle = field(compare=False)


def built_drive(draft: SceneDraft, vehicle: Vehicle) -> RecordedLog:
    """Build the road, place the actors and let the expert drive.

    A drive depends on the specification, the scene's id and the vehicle alone, no file among them,
    so each of the last `KEPT_DRIVES` is built once a process; every call returns a copy.

    Args:
        draft: Specification with ``road``.
        vehicle: Ego vehicle.

    Raises:
        InputError: A road, an actor or a drive that cannot be built, with the position of its key.
    """
    made_of = [draft.scene_id, draft.spec.model_dump(mode="json"), asdict(vehicle)]
    return deepcopy(_kept_drive(_Request(digest(made_of), draft, vehicle)))


@lru_cache(maxsize=KEPT_DRIVES)
def _kept_drive(request: _Request) -> RecordedLog:
    return _new_drive(request.draft, request.vehicle)


def _new_drive(draft: SceneDraft, vehicle: Vehicle) -> RecordedLog:
    spec = draft.spec
    assert spec.road is not None
    written_m = sum(getattr(segment, "length_m", 0.0) for segment in spec.road.segments)
    ROAD_M.check(written_m, draft.document.mark(("road", "segments")))
    n_actors = sum(getattr(actor, "count", 1) for actor in spec.actors)
    ACTORS.check(n_actors, draft.document.mark(("actors",)))
    end_us = spec.built_until_us
    road, ego_path, length_m = _long_enough(draft, spec.road, vehicle)
    scripted, followers = place_actors(draft, road, ego_path, vehicle, end_us + TAIL_US)
    ego_log, driven = drive(
        ego_path.path, spec.ego.start_m, vehicle, spec.ego, scripted, followers, end_us
    )
    _check_length(draft, ego_path, ego_log, vehicle, length_m)
    actors = (*scripted, *driven)
    _check_drive(draft, road.lane_map, ego_log, vehicle, actors)
    route = Route(ego_path.path.xyz[::4], ego_path.lane_ids)
    origin = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()
    if ego_path.path.length_m > length_m:
        notes = (
            f"the road goes on straight for {ego_path.path.length_m - length_m:.0f} m behind its "
            f"last segment, as far as {fastest_mps(spec):.1f} m/s come in the time",
        )
    return RecordedLog(
        draft.scene_id,
        "yaml",
        road.lane_map,
        flat(0.0),
        ego_log,
        vehicle,
        actors,
        (),
        origin,
        "",
        notes,
        route=route,
        path_beyond=before_end(
            remaining(route.xyz, with_last(ego_log.xyz, TRACKED_EVERY)), vehicle
        ),
        path_end="road",
    )


def fastest_mps(spec: ScenarioSpec) -> float:
    """Return the speed of the fastest admissible drive on a built road: the posted limit, or
    `UNPOSTED` times what the ego is told where none is posted, and no less than that.
    """
    assert spec.road is not None
    told_mps = max(spec.ego.speed_mps, spec.ego.cruise_mps)
    return max(spec.road.speed_limit_mps or UNPOSTED * told_mps, told_mps)


def _long_enough(
    draft: SceneDraft, spec: RoadSpec, vehicle: Vehicle
) -> tuple[Road, EgoPath, float]:
    """Build the road, with a straight behind its last segment where the fastest admissible drive
    comes farther than that, and nothing else is in the way.

    Returns:
        The road, the ego's line on it, and the length of that line as written, metres.
    """
    ego = draft.spec.ego
    parts = elements(spec)
    start = (0.0, 0.0, float(np.deg2rad(spec.heading_deg)))
    with draft.at("road", "segments"):
        road = build_road(parts, profile(spec), start)
    with draft.at("ego"):
        ego_path = make_ego_path(road, ego, spec.segments)
    written_m = ego_path.path.length_m
    if ego.start_m >= written_m:
        with draft.at("ego", "start_m"):
            raise _too_short(written_m, ego.start_m)
    front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
    reach_m = (
        ego.start_m
        + fastest_mps(draft.spec) * draft.spec.built_until_us * 1e-6
        + 2 * front_m
        + STEP_M
    )
    more_m = _free_ahead_m(road, ego_path, reach_m - written_m)
    if more_m < LEAST_MORE_M:
        return road, ego_path, written_m
    with draft.at("road", "segments"):
        road = build_road([*parts, Curve(more_m)], profile(spec), start)
    with draft.at("ego"):
        ego_path = make_ego_path(road, ego, spec.segments)
    return road, ego_path, written_m


def _free_ahead_m(road: Road, ego_path: EgoPath, more_m: float) -> float:
    """Return how far a straight behind the road's end goes on, at most ``more_m``, before it meets
    the road again.
    """
    if more_m < LEAST_MORE_M:
        return 0.0
    end, yaw = ego_path.path.at(ego_path.path.length_m)
    forward = direction_of(float(yaw))
    begin = end[:2] + JOINT_M * forward
    axis = shapely.linestrings([begin, begin + more_m * forward])
    strip = shapely.buffer(axis, STRIP_M, cap_style="flat")
    lanes = shapely.union_all([lane_polygon(lane) for lane in road.lane_map.lanes.values()])
    met = shapely.get_coordinates(shapely.intersection(strip, lanes))
    if len(met) == 0:
        return more_m
    return float(np.min((met - begin) @ forward))


def _check_length(
    draft: SceneDraft, ego_path: EgoPath, ego_log: Trajectory, vehicle: Vehicle, written_m: float
) -> None:
    """Check that the recorded drive stays on the road as it is written.

    Raises:
        InputError: It does not.
    """
    front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
    tracker = PathTracker(ego_path.path.xyz[::4])
    end_us = draft.spec.built_until_us
    last_us = int(ego_log.t_us[-1])
    for k in [*range(0, len(ego_log.t_us), TRACKED_EVERY), len(ego_log.t_us) - 1]:
        s_m = tracker.follow(ego_log.xyz[k, :2])
        t_us = int(ego_log.t_us[k])
        if s_m + front_m + 1.0 > written_m or (t_us == last_us < end_us):
            with draft.at("road", "segments"):
                raise _too_short(
                    written_m, s_m, f" after {t_us / 1e6:.1f} s of {end_us / 1e6:.1f} s"
                )


def before_end(beyond: F64, vehicle: Vehicle) -> F64:
    """Return a path ``(N, 3)`` of the rear axle up to where the front of the car comes to its end."""
    if len(beyond) == 0:
        return beyond
    front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
    along_m = arc_lengths(beyond)
    return beyond[along_m <= along_m[-1] - front_m - STEP_M]


def with_last(points: F64, stride: int) -> F64:
    """Return one of ``stride`` points ``(N, D)``, from the first on, and the last point."""
    return points[[*range(0, len(points) - 1, stride), len(points) - 1]]


def _too_short(length_m: float, s_m: float, when: str = "") -> InputError:
    fault = f"the road is {length_m:.0f} m long and the ego stands at {s_m:.0f} m{when}"
    do_this = "add or lengthen a segment, shorten timing.duration_us, or lower ego.cruise_mps"
    return InputError(f"road: {fault}", do_this)


def elements(spec: RoadSpec) -> list[Element]:
    """Return the road's elements."""
    out: list[Element] = []
    for segment in spec.segments:
        match segment:
            case StraightSegment() | NarrowGapSegment():
                out.append(Curve(segment.length_m))
            case ArcSegment():
                out.append(
                    Curve(segment.length_m, segment.curvature_per_m, segment.curvature_per_m)
                )
            case ClothoidSegment():
                out.append(
                    Curve(
                        segment.length_m, segment.start_curvature_per_m, segment.end_curvature_per_m
                    )
                )
            case MergeSegment() | SplitSegment():
                out.append(LaneTaper(segment.kind, segment.length_m))
            case IntersectionSegment():
                out.append(Intersection(**segment.model_dump(exclude={"kind"})))
    return out


def profile(spec: RoadSpec) -> Profile:
    """Return the cross-section."""
    return Profile(
        spec.lanes_forward,
        spec.lanes_backward,
        spec.lane_width_m,
        spec.median_m,
        spec.shoulder_m,
        spec.parking_m,
        spec.speed_limit_mps,
        spec.centre_paint,
    )


def _check_drive(
    draft: SceneDraft,
    lane_map: LaneMap,
    ego_log: Trajectory,
    vehicle: Vehicle,
    actors: Sequence[Actor],
) -> None:
    """Check that the ego's footprint stays on the vehicle lanes and `MIN_GAP_M` clear of all
    actors.

    Raises:
        InputError: It does not, with the position of the road or of the actor.
    """
    last_us = min(draft.spec.built_until_us, int(ego_log.t_us[-1]))
    t_us = np.arange(int(ego_log.t_us[0]), last_us + 1, STEP_US)
    ego = _footprints(ego_log, t_us, vehicle.box, vehicle.rear_axle_to_centre_m)
    lanes = [lane for lane in lane_map.lanes.values() if lane.kind == "vehicle"]
    road = shapely.union_all([shapely.buffer(lane_polygon(lane), SEAM_M) for lane in lanes])
    shapely.prepare(road)
    off = np.flatnonzero(~shapely.covers(road, ego))
    if len(off):
        outside_m2 = shapely.area(shapely.difference(ego[off[0]], road))
        fault = f"at {t_us[off[0]] / 1e6:.2f} s {outside_m2:.2f} m2 of the ego leave the lanes"
        with draft.at("road", "segments"):
            raise InputError(
                f"the road: {fault}",
                "use wider lanes, gentler bends, a larger corner_radius_m, or a smaller shift_m",
            )
    gap, when, who = min(
        ((*_least_gap(ego, t_us, actor), actor.actor_id) for actor in actors),
        default=(np.inf, 0, ""),
    )
    if gap < MIN_GAP_M:
        fault = (
            f"at {when / 1e6:.2f} s the gap to the ego is {gap:.2f} m (least allowed {MIN_GAP_M} m)"
        )
        with draft.at(*_key_of(draft.spec, who)):
            raise InputError(
                f"actor {who}: {fault}",
                "start the actor farther away, change its timing, or slow the ego down",
            )


def _key_of(spec: ScenarioSpec, name: str) -> tuple[str | int, ...]:
    """Return the key path of an actor; cars of a narrow gap belong to the road."""
    for i, actor in enumerate(spec.actors):
        if name == actor.id or name.startswith(f"{actor.id}-"):
            return ("actors", i)
    return ("road", "segments")


def _footprints(track: Trajectory, t_us: I64, box: Box, ahead_m: float = 0.0) -> F64:
    """Return rectangles (object array of polygons) of a body at times ``(T,)``, its middle
    ``ahead_m`` in front of the pose.
    """
    poses = interpolate(track, t_us)
    yaw = heading_of(poses[:, :2, 0])
    xy = poses[:, :2, 3] + ahead_m * direction_of(yaw)
    return shapely.polygons(rectangle_corners(xy, yaw, np.array([[box.length_m, box.width_m]])))


def _least_gap(ego: F64, t_us: I64, actor: Actor) -> tuple[float, int]:
    """Return the least distance of an actor to the ego's footprints ``(T,)`` and when it is;
    infinite where they never meet in time.
    """
    rows = np.flatnonzero((t_us >= actor.track.t_us[0]) & (t_us <= actor.track.t_us[-1]))
    if len(rows) == 0:
        return float("inf"), 0
    body = _footprints(actor.track, t_us[rows], actor.box)
    distance = shapely.distance(ego[rows], body)
    k = int(np.argmin(distance))
    return float(distance[k]), int(t_us[rows[k]])
