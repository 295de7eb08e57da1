"""The expert that writes the ego's log on a built road, driven together with the reactive traffic.

The expert knows the scripted tracks, so it looks ahead along them: a body that will reach into its corridor within the next seconds is
followed as if it were there already. Speed follows the Intelligent Driver Model with a limit in bends; jerk is bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.geometry import quat_from_yaw, yaw_from_quat
from alpasim_plugin.types import F64, I64, Box, Trajectory, Vehicle
from alpasim_plugin.world.idm import Bodies, IdmParams, Leader, find_leader, idm_acceleration, spans
from alpasim_plugin.world.path import Path
from alpasim_plugin.world.scripted import track_on_path
from alpasim_plugin.world.state import NO_BODIES, bodies_from, concatenate

LOG_STEP_US = 10_000  # 100 Hz
DECISION_US = 50_000
LOOKAHEAD_S = np.arange(0.0, 4.01, 0.5)
MAX_ACCEL_MPS2, MAX_BRAKE_MPS2, MAX_JERK_MPS3 = 2.0, 7.0, 12.0
COMFORT_BRAKE_MPS2 = 1.5


@dataclass(frozen=True)
class ExpertStyle:
    """How the expert drives."""

    speed_mps: float
    cruise_mps: float
    max_lateral_accel_mps2: float
    headway_s: float


@dataclass(frozen=True)
class Follower:
    """A reactive driver that is simulated together with the expert."""

    path: Path
    s_m: float  # of the box centre
    speed_mps: float
    box: Box
    params: IdmParams
    offset_m: float = 0.0


@dataclass(frozen=True)
class Script:
    """A track that reacts to nobody."""

    track: Trajectory
    box: Box


@dataclass(frozen=True)
class Drive:
    """What came out: the ego's log and one track per follower."""

    ego_log: Trajectory  # rig poses
    followers: tuple[Trajectory, ...]  # box centres


