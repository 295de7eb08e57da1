"""Perturbed rollouts for the learned policy: drives that leave the logged path and its timing, with
other traffic.

Every rollout has its own random stream (scene, seed, "training.policy.drive", number), so rollouts
are independent of each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import se3, yaw_of
from alpasim_plugin.core.recorded_state import ego_state_from_log
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Actor, Scenario
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.lab.training.policy_expert import (
    STEP_S,
    DrivingStyle,
    ReferenceLine,
    RightOfWay,
    acceleration,
    advance,
    following_acceleration,
    leader_on,
)
from alpasim_plugin.world.ground import ground_pose
from alpasim_plugin.world.idm import Bodies, bodies_from
from alpasim_plugin.world.path import Path, smooth_path
from alpasim_plugin.world.route import LaneIndex

FRAME_INTERVAL_S = 0.5  # between two frames; the earlier one shows the motion of other road users
# With a neighbouring lane the nearest lane must not change
MAX_OFFSET_M = 1.8
MAX_OFFSET_NEIGHBOUR_M = 1.3
LEADER_SHARE = 0.55  # share of rollouts with a synthetic leader
KEPT = ("crosses", "beside")  # actors that drive as recorded: the ego gives way to them
LOOKS_SHARE = 0.5  # share of rollouts in which the driver gives way to who comes from a side
HESITATES_SHARE = 0.35  # share in which it brakes for nobody, once


@dataclass(frozen=True)
class RolloutState:
    """State of a perturbed rollout at one frame."""

    t_us: int  # time of the recording, which gives the poses of recorded actors
    T_world_rig: F64  # (4, 4)
    speed_mps: float
    s_m: float  # arc length of the car's projection on the line
    actors: dict[str, F64]  # as in `RenderRequest`
    bodies: Bodies
    collision_free: bool  # frames with a collision are not used


@dataclass(frozen=True)
class PerturbedRollout:
    """A rollout: its reference line, the expert's driving style, the others, and its states in
    order, `FRAME_INTERVAL_S` apart.
    """

    line: ReferenceLine
    style: DrivingStyle
    others: RightOfWay
    states: tuple[RolloutState, ...]


def perturbed_rollouts(
    scenario: Scenario, count: int, drive_s: float, seed: int
) -> Iterator[PerturbedRollout]:
    """Yield rollouts of a scenario along its route, its neighbouring lanes and the other turns of
    its junctions.
    """
    first = ego_state_from_log(scenario.ego_log, scenario.start_us, scenario.vehicle)
    cruise = max(first.speed_mps, 6.0)
    others = [*turning_lines(scenario), *((path, None) for path in neighbour_lines(scenario))]
    for k in range(count):
        # Every third rollout follows the route; the others alternate among the other lines.
        path, turn_s_m = (
            others[(k - 1 - k // 3) % len(others)]
            if others and k % 3
            else (smooth_path(scenario.route.xyz), None)
        )
        yield _drive(
            scenario,
            path,
            turn_s_m,
            cruise,
            drive_s,
            stream(scenario.scene_id, seed, "training.policy.drive", k),
        )


def neighbour_lines(scenario: Scenario) -> list[Path]:
    """Return the left and right neighbouring lanes that exist along the whole route."""
    lanes = scenario.lane_map.lanes
    out = []
    for side in ("left_neighbour", "right_neighbour"):
        names = [getattr(lanes[lane_id], side) for lane_id in scenario.route.lane_ids]
        if names and None not in names:
            out.append(_joined(*(lanes[name].centre for name in names)))
    return out


def turning_lines(scenario: Scenario) -> list[tuple[Path, float]]:
    """Return the turns at the route's junctions that the route does not take: the line, and the arc
    length where the turn begins.
    """
    index = LaneIndex(scenario.lane_map)
    lanes = scenario.lane_map.lanes
    out = []
    for i, lane_id in enumerate(scenario.route.lane_ids[:-1]):
        for other in lanes[lane_id].successors:
            if other == scenario.route.lane_ids[i + 1] or not lanes[other].is_intersection:
                continue
            after = index.path_ahead(other, 60.0).xyz
            path = _joined(
                *(lanes[name].centre for name in scenario.route.lane_ids[: i + 1]), after
            )
            out.append((path, float(path.project(after[:1, :2])[0][0])))
    return out


def _joined(*lines: F64) -> Path:
    """Return one smooth path along consecutive polylines."""
    line = np.concatenate(lines)
    apart = np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 0.05])
    return smooth_path(line[apart])


@dataclass(frozen=True)
class _Habits:
    """How a driver errs. The speed must not say whether somebody comes: some drivers do not look,
    some brake for nobody.

    Attributes:
        looks: Whether the driver gives way.
        brakes_s, brakes_until_s: When the driver brakes for nobody; infinite: never.
        brakes_mps2: How hard.
        lag: 0 to 1; a delayed driver gets closer to the leader than the expert.
    """

    looks: bool
    brakes_s: float
    brakes_until_s: float
    brakes_mps2: float
    lag: float

    @classmethod
    def draw(cls, drive_s: float, random: np.random.Generator) -> _Habits:
        """Draw the habits of a driver for a drive of some seconds."""
        looks = random.random() < LOOKS_SHARE
        brakes_s = np.inf if random.random() > HESITATES_SHARE else random.uniform(0.0, drive_s)
        brakes_until_s = brakes_s + random.uniform(0.5, 3.0)
        brakes_mps2 = random.uniform(1.0, 4.0)
        return cls(looks, brakes_s, brakes_until_s, brakes_mps2, random.uniform(0.0, 1.0))


def _drive(
    scenario: Scenario,
    path: Path,
    turn_s_m: float | None,
    cruise_mps: float,
    drive_s: float,
    random: np.random.Generator,
) -> PerturbedRollout:
    style = DrivingStyle(cruise_mps * random.uniform(0.85, 1.15))
    # The rollout's driving style differs from the expert's, so that there are errors to correct.
    driven_style = DrivingStyle(
        style.desired_mps * random.uniform(0.8, 1.2),
        random.uniform(0.7, 2.0),
        random.uniform(2.0, 4.5),
        random.uniform(2.0, 4.0),
    )
    line = ReferenceLine.along(path, 1.3 * cruise_mps)
    log_s = path.project(scenario.ego_log.xyz[:, :2])[0] if turn_s_m is None else None
    t_us, s = _start(scenario, path, log_s, turn_s_m, random)
    v = min(driven_style.desired_mps, float(np.interp(s, path.s, line.limit_mps))) * random.uniform(
        0.8, 1.1
    )
    if random.random() < 0.12:
        v = random.uniform(0.0, 3.0)
    front = scenario.vehicle.rear_axle_to_centre_m + scenario.vehicle.box.length_m / 2
    half = scenario.vehicle.box.width_m / 2
    leader = _SyntheticLeader.draw(scenario, path, s + front, style.desired_mps, random)
    recorded = [a for a in scenario.actors if leader is None or a is not leader.actor]
    others = RightOfWay.along(path, scenario.vehicle, recorded, scenario.end_us)
    offset = _lateral_offset(
        random,
        MAX_OFFSET_NEIGHBOUR_M if turn_s_m is None and neighbour_lines(scenario) else MAX_OFFSET_M,
    )
    habits = _Habits.draw(drive_s, random)
    states = []
    accel = 0.0
    for step in range(round(drive_s / STEP_S)):
        t = t_us + round(step * STEP_S * 1e6)
        if t > scenario.end_us or s > path.length_m - 15.0:
            break
        actors, bodies = traffic_at(scenario, t, leader)
        ahead = leader_on(line, s, front, half, bodies)
        if step % round(FRAME_INTERVAL_S / STEP_S) == 0:
            states.append(_state_at(scenario, path, t, s, v, offset, step * STEP_S, actors, bodies))
        most = following_acceleration(v, ahead, driven_style)
        if habits.looks:
            most = min(most, others.acceleration(t, s, v, driven_style, others.in_sight(t, s)))
        if habits.brakes_s < step * STEP_S < habits.brakes_until_s:
            most = min(most, -habits.brakes_mps2)
        target = acceleration(line, s, v, most, driven_style)
        accel += (target - accel) * (1.0 - 0.8 * habits.lag)
        if ahead.gap_m < 1.5:
            accel = min(target, accel)
        s, v = advance(s, v, accel, STEP_S)
        if leader is not None:
            leader.advance(STEP_S)
    return PerturbedRollout(line, style, others, tuple(states))


def _start(
    scenario: Scenario,
    path: Path,
    log_s: F64 | None,
    turn_s_m: float | None,
    random: np.random.Generator,
) -> tuple[int, float]:
    if log_s is None or turn_s_m is not None:
        s = max(float(turn_s_m or 0.0) - random.uniform(6.0, 38.0), 1.0)
        return scenario.start_us + round(random.uniform(0, 2) * 1e6), s
    t_us = scenario.start_us + round(
        random.uniform(0.0, 0.35) * (scenario.recorded_until_us - scenario.start_us)
    )
    s = float(np.interp(t_us, scenario.ego_log.t_us, log_s)) + random.normal(0.0, 2.0)
    return t_us, max(s, 1.0)


def _lateral_offset(random: np.random.Generator, largest_m: float) -> tuple[F64, F64, F64]:
    """Return amplitudes, angular frequencies and phases of the lateral offset: a slow and a fast
    sine.
    """
    size = largest_m * np.sqrt(random.uniform(0.0, 1.0)) * np.array([0.65, 0.35])
    return (
        size,
        2 * np.pi / random.uniform([8.0, 4.0], [20.0, 8.0]),
        random.uniform(0, 2 * np.pi, 2),
    )


def _state_at(
    scenario: Scenario,
    path: Path,
    t_us: int,
    s: float,
    v: float,
    offset_waves: tuple[F64, F64, F64],
    at_s: float,
    actors: dict[str, F64],
    bodies: Bodies,
) -> RolloutState:
    size, frequency, phase = offset_waves
    offset = float(size @ np.sin(frequency * at_s + phase))
    drift = float((size * frequency) @ np.cos(frequency * at_s + phase))
    xyz, yaw = path.at(s, offset)
    heading = float(yaw) + float(
        np.arctan2(np.clip(drift, -0.17 * max(v, 1.0), 0.17 * max(v, 1.0)), max(v, 1.0))
    )
    pose = ground_pose(scenario.ground, float(xyz[0]), float(xyz[1]), heading)
    return RolloutState(t_us, pose, v, s, actors, bodies, not _collides(scenario, pose, bodies))


def _collides(scenario: Scenario, T_world_rig: F64, bodies: Bodies, margin_m: float = 0.1) -> bool:
    """Return whether the car's footprint overlaps an actor's (tested on a grid of points of
    each).
    """
    if len(bodies.xy) == 0:
        return False
    centre = T_world_rig[:2, 3] + scenario.vehicle.rear_axle_to_centre_m * T_world_rig[:2, 0]
    half = np.array([scenario.vehicle.box.length_m, scenario.vehicle.box.width_m]) / 2 + margin_m
    grid = np.stack(
        np.meshgrid(np.linspace(-1, 1, 7), [-1.0, -0.5, 0.0, 0.5, 1.0]), axis=-1
    ).reshape(-1, 2)
    for xy, yaw, length, width in zip(
        bodies.xy, bodies.yaw, bodies.half_length_m, bodies.half_width_m, strict=True
    ):
        if np.hypot(*(xy - centre)) > length + half[0] + 3.0:
            continue
        for middle, angle, extent, other, other_angle, other_extent in (
            (xy, yaw, np.array([length, width]), centre, yaw_of(T_world_rig), half),
            (centre, yaw_of(T_world_rig), half, xy, yaw, np.array([length, width])),
        ):
            points = middle + (grid * extent) @ _rotation(angle).T
            local = (points - other) @ _rotation(other_angle)
            if (np.abs(local) < other_extent).all(axis=1).any():
                return True
    return False


def _rotation(angle: float) -> F64:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def traffic_at(
    scenario: Scenario, t_us: int, leader: _SyntheticLeader | None
) -> tuple[dict[str, F64], Bodies]:
    """Return the poses of all actors at a recorded time, and the same as bodies with velocities."""
    actors = log_actors(scenario, t_us)
    before, after = (log_actors(scenario, t_us + dt_us) for dt_us in (-100_000, 100_000))
    if leader is not None:
        actors[leader.actor.actor_id] = leader.pose(scenario)
    boxes = {a.actor_id: a.box for a in scenario.actors}
    names = sorted(actors)
    xy = np.array([actors[name][:2, 3] for name in names]).reshape(-1, 2)
    yaw = np.array([yaw_of(actors[name]) for name in names])
    velocity = np.zeros((len(names), 2))
    for i, name in enumerate(names):
        if leader is not None and name == leader.actor.actor_id:
            velocity[i] = leader.speed_mps * np.array([np.cos(yaw[i]), np.sin(yaw[i])])
        else:  # an actor that has just appeared: use the forward difference
            earlier, later = (before, actors) if name in before else (actors, after)
            if name in later:
                velocity[i] = (later[name][:2, 3] - earlier[name][:2, 3]) / 0.1
    return actors, bodies_from(xy, yaw, [boxes[name] for name in names], velocity)


@dataclass
class _SyntheticLeader:
    """One of the scene's cars, placed on the line ahead: it drives, stands, brakes or sets off."""

    actor: Actor
    path: Path
    s_m: float
    speed_mps: float
    target_mps: float
    change_s: float  # time until it changes its speed
    rate_mps2: float

    @staticmethod
    def draw(
        scenario: Scenario,
        path: Path,
        bumper_s_m: float,
        desired_mps: float,
        random: np.random.Generator,
    ) -> _SyntheticLeader | None:
        vehicles = [
            actor
            for actor in scenario.actors
            if actor.label in ("car", "truck", "bus", "motorcycle")
            and not actor.actor_id.startswith(KEPT)
        ]
        if not vehicles or random.random() > LEADER_SHARE:
            return None
        named = [a for a in vehicles if a.actor_id == "ahead"]
        actor = named[0] if named else vehicles[int(random.integers(len(vehicles)))]
        stands = random.random() < 0.35
        speed = 0.0 if stands else desired_mps * random.uniform(0.3, 1.0)
        target = (
            desired_mps
            if stands and random.random() < 0.3
            else speed * random.choice([0.0, 0.0, 0.5, 1.0])
        )
        gap = random.uniform(20.0, 55.0) if stands else random.uniform(6.0, 35.0)
        return _SyntheticLeader(
            actor,
            path,
            bumper_s_m + gap + actor.box.length_m / 2,
            speed,
            target,
            random.uniform(1.0, 6.0),
            random.uniform(1.0, 4.0),
        )

    def advance(self, dt_s: float) -> None:
        self.change_s -= dt_s
        if self.change_s < 0:
            step = self.rate_mps2 * dt_s
            self.speed_mps += float(np.clip(self.target_mps - self.speed_mps, -step, step))
        self.s_m += self.speed_mps * dt_s

    def pose(self, scenario: Scenario) -> F64:
        xyz, yaw = self.path.at(self.s_m)
        over = max(self.s_m - self.path.length_m, 0.0)
        x = float(xyz[0] + over * np.cos(yaw))
        y = float(xyz[1] + over * np.sin(yaw))
        middle = se3([0.0, 0.0, self.actor.box.height_m / 2], [1.0, 0.0, 0.0, 0.0])
        return np.asarray(ground_pose(scenario.ground, x, y, float(yaw)) @ middle)
