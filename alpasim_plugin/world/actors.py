"""Road users while a scene is driven: replay of tracks, and drivers that react once the loop is
closed.

Replayed actors exist exactly during their track. Reactive ones follow their track until the loop
closes, then drive along the same line, on along the lanes where it ends, and leave the scene at the
end of the map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    interpolate,
    quat_from_yaw,
    se2,
    se3,
    slerp,
    wrap_angle,
    yaw_of,
)
from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    Bool,
    EgoState,
    HeightField,
    LaneMap,
    Scenario,
    Signal,
    Vehicle,
)
from alpasim_plugin.world.ground import ground_pose, ground_poses
from alpasim_plugin.world.idm import (
    NO_BODIES,
    Bodies,
    IdmParams,
    Leader,
    Spans,
    bodies_from,
    concatenate,
    find_leaders,
    idm_acceleration,
    moved_on,
    nearest_ahead,
    spans,
    wanted_gap_m,
)
from alpasim_plugin.world.path import Lines, Path, polyline_path, smoothstep
from alpasim_plugin.world.route import LaneIndex
from alpasim_plugin.world.signals import lights_on, red_gap_m

MAX_STEP_S = 0.05  # the model is integrated in steps no longer than this
MIN_PATH_M = 1.0  # a reactive driver whose track is shorter than this follows it to its end
LINE_STEP_M = 0.5  # poses nearer to each other than this say nothing about a track's direction
EXTENSION_M = 300.0
MAX_TURN_RAD = 0.8
FADE_M, FADE_STEP_M = 20.0, 2.0
SPEED_SPAN_US = 100_000


class Actors:
    """All road users of one rollout.

    Args:
        actors: Road users with their tracks.
        vehicle: Ego body, which reactive drivers see.
        closed_us: Time at which reactive drivers stop following their tracks.
        lane_map: Map along which reactive drivers go on where their track ends; None: they leave
            the scene there.
        ground: Height field that carries reactive drivers; None keeps the heights of their line.
    """

    def __init__(
        self,
        actors: Sequence[Actor],
        vehicle: Vehicle,
        closed_us: int,
        lane_map: LaneMap | None = None,
        ground: HeightField | None = None,
    ) -> None:
        self.vehicle, self.closed_us = vehicle, closed_us
        index = (
            LaneIndex(lane_map)
            if lane_map is not None and any(a.behaviour.kind == "idm" for a in actors)
            else None
        )
        signals = lane_map.signals if lane_map is not None else None
        reactive = [a for a in actors if a.behaviour.kind == "idm"]
        self.drivers = [_Driver(a, index, ground, signals) for a in reactive]
        paths = [driver.path for driver in self.drivers if driver.path is not None]
        self._lines = Lines(paths) if paths else None
        numbered = (driver for driver in self.drivers if driver.path is not None)
        self._line = {id(driver): number for number, driver in enumerate(numbered)}
        self.replay = _Replay([a for a in actors if a.behaviour.kind != "idm"])
        self.standing = _Standing([a for a in actors if a.behaviour.kind != "idm" and a.is_static])
        self.reset()

    def reset(self) -> None:
        """Go back to the beginning of the scene."""
        self.t_us: int | None = None
        self.replay.reset()
        for driver in self.drivers:
            driver.reset()

    def step(self, t_us: int, ego: EgoState) -> Mapping[str, F64]:
        """Advance to ``t_us`` and return ``T_world_box`` ``(4, 4)`` of every actor present.

        Reactive drivers take one acceleration from the positions at the last call and hold it over
        the step.

        Raises:
            InputError: Time does not increase.
        """
        if self.t_us is not None and t_us <= self.t_us:
            raise InputError(
                f"t = {t_us} us: the last time was {self.t_us} us",
                "step forwards, or reset first",
            )
        poses = self.replay.at(t_us, self.replay.cursor)
        if self.drivers:
            if self.t_us is not None and t_us > self.closed_us:
                self._advance(max(self.t_us, self.closed_us), t_us, ego, poses)
            driving = [driver for driver in self.drivers if driver.motion is not None]
            placed = dict(zip(map(id, driving), self._poses(driving), strict=True))
            for driver in self.drivers:
                pose = placed.get(id(driver))
                if pose is None:
                    pose = driver.pose(t_us, self.closed_us, None)
                if pose is not None:
                    poses[driver.actor.actor_id] = pose
        self.t_us = t_us
        return poses

    def forecast(self) -> ActorForecast:
        """Return a forecast from the present instant, which does not change as the actors move
        on.
        """
        reactive = [
            (d, None if d.motion is None else replace(d.motion)) for d in self.drivers if d.present
        ]
        return ActorForecast(
            self.replay, self.replay.cursor.copy(), tuple(reactive), self.t_us, self.closed_us
        )

    def _advance(self, from_us: int, to_us: int, ego: EgoState, poses: Mapping[str, F64]) -> None:
        n = max(1, int(np.ceil((to_us - from_us) * 1e-6 / MAX_STEP_S)))
        dt_s = (to_us - from_us) * 1e-6 / n
        ego_yaw = yaw_of(ego.T_world_rig)
        direction = np.array([np.cos(ego_yaw), np.sin(ego_yaw)])
        centre = ego.T_world_rig[:2, 3] + self.vehicle.rear_axle_to_centre_m * direction
        fixed = concatenate(
            [
                bodies_from(
                    centre, np.array([ego_yaw]), [self.vehicle.box], ego.speed_mps * direction
                ),
                self.replay.bodies(poses),
            ]
        )
        for driver in self.drivers:
            driver.close(from_us, to_us)
        for _ in range(n):
            driving = [d for d in self.drivers if d.motion is not None]
            if not driving or self._lines is None:
                return
            present = self.standing.present(to_us)
            line, s_m, offset_m, speed = self._where(driving)
            xyz, yaws = self._lines.at(line, s_m, offset_m)
            directions = np.stack([np.cos(yaws), np.sin(yaws)], axis=1)
            boxes = [driver.actor.box for driver in driving]
            moving = bodies_from(xyz[:, :2], yaws, boxes, speed[:, None] * directions)
            everybody = concatenate([fixed, moving])
            found = find_leaders(
                self._lines,
                line,
                s_m + [box.length_m / 2 for box in boxes],
                np.array([box.width_m / 2 for box in boxes]),
                everybody,
                np.array([driver.horizon_m() for driver in driving]),
                np.arange(len(fixed.xy), len(everybody.xy)),
            )
            for driver, leader in zip(driving, found, strict=True):
                driver.decide(leader, self.standing, present, to_us)
            for driver in driving:
                driver.advance(dt_s)

    def _where(self, driving: Sequence[_Driver]) -> tuple[I64, F64, F64, F64]:
        """Return line, arc length, offset and speed ``(N,)`` of drivers that have taken over."""
        line = np.array([self._line[id(driver)] for driver in driving], dtype=np.int64)
        states = [driver.driving()[1] for driver in driving]
        s_m, offset_m, speed = (
            np.array([(m.s_m, m.offset_m, m.speed_mps) for m in states]).reshape(-1, 3).T
        )
        return line, s_m, offset_m, speed

    def _poses(self, driving: Sequence[_Driver]) -> F64:
        """Return the poses ``(N, 4, 4)`` of the boxes of drivers that have taken over."""
        if not driving or self._lines is None:
            return np.zeros((0, 4, 4))
        line, s_m, offset_m, _ = self._where(driving)
        xyz, yaw = self._lines.at(line, s_m, offset_m)
        ground = driving[0].ground
        if ground is None:
            return se3(xyz, quat_from_yaw(yaw))
        up = np.broadcast_to(np.eye(4), (len(driving), 4, 4)).copy()
        up[:, 2, 3] = [driver.actor.box.height_m / 2 for driver in driving]
        return np.asarray(ground_poses(ground, xyz[:, :2], yaw) @ up)


@dataclass(frozen=True)
class ActorForecast:
    """Predicted poses of road users, from what is known at one instant.

    Replayed ones follow their track, reactive ones keep their speed along their line.
    """

    replay: _Replay
    cursor: I64
    reactive: tuple[tuple[_Driver, _Motion | None], ...]
    t_us: int | None
    closed_us: int

    def at(self, t_us: int) -> dict[str, F64]:
        """Return ``T_world_box`` ``(4, 4)`` of every actor expected at ``t_us``, not earlier than
        the instant of the forecast.
        """
        poses = self.replay.at(t_us, self.cursor.copy())
        for driver, motion in self.reactive:
            pose = (
                driver.pose(t_us, t_us, None)
                if motion is None
                else self._moved(driver, motion, t_us)
            )
            if pose is not None:
                poses[driver.actor.actor_id] = pose
        return poses

    def _moved(self, driver: _Driver, motion: _Motion, t_us: int) -> F64 | None:
        assert self.t_us is not None
        assert driver.path is not None
        s_m = motion.s_m + motion.speed_mps * (t_us - self.t_us) * 1e-6
        return (
            None
            if s_m > driver.path.length_m
            else driver.pose(t_us, self.closed_us, replace(motion, s_m=s_m))
        )


def make_actors(scenario: Scenario) -> Actors:
    """Return the actors of a scenario; the loop closes at ``start_us + warmup_us``."""
    closed_us = scenario.start_us + scenario.warmup_us
    return Actors(scenario.actors, scenario.vehicle, closed_us, scenario.lane_map, scenario.ground)


class _Replay:
    """Tracks that do not react, advanced together: one cursor per actor, one batch of
    interpolations a step.
    """

    def __init__(self, actors: Sequence[Actor]) -> None:
        self.actors = list(actors)
        self.first = np.array([int(a.track.t_us[0]) for a in actors], dtype=np.int64)
        self.last = np.array([int(a.track.t_us[-1]) for a in actors], dtype=np.int64)
        counts = np.array([len(a.track) for a in actors], dtype=np.int64)
        self.begin = np.concatenate([[0], np.cumsum(counts)])[:-1] if len(actors) else counts
        self.end = self.begin + counts - 1
        if actors:
            self.t = np.concatenate([a.track.t_us for a in actors])
            self.xyz = np.concatenate([a.track.xyz for a in actors])
            self.quat = np.concatenate([a.track.quat for a in actors])
        self.reset()

    def reset(self) -> None:
        self.cursor = self.begin.copy()

    def at(self, t_us: int, cursor: I64) -> dict[str, F64]:
        """Return the poses at ``t_us``, not earlier than where the cursors (one per actor) stand,
        and move those there.
        """
        rows = np.flatnonzero((self.first <= t_us) & (t_us <= self.last))
        if len(rows) == 0:
            return {}
        i = cursor[rows]
        while True:
            behind = (i + 1 < self.end[rows]) & (self.t[np.minimum(i + 1, self.end[rows])] <= t_us)
            if not behind.any():
                break
            i = i + behind
        cursor[rows] = i
        j = np.minimum(i + 1, self.end[rows])
        span = np.maximum(self.t[j] - self.t[i], 1).astype(np.float64)
        f = np.clip((t_us - self.t[i]).astype(np.float64) / span, 0.0, 1.0)
        xyz = self.xyz[i] * (1 - f)[:, None] + self.xyz[j] * f[:, None]
        poses = se3(xyz, slerp(self.quat[i], self.quat[j], f))
        return {self.actors[k].actor_id: poses[n] for n, k in enumerate(rows)}

    def bodies(self, poses: Mapping[str, F64]) -> Bodies:
        """Return the moving bodies present, with the velocity of the track's current piece."""
        rows = [k for k, a in enumerate(self.actors) if not a.is_static and a.actor_id in poses]
        if not rows:
            return NO_BODIES
        T = np.array([poses[self.actors[k].actor_id] for k in rows])
        i = self.cursor[rows]
        j = np.minimum(i + 1, self.end[rows])
        dt_s = np.maximum(self.t[j] - self.t[i], 1).astype(np.float64) * 1e-6
        velocity = (self.xyz[j, :2] - self.xyz[i, :2]) / dt_s[:, None]
        return bodies_from(
            T[:, :2, 3],
            np.arctan2(T[:, 1, 0], T[:, 0, 0]),
            [self.actors[k].box for k in rows],
            velocity,
        )