def drive(
    path: Path, s0_m: float, vehicle: Vehicle, style: ExpertStyle, scripts: Sequence[Script], followers: Sequence[Follower], end_us: int
) -> Drive:
    """Drive from time 0 to ``end_us``, or to the end of the path.

    Args:
        path: Line of the rear axle.
        s0_m: Where the rear axle starts.
        vehicle: Ego body.
        style: Speeds and limits.
        scripts: Tracks known in advance.
        followers: Drivers that react to the ego and to each other.
        end_us: Last time, a multiple of 50 ms.
    """
    limit = speed_limits(path, style)
    table = _ScriptTable(scripts, end_us)
    s, v, a = s0_m, min(style.speed_mps, float(np.interp(s0_m, path.s, limit))), 0.0
    cars = [_Car(f) for f in followers]
    log_s, log_t = [s], [0]
    front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
    sub_s = LOG_STEP_US * 1e-6
    for t in range(0, end_us, DECISION_US):
        ego = _ego_bodies(path, s, v, vehicle)
        others = [c.bodies() for c in cars]
        wanted = _wanted_acceleration(path, s, v, front_m, vehicle, style, limit, table, others, t)
        for i, car in enumerate(cars):
            car.decide(concatenate([ego, table.at(t), *others[:i], *others[i + 1 :]]))
        for _ in range(DECISION_US // LOG_STEP_US):
            step = MAX_JERK_MPS3 * sub_s
            a = float(np.clip(wanted, a - step, a + step))
            if v + a * sub_s < 0:
                a = -v / sub_s
            s += v * sub_s + 0.5 * a * sub_s * sub_s
            v = max(0.0, v + a * sub_s)
            log_s.append(s)
            log_t.append(log_t[-1] + LOG_STEP_US)
        for car in cars:
            car.advance(DECISION_US * 1e-6)
        if s + front_m + 1.0 > path.length_m:
            break
    t_us, s_log = np.array(log_t, dtype=np.int64), np.array(log_s)
    xyz, yaw = path.at(s_log)
    times = t_us[:: DECISION_US // LOG_STEP_US]
    return Drive(Trajectory(t_us, xyz, quat_from_yaw(yaw)), tuple(car.track(times) for car in cars))


def speed_limits(path: Path, style: ExpertStyle) -> F64:
    """Return the speed ``(N,)`` allowed by bends ahead, reachable with a comfortable brake."""
    k = np.abs(path.curvature)
    v2 = np.minimum(style.cruise_mps**2, style.max_lateral_accel_mps2 / np.maximum(k, 1e-6))
    # v^2(s) <= v^2(s') + 2 b (s' - s) for all s' > s: a running minimum from the far end.
    rising = v2 + 2 * COMFORT_BRAKE_MPS2 * path.s
    return np.asarray(np.sqrt(np.minimum.accumulate(rising[::-1])[::-1] - 2 * COMFORT_BRAKE_MPS2 * path.s))


def _wanted_acceleration(
    path: Path, s: float, v: float, front_m: float, vehicle: Vehicle, style: ExpertStyle, limit: F64, table: _ScriptTable,
    others: Sequence[Bodies], t: int,
) -> float:  # fmt: skip
    params = IdmParams(style.cruise_mps, style.headway_s, 2.5, MAX_ACCEL_MPS2 * 0.75, 2.0, MAX_BRAKE_MPS2)
    ahead = float(np.interp(s + 0.4 * v, path.s, limit))
    wanted = min(1.5 * (ahead - v), MAX_ACCEL_MPS2)
    half = vehicle.box.width_m / 2
    moving = concatenate(list(others))
    for tau in LOOKAHEAD_S:
        later = concatenate([table.at(t + int(tau * 1e6)), replace(moving, xy=moving.xy + tau * moving.velocity)])
        leader = _ghost(path, s + front_m, v, half, vehicle.box.length_m, later, float(tau))
        if leader is not None:
            gap = max(leader.gap_m, 0.1)
            wanted = min(wanted, idm_acceleration(v, gap, v - leader.speed_mps, params))
    return max(wanted, -MAX_BRAKE_MPS2)


def _ghost(path: Path, front_s: float, v: float, half: float, length: float, later: Bodies, tau: float) -> Leader | None:
    """Return the body that will be in the corridor ``tau`` seconds from now, moved back to now at its own speed."""
    if tau == 0.0:
        leader = find_leader(path, front_s, half, later, margin_m=0.3)
        return leader if leader.index >= 0 else None
    span = spans(path, front_s, later)
    if span is None:
        return None
    inside = (span.low < half + 0.3) & (span.high > -half - 0.3)
    front_then = front_s + v * tau
    # Passed before it comes, or still far from it when it is there: no conflict.
    conflict = inside & (span.rear > front_s) & (span.front > front_then - length - 1.0) & (span.rear < front_then + 4.0 + 0.8 * v)
    if not conflict.any():
        return None
    gaps = span.rear - front_s - span.speed * tau
    k = int(np.argmin(np.where(conflict, gaps, np.inf)))
    if gaps[k] < 0.5 and span.speed[k] > 0.5:
        return None  # it is beside or behind now and comes from behind: it is the one to yield
    return Leader(float(gaps[k]), float(span.speed[k]), int(span.index[k]))


def _ego_bodies(path: Path, s: float, v: float, vehicle: Vehicle) -> Bodies:
    xyz, yaw = path.at(s)
    direction = np.array([np.cos(float(yaw)), np.sin(float(yaw))])
    return bodies_from(xyz[:2] + vehicle.rear_axle_to_centre_m * direction, yaw, [vehicle.box], v * direction)


class _ScriptTable:
    """Poses of all scripted tracks on the decision grid."""

    def __init__(self, scripts: Sequence[Script], end_us: int) -> None:
        self.times = np.arange(0, end_us + int(LOOKAHEAD_S[-1] * 1e6) + DECISION_US, DECISION_US, dtype=np.int64)
        self.boxes = [script.box for script in scripts]
        n = len(self.times)
        self.xy, self.yaw = np.zeros((n, len(scripts), 2)), np.zeros((n, len(scripts)))
        self.velocity, self.present = np.zeros((n, len(scripts), 2)), np.zeros((n, len(scripts)), dtype=np.bool_)
        for j, script in enumerate(scripts):
            track = script.track
            t = np.clip(self.times, track.t_us[0], track.t_us[-1])
            for d in range(2):
                self.xy[:, j, d] = np.interp(t, track.t_us, track.xyz[:, d])
            self.yaw[:, j] = np.interp(t, track.t_us, np.unwrap(yaw_from_quat(track.quat)))
            self.velocity[:, j] = np.gradient(self.xy[:, j], DECISION_US * 1e-6, axis=0)
            # A track that ends with the scene's time (not by leaving the road) goes on standing in the look-ahead.
            self.present[:, j] = (self.times >= track.t_us[0]) & ((self.times <= track.t_us[-1]) | (track.t_us[-1] >= end_us))

    def at(self, t: int) -> Bodies:
        """Return the bodies present at a time on the grid."""
        if not self.boxes:
            return NO_BODIES
        i = min(t // DECISION_US, len(self.times) - 1)
        keep = np.flatnonzero(self.present[i])
        return bodies_from(self.xy[i, keep], self.yaw[i, keep], [self.boxes[k] for k in keep], self.velocity[i, keep])


class _Car:
    """A follower while it drives."""

    def __init__(self, f: Follower) -> None:
        self.f, self.s, self.v, self.a = f, f.s_m, f.speed_mps, 0.0
        self.log_s = [self.s]

    def bodies(self) -> Bodies:
        if self.s > self.f.path.length_m:
            return NO_BODIES
        xyz, yaw = self.f.path.at(self.s, self.f.offset_m)
        direction = np.array([np.cos(float(yaw)), np.sin(float(yaw))])
        return bodies_from(xyz[:2], yaw, [self.f.box], self.v * direction)

    def decide(self, others: Bodies) -> None:
        leader = find_leader(self.f.path, self.s + self.f.box.length_m / 2, self.f.box.width_m / 2, others)
        self.a = idm_acceleration(self.v, leader.gap_m, self.v - leader.speed_mps, self.f.params)

    def advance(self, dt_s: float) -> None:
        a = max(self.a, -self.v / dt_s)
        self.s += self.v * dt_s + 0.5 * a * dt_s * dt_s
        self.v = max(0.0, self.v + a * dt_s)
        self.log_s.append(self.s)

    def track(self, times: I64) -> Trajectory:
        return track_on_path(self.f.path, times, np.array(self.log_s[: len(times)]), self.f.box, self.f.offset_m)
