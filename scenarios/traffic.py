"""Traffic of a built road: actors placed in lanes, scripted tracks, IDM followers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import F64, I64, Actor, Behaviour, Box, Trajectory, Vehicle
from alpasim_plugin.world.idm import IdmParams
from alpasim_plugin.world.path import Path, polyline_path
from alpasim_plugin.world.roads import Road, polyline
from scenarios.ego_path import (
    EgoPath,
    cut_in_track,
    grid,
    integrate,
    lane_chain,
    speed_profile,
    standing_track,
    track_on_path,
    walk_track,
)
from scenarios.expert import Drive, ExpertStyle, Follower, drive
from scenarios.schema import EgoSpec, ScenarioSpec
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
from scenarios.variation import Drawn

SIZES = {
    "car": Box(4.6, 1.85, 1.55),
    "truck": Box(8.5, 2.5, 3.4),
    "bus": Box(12.0, 2.55, 3.2),
    "motorcycle": Box(2.2, 0.8, 1.5),
    "cyclist": Box(1.8, 0.6, 1.75),
    "pedestrian": Box(0.6, 0.6, 1.75),
    "other": Box(1.0, 1.0, 1.0),
}


@dataclass
class Traffic:
    """All actors on the road except the ego."""

    scripted: list[Actor] = field(default_factory=list)
    reactive: list[tuple[IdmActor, dict[str, float]]] = field(
        default_factory=list
    )  # with the parameters of their behaviour
    followers: list[Follower] = field(default_factory=list)  # in the same order

    def drive(self, ego: EgoSpec, ego_path: EgoPath, vehicle: Vehicle, end_us: int) -> Drive:
        """Let the expert drive among these actors."""
        style = ExpertStyle(
            ego.speed_mps, ego.cruise_mps, ego.max_lateral_accel_mps2, ego.headway_s
        )
        return drive(
            ego_path.path, ego.start_m, vehicle, style, self.scripted, self.followers, end_us
        )

    def actors(self, run: Drive) -> tuple[Actor, ...]:
        """Return all actors, with the tracks that the followers drove beside the expert."""
        out = list(self.scripted)
        for (actor, params), track in zip(self.reactive, run.followers, strict=True):
            out.append(
                Actor(
                    actor.id, actor.label, box_of(actor), track, behaviour=Behaviour("idm", params)
                )
            )
        return tuple(out)


def place_actors(
    drawn: Drawn, road: Road, ego_path: EgoPath, vehicle: Vehicle, end_us: int
) -> Traffic:
    """Place every actor; those who are timed against the ego come last, after a drive without them.

    Raises:
        InputError: An actor outside its lane or in a lane that does not exist, with the position of
            its key.
    """
    spec = drawn.spec
    traffic = Traffic()
    t_us = grid(0, end_us)
    placer = _Placer(spec, road, ego_path, vehicle, t_us)
    traffic.scripted += _gap_cars(placer)
    late: list[tuple[int, CrossingActor]] = []
    for i, actor in enumerate(spec.actors):
        with drawn.at("actors", i):
            if isinstance(actor, CrossingActor):
                late.append((i, actor))
            elif isinstance(actor, IdmActor):
                _add_follower(placer, traffic, actor)
            else:
                traffic.scripted += _scripted(placer, actor)
    if late:
        run = traffic.drive(spec.ego, ego_path, vehicle, end_us)
        for i, crossing in late:
            with drawn.at("actors", i):
                traffic.scripted.append(_crossing(placer, crossing, run.ego_log))
    return traffic


@dataclass(frozen=True)
class _Placer:
    spec: ScenarioSpec
    road: Road
    ego_path: EgoPath
    vehicle: Vehicle
    t_us: I64
    lines: dict[tuple[str, ...], Path] = field(
        default_factory=dict
    )  # actors of one lane share its line

    def place(self, lane: int | str, s_m: float, actor_id: str) -> tuple[Path, float]:
        """Return a lane's line and the arc length on it abreast of the ego's line at ``s_m`` from
        the ego's start.
        """
        at = self.spec.ego.start_m + s_m
        chain = lane_chain(self.road, self.ego_path, lane, at)
        if chain not in self.lines:
            self.lines[chain] = polyline_path(polyline(self.road.lane_map, chain))
        path = self.lines[chain]
        if isinstance(lane, str):
            s = s_m
        else:
            xyz, _ = self.ego_path.path.at(at)
            s = float(path.project(xyz[None, :2])[0][0])
            if not 0 <= at <= self.ego_path.path.length_m:
                s = -1.0
        if not 0 <= s <= path.length_m:
            raise InputError(
                f"{actor_id}: s_m = {s_m:.1f} is not on the road: its lane has room from {-self.spec.ego.start_m:.0f} to {self.ego_path.path.length_m - self.spec.ego.start_m:.0f} m",
                "choose s_m inside",
            )
        return path, s


def box_of(actor: ActorSpec) -> Box:
    """Return the size of an actor."""
    return Box(*actor.size_m) if actor.size_m is not None else SIZES[actor.label]


def _scripted(placer: _Placer, actor: ActorSpec) -> list[Actor]:
    box, t = box_of(actor), placer.t_us
    match actor:
        case ParkedActor():
            return _parked(placer, actor, box)
        case LoggedActor():
            return [_logged(actor, box)]
        case DriveActor():
            path, s0 = placer.place(actor.lane, actor.s_m, actor.id)
            track = track_on_path(
                path, t, integrate(t, speed_profile(t, actor.speeds), s0), box, actor.offset_m
            )
        case OncomingActor():
            path, s0 = placer.place(-1 - actor.lane, actor.s_m, actor.id)
            track = track_on_path(
                path, t, integrate(t, np.full(len(t), actor.speed_mps), s0), box, actor.offset_m
            )
        case HardBrakeActor():
            path, s0 = placer.place(actor.lane, actor.s_m, actor.id)
            brake_s = actor.brake_at_us * 1e-6
            slow_s = brake_s + (actor.speed_mps - actor.end_speed_mps) / actor.decel_mps2
            rows = [(brake_s, actor.speed_mps), (slow_s, actor.end_speed_mps)]
            track = track_on_path(
                path, t, integrate(t, speed_profile(t, rows), s0), box, actor.offset_m
            )
        case CutInActor():
            track = _cut_in(placer, actor, box)
        case _:
            raise AssertionError(f"{actor.kind} is placed elsewhere")
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


def _cut_in(placer: _Placer, actor: CutInActor, box: Box) -> Trajectory:
    path, s0 = placer.place(actor.from_lane, actor.s_m, actor.id)
    target, _ = placer.place(actor.to_lane, actor.s_m, actor.id)
    end = actor.speed_mps if actor.end_speed_mps is None else actor.end_speed_mps
    begin_s = actor.at_us * 1e-6
    rows = [
        (begin_s, actor.speed_mps),
        (begin_s + max(abs(end - actor.speed_mps) / actor.decel_mps2, 1e-3), end),
    ]
    s = integrate(placer.t_us, speed_profile(placer.t_us, rows), s0)
    return cut_in_track(path, target, placer.t_us, s, box, actor.at_us, actor.change_us)


def _logged(actor: LoggedActor, box: Box) -> Actor:
    rows = np.array(actor.points, dtype=np.float64)
    t_us = np.round(rows[:, 0] * 1e6).astype(np.int64)
    xyz = np.column_stack([rows[:, 1:3], np.full(len(rows), box.height_m / 2)])
    return Actor(
        actor.id,
        actor.label,
        box,
        Trajectory(t_us, xyz, quat_from_yaw(rows[:, 3])),
        is_static=False,
        behaviour=_walking(actor),
    )


def _parked(placer: _Placer, actor: ParkedActor, box: Box) -> list[Actor]:
    out = []
    for n in range(actor.count):
        at = placer.spec.ego.start_m + actor.s_m + n * actor.spacing_m
        if not 0 <= at <= placer.ego_path.path.length_m:
            raise InputError(
                f"{actor.id}: vehicle {n + 1} of {actor.count} at {at:.0f} m is beyond the road",
                "move it",
            )
        name = actor.id if actor.count == 1 else f"{actor.id}-{n}"
        # Put a vehicle beside the outer lane of one side; the clearance counts from the lane's edge
        # to the nearest side of the body.
        yaw_rad = np.deg2rad(actor.yaw_deg)
        path, d, turned = outer_edge(placer.road, placer.ego_path, at, actor.side)
        reach = 0.5 * (abs(np.cos(yaw_rad)) * box.width_m + abs(np.sin(yaw_rad)) * box.length_m)
        sign = 1.0 if actor.side == "left" else -1.0
        xyz, yaw = path.at(at, d + sign * (actor.clearance_m + reach))
        heading = float(yaw) + (np.pi if turned else 0.0) + yaw_rad
        out.append(
            Actor(
                name,
                actor.label,
                box,
                standing_track(xyz[0], xyz[1], xyz[2], heading, placer.t_us, box),
                is_static=True,
            )
        )
    return out


def outer_edge(road: Road, ego_path: EgoPath, at_s_m: float, side: str) -> tuple[Path, float, bool]:
    """Return the ego's line, the signed distance from it to the outer lane's outer edge, and
    whether that lane is an oncoming one.
    """
    stretch = road.stretches[ego_path.stretch_at(at_s_m)]
    xyz, yaw = ego_path.path.at(at_s_m)
    oncoming = [b for b in stretch.backward if b is not None]
    forward = [f for f in stretch.forward if f is not None]
    lane = road.lane_map.lanes[
        forward[-1] if side == "right" else (oncoming[-1] if oncoming else forward[0])
    ]
    turned = side == "left" and bool(oncoming)
    edge = lane.right if side == "right" or turned else lane.left
    assert edge is not None
    c, s = np.cos(float(yaw)), np.sin(float(yaw))
    along, normal = np.array([c, s]), np.array([-s, c])
    rest = edge[:, :2] - xyz[:2]
    # The edge's vertex most nearly abreast; edges are sampled every metre and nearly parallel to
    # the line.
    k = int(np.argmin(np.abs(rest @ along) + 0.1 * np.abs(rest @ normal)))
    return ego_path.path, float(rest[k] @ normal), turned


def _gap_cars(placer: _Placer) -> list[Actor]:
    """Return the parked cars of every narrow gap."""
    out: list[Actor] = []
    assert placer.spec.road is not None
    for i, segment in enumerate(placer.spec.road.segments):
        if not isinstance(segment, NarrowGapSegment):
            continue
        begin, end = placer.ego_path.stretch_s[i], placer.ego_path.stretch_s[i + 1]
        for side, count in (("left", segment.cars_left), ("right", segment.cars_right)):
            sign = 1.0 if side == "left" else -1.0
            for n in range(count):
                at = begin + (end - begin) * (0.25 + 0.5 * (n + 0.5) / count)
                box = SIZES["car"]
                xyz, yaw = placer.ego_path.path.at(at, sign * (segment.gap_m / 2 + box.width_m / 2))
                track = standing_track(
                    xyz[0],
                    xyz[1],
                    xyz[2],
                    float(yaw) + (np.pi if side == "left" else 0.0),
                    placer.t_us,
                    box,
                )
                out.append(Actor(f"gap{i}-{side}-{n}", "car", box, track, is_static=True))
    return out


def _add_follower(placer: _Placer, traffic: Traffic, actor: IdmActor) -> None:
    path, s0 = placer.place(actor.lane, actor.s_m, actor.id)
    desired = (
        max(actor.speed_mps, 1.0) if actor.desired_speed_mps is None else actor.desired_speed_mps
    )
    params = {
        "desired_speed_mps": desired,
        **actor.model_dump(include={"headway_s", "min_gap_m", "accel_mps2", "brake_mps2"}),
    }
    traffic.reactive.append((actor, params))
    traffic.followers.append(
        Follower(
            path, s0, actor.speed_mps, box_of(actor), IdmParams.from_mapping(params), actor.offset_m
        )
    )


def _crossing(placer: _Placer, actor: CrossingActor, ego_log: Trajectory) -> Actor:
    """Time a crossing: the walker reaches the middle of the ego's line ``before_ego_s`` before the
    undisturbed ego's front does.
    """
    at = placer.spec.ego.start_m + actor.s_m
    box = box_of(actor)
    front_m = placer.vehicle.rear_axle_to_centre_m + placer.vehicle.box.length_m / 2
    s_log, _ = placer.ego_path.path.project(ego_log.xyz[:, :2])
    if not s_log[0] + front_m < at < s_log[-1] + front_m:
        first_m, last_m = (s + front_m - placer.spec.ego.start_m for s in (s_log[0], s_log[-1]))
        raise InputError(
            f"{actor.id}: the ego's front drives from {first_m:.0f} to {last_m:.0f} m, the crossing is at s_m = {actor.s_m:.0f}",
            "choose s_m inside",
        )
    arrival_us = float(np.interp(at - front_m, s_log, ego_log.t_us))
    right, left = (
        _road_edge(placer.road, placer.ego_path.path, at, side) for side in ("right", "left")
    )
    ends = {"right": right - actor.margin_m, "left": left + actor.margin_m}
    start, _ = placer.ego_path.path.at(at, ends[actor.side])
    goal, _ = placer.ego_path.path.at(at, ends["left" if actor.side == "right" else "right"])
    walk_us = round(abs(ends[actor.side]) / actor.speed_mps * 1e6)
    begin_us = round(arrival_us - actor.before_ego_s * 1e6) - walk_us
    track = walk_track(start, goal, placer.t_us, begin_us, actor.speed_mps, box)
    return Actor(actor.id, actor.label, box, track, behaviour=_walking(actor))


def _road_edge(road: Road, path: Path, at: float, side: str) -> float:
    """Return the signed distance from the ego's line to the nearest road edge on one side, looking
    square to the line.
    """
    xyz, yaw = path.at(at)
    c, s = np.cos(float(yaw)), np.sin(float(yaw))
    best = np.inf
    for edge in road.lane_map.road_edges:
        x: F64 = (edge[:, 0] - xyz[0]) * c + (edge[:, 1] - xyz[1]) * s
        y: F64 = (edge[:, 1] - xyz[1]) * c - (edge[:, 0] - xyz[0]) * s
        cross = np.flatnonzero((x[:-1] <= 0) != (x[1:] <= 0))
        d = y[cross] - x[cross] * (y[cross + 1] - y[cross]) / (x[cross + 1] - x[cross])
        d = d[d > 0] if side == "left" else -d[d < 0]
        best = min(best, float(d.min())) if len(d) else best
    if not np.isfinite(best):
        raise InputError(
            f"{at:.0f} m: no road edge on the {side}",
            "choose a place on the road",
        )
    return best if side == "left" else -best