class _Standing:
    """Bodies that never move: where they lie on a driver's line is worked out once."""

    def __init__(self, actors: Sequence[Actor]) -> None:
        poses = np.array([se3(a.track.xyz[0], a.track.quat[0]) for a in actors]).reshape(-1, 4, 4)
        self.bodies = bodies_from(
            poses[:, :2, 3],
            np.arctan2(poses[:, 1, 0], poses[:, 0, 0]),
            [a.box for a in actors],
            np.zeros((len(actors), 2)),
        )
        self.first = np.array([int(a.track.t_us[0]) for a in actors], dtype=np.int64)
        self.last = np.array([int(a.track.t_us[-1]) for a in actors], dtype=np.int64)

    def present(self, t_us: int) -> Bool:
        """Return which of them are there."""
        return (self.first <= t_us) & (t_us <= self.last)

    def on(self, path: Path) -> Spans | None:
        """Return their places on a line."""
        return spans(path, 0.0, self.bodies, path.length_m + 100.0, window=False)


@dataclass
class _Motion:
    """Where a reactive driver is on its line."""

    s_m: float
    speed_mps: float
    offset_m: float = 0.0  # left of the line, kept
    accel_mps2: float = 0.0


class _Driver:
    """A reactive driver: its line, its state, its model."""

    def __init__(
        self,
        actor: Actor,
        index: LaneIndex | None,
        ground: HeightField | None,
        signals: Sequence[Signal] | None,
    ) -> None:
        self.actor, self.ground = actor, ground
        self.params = IdmParams.from_mapping(actor.behaviour.params)
        self.path = _driving_line(actor, index)
        self.lights = () if self.path is None else lights_on(self.path, signals)
        self.motion: _Motion | None = None
        self.present = True
        self.standing: Spans | None = None
        self.knows_standing = False

    def reset(self) -> None:
        self.motion, self.present = None, True

    def close(self, from_us: int, to_us: int) -> None:
        """Take the state over from the track, once, when the track has begun."""
        first, last = int(self.actor.track.t_us[0]), int(self.actor.track.t_us[-1])
        if self.motion is not None or not self.present or self.path is None or to_us < first:
            return
        if from_us > last:
            self.present = False  # the track ended while the log was forced
            return
        at = max(from_us, first)
        lo, hi = max(first, at - SPEED_SPAN_US), min(last, at + SPEED_SPAN_US)
        poses = interpolate(self.actor.track, [at, lo, hi])
        s, d = self.path.project(poses[:, :2, 3])
        speed = float(s[2] - s[1]) / ((hi - lo) * 1e-6) if hi > lo else 0.0
        self.motion = _Motion(float(s[0]), max(0.0, speed), float(d[0]))

    def driving(self) -> tuple[Path, _Motion]:
        """Return line and state of a driver that has taken over from its track."""
        assert self.path is not None
        assert self.motion is not None
        return self.path, self.motion

    def horizon_m(self) -> float:
        """Return how far the driver looks: twice the wanted gap behind a standing leader, beyond
        which the interaction is below a quarter of the own acceleration.
        """
        speed_mps = self.driving()[1].speed_mps
        return 20.0 + 2.0 * wanted_gap_m(speed_mps, speed_mps, self.params)

    def decide(self, leader: Leader, standing: _Standing, present: Bool, t_us: int) -> None:
        """Choose the acceleration for the next step, behind a moving leader and before a red
        light.
        """
        path, m = self.driving()
        if not self.knows_standing:
            self.standing, self.knows_standing = standing.on(path), True
        front, half = m.s_m + self.actor.box.length_m / 2, self.actor.box.width_m / 2
        red = Leader(red_gap_m(self.lights, front, m.speed_mps, t_us), 0.0, -1)
        leaders = [leader, red]
        if self.standing is not None:
            there = self.standing.only(present[self.standing.index])
            leaders.append(nearest_ahead(there, front, half, self.horizon_m()))
        m.accel_mps2 = min(
            idm_acceleration(m.speed_mps, o.gap_m, m.speed_mps - o.speed_mps, self.params)
            for o in leaders
        )

    def advance(self, dt_s: float) -> None:
        path, m = self.driving()
        m.s_m, m.speed_mps = moved_on(m.s_m, m.speed_mps, m.accel_mps2, dt_s)
        if m.s_m > path.length_m:
            self.present, self.motion = False, None

    def pose(self, t_us: int, closed_us: int, motion: _Motion | None) -> F64 | None:
        """Return the pose of the box centre for a state of motion (None: on the track), or None
        where the actor is not in the scene.
        """
        if motion is None:
            first, last = int(self.actor.track.t_us[0]), int(self.actor.track.t_us[-1])
            on_track = (
                first <= t_us <= last and self.present and (t_us <= closed_us or self.path is None)
            )
            return interpolate(self.actor.track, t_us) if on_track else None
        assert self.path is not None
        xyz, yaw = self.path.at(motion.s_m, motion.offset_m)
        if self.ground is None:
            return se2(float(xyz[0]), float(xyz[1]), float(yaw), float(xyz[2]))
        T = ground_pose(self.ground, float(xyz[0]), float(xyz[1]), float(yaw))
        return T @ se3([0.0, 0.0, self.actor.box.height_m / 2], [1.0, 0.0, 0.0, 0.0])


