"""Traffic of a built road: actors placed in lanes, scripted tracks, IDM followers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import F64, I64, Actor, Behaviour, Box, Trajectory, Vehicle
from alpasim_plugin.world.path import Path, polyline_path, smoothstep
from alpasim_plugin.world.roads import Road, polyline
from scenarios.ego_path import (
    EgoPath,
    driven_m,
    grid,
    lane_chain,
    standing_track,
    track_on_path,
    walk_track,
)
from scenarios.expert import Follower, drive
from scenarios.schema import ScenarioSpec
from scenarios.schema_parts import (
    ActorSpec,
    CrossingActor,
    CutInActor,
    DriveActor,
    HardBrakeActor,
    IdmActor,
    LoggedActor,
    NarrowGapSegment,
    OncomingActor,
    ParkedActor,
)
from scenarios.variation import SceneDraft

SIZES = {
    "car": Box(4.6, 1.85, 1.55),
    "truck": Box(8.5, 2.5, 3.4),
    "bus": Box(12.0, 2.55, 3.2),
    "motorcycle": Box(2.2, 0.8, 1.5),
    "cyclist": Box(1.8, 0.6, 1.75),
    "pedestrian": Box(0.6, 0.6, 1.75),
    "other": Box(1.0, 1.0, 1.0),
}


def place_actors(
    draft: SceneDraft, road: Road, ego_path: EgoPath, vehicle: Vehicle, end_us: int
) -> tuple[list[Actor], list[Follower]]:
    """Place every actor; those who are timed against the ego come last, after a drive without them.

    Returns:
        Scripted road users, and those who react.

    Raises:
        InputError: An actor outside its lane or in a lane that does not exist, with the position of
            its key.
    """
    ego = draft.spec.ego
    placer = _Placer(draft.spec, road, ego_path, vehicle, grid(end_us))
    scripted = _gap_cars(placer)
    followers = []
    late = []
    for i, actor in enumerate(draft.spec.actors):
        with draft.at("actors", i):
            if isinstance(actor, CrossingActor):
                late.append((i, actor))
            elif isinstance(actor, IdmActor):
                path, s0 = placer.place(actor.lane, actor.s_m, actor.id)
                desired = actor.desired_speed_mps
                params = {
                    "desired_speed_mps": max(actor.speed_mps, 1.0) if desired is None else desired,
                    **actor.model_dump(
                        include={"headway_s", "min_gap_m", "accel_mps2", "brake_mps2"}
                    ),
                }
                box = box_of(actor)
                followers.append(
                    Follower(
                        actor.id,
                        actor.label,
                        path,
                        s0,
                        actor.speed_mps,
                        box,
                        params,
                        actor.offset_m,
                    )
                )
            else:
                scripted += _scripted(placer, actor)
    if late:
        ego_log, _ = drive(ego_path.path, ego.start_m, vehicle, ego, scripted, followers, end_us)
        for i, crossing in late:
            with draft.at("actors", i):
                scripted.append(_crossing(placer, crossing, ego_log))
    return scripted, followers


@dataclass(frozen=True)
class _Placer:
    spec: ScenarioSpec
    road: Road
    ego_path: EgoPath
    vehicle: Vehicle
    t_us: I64

    def place(self, lane: int | str, s_m: float, actor_id: str) -> tuple[Path, float]:
        """Return a lane's line and the arc length on it abreast of the ego's line at ``s_m`` from
        the ego's start.
        """
        start_m = self.spec.ego.start_m
        ego_line = self.ego_path.path
        station_m = start_m + s_m
        chain = lane_chain(self.road, self.ego_path, lane, station_m)
        path = polyline_path(polyline(self.road.lane_map, chain))
        s = s_m
        if not isinstance(lane, str):
            xyz, _ = ego_line.at(station_m)
            s = float(path.project(xyz[None, :2])[0][0])
            if not 0 <= station_m <= ego_line.length_m:
                s = -1.0
        if not 0 <= s <= path.length_m:
            raise InputError(
                f"{actor_id}: s_m = {s_m:.1f} is not on the road: its lane has room from {-start_m:.0f} to {ego_line.length_m - start_m:.0f} m",
                "choose s_m inside",
            )
        return path, s


def box_of(actor: ActorSpec) -> Box:
    """Return the size of an actor."""
    return Box(*actor.size_m) if actor.size_m is not None else SIZES[actor.label]


def _scripted(placer: _Placer, actor: ActorSpec) -> list[Actor]:
    """Return the actors of an entry whose tracks are known in advance."""
    box = box_of(actor)
    t = placer.t_us
    rows: Sequence[tuple[float, float]]  # time in seconds and speed
    match actor:
        case ParkedActor():
            return _parked(placer, actor, box)
        case LoggedActor():
            points = np.array(actor.points, dtype=np.float64)
            t_us = np.round(points[:, 0] * 1e6).astype(np.int64)
            xyz = np.column_stack([points[:, 1:3], np.full(len(points), box.height_m / 2)])
            track = Trajectory(t_us, xyz, quat_from_yaw(points[:, 3]))
            return [Actor(actor.id, actor.label, box, track, behaviour=_walking(actor))]
        case DriveActor():
            lane = actor.lane
            rows = actor.speeds
        case OncomingActor():
            lane = -1 - actor.lane
            rows = [(0.0, actor.speed_mps)]
        case HardBrakeActor():
            lane = actor.lane
            brake_s = actor.brake_at_us * 1e-6
            slow_s = brake_s + (actor.speed_mps - actor.end_speed_mps) / actor.decel_mps2
            rows = [(brake_s, actor.speed_mps), (slow_s, actor.end_speed_mps)]
        case CutInActor():
            lane = actor.from_lane
            begin_s = actor.at_us * 1e-6
            end_mps = actor.speed_mps if actor.end_speed_mps is None else actor.end_speed_mps
            change_s = max(abs(end_mps - actor.speed_mps) / actor.decel_mps2, 1e-3)
            rows = [(begin_s, actor.speed_mps), (begin_s + change_s, end_mps)]
        case _:
            raise AssertionError(f"{actor.kind} is placed elsewhere")
    path, s0 = placer.place(lane, actor.s_m, actor.id)
    s_m = driven_m(t, rows, s0)
    if isinstance(actor, CutInActor):
        target, _ = placer.place(actor.to_lane, actor.s_m, actor.id)
        points, _ = path.at(s_m)
        _, away_m = target.project(points[:, :2])
        offset_m = -away_m * smoothstep((t - t[0] - actor.at_us) / actor.change_us)
        track = track_on_path(path, t, s_m, box, offset_m)
    else:
        track = track_on_path(path, t, s_m, box, actor.offset_m)
    behaviour = Behaviour()
    if isinstance(actor, HardBrakeActor | CutInActor) and actor.role == "adversary":
        behaviour = _adversary(actor)
    return [Actor(actor.id, actor.label, box, track, behaviour=behaviour)]


def _adversary(actor: HardBrakeActor | CutInActor) -> Behaviour:
    """Return the behaviour of one that acts where its track brakes, or has changed lanes."""
    end_mps = actor.end_speed_mps
    act_us = actor.brake_at_us if actor.kind == "hard_brake" else actor.at_us + actor.change_us
    return Behaviour(
        "adversary",
        {
            "gap_m": actor.gap_m,
            "act_us": act_us,
            "speed_mps": actor.speed_mps,
            "end_speed_mps": actor.speed_mps if end_mps is None else end_mps,
            "decel_mps2": actor.decel_mps2,
        },
    )


def _walking(actor: CrossingActor | LoggedActor) -> Behaviour:
    return Behaviour("yield" if actor.yields else "replay")


def _parked(placer: _Placer, actor: ParkedActor, box: Box) -> list[Actor]:
    out = []
    for n in range(actor.count):
        station_m = placer.spec.ego.start_m + actor.s_m + n * actor.spacing_m
        if not 0 <= station_m <= placer.ego_path.path.length_m:
            raise InputError(
                f"{actor.id}: vehicle {n + 1} of {actor.count} at {station_m:.0f} m is beyond the road",
                "move it",
            )
        name = actor.id if actor.count == 1 else f"{actor.id}-{n}"
        # Put a vehicle beside the outer lane of one side; the clearance counts from the lane's edge
        # to the nearest side of the body.
        yaw_rad = np.deg2rad(actor.yaw_deg)
        d, turned = _outer_edge(placer.road, placer.ego_path, station_m, actor.side)
        reach = 0.5 * (abs(np.cos(yaw_rad)) * box.width_m + abs(np.sin(yaw_rad)) * box.length_m)
        sign = 1.0 if actor.side == "left" else -1.0
        xyz, yaw = placer.ego_path.path.at(station_m, d + sign * (actor.clearance_m + reach))
        heading = float(yaw) + (np.pi if turned else 0.0) + yaw_rad
        track = standing_track(xyz, heading, placer.t_us, box)
        out.append(Actor(name, actor.label, box, track, is_static=True))
    return out


def _outer_edge(road: Road, ego_path: EgoPath, at_s_m: float, side: str) -> tuple[float, bool]:
    """Return the signed distance from the ego's line to the outer lane's outer edge, and whether
    that lane is an oncoming one.
    """
    stretch = road.stretches[ego_path.stretch_at(at_s_m)]
    xyz, yaw = ego_path.path.at(at_s_m)
    oncoming = [backward for backward in stretch.backward if backward is not None]
    forward = [f for f in stretch.forward if f is not None]
    lane = road.lane_map.lanes[
        forward[-1] if side == "right" else (oncoming[-1] if oncoming else forward[0])
    ]
    turned = side == "left" and bool(oncoming)
    edge = lane.right if side == "right" or turned else lane.left
    assert edge is not None
    c = np.cos(float(yaw))
    s = np.sin(float(yaw))
    along = np.array([c, s])
    normal = np.array([-s, c])
    offsets = edge[:, :2] - xyz[:2]
    # The edge's vertex most nearly abreast; edges are sampled every metre and nearly parallel to
    # the line.
    k = int(np.argmin(np.abs(offsets @ along) + 0.1 * np.abs(offsets @ normal)))
    return float(offsets[k] @ normal), turned


def _gap_cars(placer: _Placer) -> list[Actor]:
    """Return the parked cars of every narrow gap."""
    out = []
    assert placer.spec.road is not None
    for i, segment in enumerate(placer.spec.road.segments):
        if not isinstance(segment, NarrowGapSegment):
            continue
        begin = placer.ego_path.stretch_s[i]
        end = placer.ego_path.stretch_s[i + 1]
        for side, count in (("left", segment.cars_left), ("right", segment.cars_right)):
            sign = 1.0 if side == "left" else -1.0
            for n in range(count):
                station_m = begin + (end - begin) * (0.25 + 0.5 * (n + 0.5) / count)
                box = SIZES["car"]
                xyz, yaw = placer.ego_path.path.at(
                    station_m, sign * (segment.gap_m / 2 + box.width_m / 2)
                )
                heading = float(yaw) + (np.pi if side == "left" else 0.0)
                track = standing_track(xyz, heading, placer.t_us, box)
                out.append(Actor(f"gap{i}-{side}-{n}", "car", box, track, is_static=True))
    return out


def _crossing(placer: _Placer, actor: CrossingActor, ego_log: Trajectory) -> Actor:
    """Time a crossing: the walker reaches the middle of the ego's line ``before_ego_s`` before the
    undisturbed ego's front does.
    """
    station_m = placer.spec.ego.start_m + actor.s_m
    box = box_of(actor)
    front_m = placer.vehicle.rear_axle_to_centre_m + placer.vehicle.box.length_m / 2
    s_log, _ = placer.ego_path.path.project(ego_log.xyz[:, :2])
    if not s_log[0] + front_m < station_m < s_log[-1] + front_m:
        first_m, last_m = (s + front_m - placer.spec.ego.start_m for s in (s_log[0], s_log[-1]))
        raise InputError(
            f"{actor.id}: the ego's front drives from {first_m:.0f} to {last_m:.0f} m, the crossing is at s_m = {actor.s_m:.0f}",
            "choose s_m inside",
        )
    arrival_us = float(np.interp(station_m - front_m, s_log, ego_log.t_us))
    right, left = _road_edges(placer.road, placer.ego_path.path, station_m)
    ends = {"right": right - actor.margin_m, "left": left + actor.margin_m}
    start, _ = placer.ego_path.path.at(station_m, ends[actor.side])
    goal, _ = placer.ego_path.path.at(station_m, ends["left" if actor.side == "right" else "right"])
    walk_us = round(abs(ends[actor.side]) / actor.speed_mps * 1e6)
    begin_us = round(arrival_us - actor.before_ego_s * 1e6) - walk_us
    track = walk_track(start, goal, placer.t_us, begin_us, actor.speed_mps, box)
    return Actor(actor.id, actor.label, box, track, behaviour=_walking(actor))


def _road_edges(road: Road, path: Path, station_m: float) -> tuple[float, float]:
    """Return the signed distances from the ego's line to the nearest road edges on its right and its
    left, looking square to the line.
    """
    xyz, yaw = path.at(station_m)
    c = np.cos(float(yaw))
    s = np.sin(float(yaw))
    distances = []
    for edge in road.lane_map.road_edges:
        x: F64 = (edge[:, 0] - xyz[0]) * c + (edge[:, 1] - xyz[1]) * s
        y: F64 = (edge[:, 1] - xyz[1]) * c - (edge[:, 0] - xyz[0]) * s
        cross = np.flatnonzero((x[:-1] <= 0) != (x[1:] <= 0))
        distances.append(
            y[cross] - x[cross] * (y[cross + 1] - y[cross]) / (x[cross + 1] - x[cross])
        )
    away_m = np.concatenate(distances)
    right = away_m[away_m < 0]
    left = away_m[away_m > 0]
    if not len(right) or not len(left):
        raise InputError(
            f"{station_m:.0f} m: no road edge on one side", "choose a place on the road"
        )
    return float(right.max()), float(left.min())