def _driving_line(actor: Actor, index: LaneIndex | None) -> Path | None:
    """Return the line of a track, thinned where it stands and extended along the lanes; None for a
    track that goes nowhere.
    """
    xyz = actor.track.xyz
    keep = [0]
    for i in range(1, len(xyz)):
        if np.hypot(*(xyz[i, :2] - xyz[keep[-1], :2])) > LINE_STEP_M:
            keep.append(i)
    line = xyz[keep]
    if len(line) < 2 or np.hypot(*(line[-1, :2] - line[0, :2])) < MIN_PATH_M:
        return None
    path = polyline_path(line)
    end, heading = path.at(path.length_m)
    ahead = _lanes_ahead(index, end, float(heading)) if index is not None else None
    return path if ahead is None else polyline_path(np.concatenate([line, ahead]))


def _lanes_ahead(index: LaneIndex, end: F64, heading: float) -> F64 | None:
    """Return the way on from the end of a track: the lane there that runs the same way, and what
    follows it.
    """
    turns = {
        lane: abs(float(wrap_angle(index.heading_rad(lane, end) - heading)))
        for lane in index.containing(end[:2])
    }
    lane = min(turns, key=lambda one: turns[one], default=None)
    if lane is None or turns[lane] >= MAX_TURN_RAD:
        return None
    xyz = index.path_ahead(lane, EXTENSION_M, start=end).xyz
    if len(xyz) < 2:
        return None
    way = polyline_path(xyz)
    _, offset = way.project(end[None, :2])
    # The track need not run in the lane's middle: keep its offset and fade it out.
    s = np.arange(FADE_STEP_M, way.length_m, FADE_STEP_M)
    points, _ = way.at(s, float(offset[0]) * (1.0 - smoothstep(s / FADE_M)))
    points[:, 2] = end[2]
    return np.asarray(points)
