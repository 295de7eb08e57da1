"""The expert that writes the ego's log on a built road, driven together with the reactive traffic.

The expert follows whoever is in its corridor with the Intelligent Driver Model. It predicts who
will enter the corridor within the next seconds (`yielding_acceleration`) and yields early and
smoothly. Bends limit the speed; acceleration and jerk are bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import quat_from_yaw, yaw_from_quat
from alpasim_plugin.core.types import F64, I64, Actor, Bool, Box, Signal, Trajectory, Vehicle
from alpasim_plugin.world.idm import (
    NO_BODIES,
    Bodies,
    IdmParams,
    Leader,
    Spans,
    bodies_from,
    concatenate,
    find_leader,
    find_leaders,
    idm_acceleration,
    moved_on,
    nearest_ahead,
    spans,
)
from alpasim_plugin.world.path import Lines, Path
from alpasim_plugin.world.signals import LightAhead, lights_on, red_gap_m
from scenarios.ego_path import track_on_path

LOOKAHEAD_S = tuple(float(t) for t in np.arange(0.5, 4.01, 0.5))
TIMES_S = np.array([0.0, *LOOKAHEAD_S])
HORIZON_M = 80.0
FOLLOWED_M = 120.0  # reactive traffic looks so far ahead
SIDE_M = 0.3
STANDING_M = 0.05  # a track that never moves farther than this stands

LOG_STEP_US = 10_000  # 100 Hz
DECISION_US = 50_000
LOOKAHEAD_US = 100_000
MAX_ACCEL_MPS2 = 2.0
MAX_BRAKE_MPS2 = 7.0
MAX_JERK_MPS3 = 10.0
STOP_JERK_MPS3 = 5.0
COMFORT_BRAKE_MPS2 = 1.5
MIN_GAP_M = 2.5


class ScriptedTracks:
    """Poses of all scripted tracks on a time grid; those that never move apart.

    Args:
        scripts: Tracks.
        end_us: Last queried time, before the look-ahead.
        step_us: Grid.
    """

    def __init__(self, scripts: Sequence[Actor], end_us: int, step_us: int) -> None:
        self.step_us = step_us
        self.times = np.arange(
            0, end_us + int(LOOKAHEAD_S[-1] * 1e6) + step_us, step_us, dtype=np.int64
        )
        still = [
            s
            for s in scripts
            if np.ptp(s.track.xyz[:, :2], axis=0).max() < STANDING_M and s.track.t_us[-1] >= end_us
        ]
        going = [s for s in scripts if not any(s is other for other in still)]
        xy, yaw = (
            np.array([s.track.xyz[0, :2] for s in still]),
            np.array([float(yaw_from_quat(s.track.quat[0])) for s in still]),
        )
        self.standing = bodies_from(xy, yaw, [s.box for s in still], np.zeros((len(still), 2)))
        n = len(self.times)
        self.boxes = [s.box for s in going]
        self.xy, self.yaw = np.zeros((n, len(going), 2)), np.zeros((n, len(going)))
        self.velocity, self.present = (
            np.zeros((n, len(going), 2)),
            np.zeros((n, len(going)), dtype=np.bool_),
        )
        for j, script in enumerate(going):
            track = script.track
            t = np.clip(self.times, track.t_us[0], track.t_us[-1])
            for d in range(2):
                self.xy[:, j, d] = np.interp(t, track.t_us, track.xyz[:, d])
            self.yaw[:, j] = np.interp(t, track.t_us, np.unwrap(yaw_from_quat(track.quat)))
            self.velocity[:, j] = np.gradient(self.xy[:, j], step_us * 1e-6, axis=0)
            # A track that ends with the scene (and not by leaving the road) goes on standing in the
            # look-ahead.
            self.present[:, j] = (self.times >= track.t_us[0]) & (
                (self.times <= track.t_us[-1]) | (track.t_us[-1] >= end_us)
            )

    def moving(self, t_us: int) -> Bodies:
        """Return the moving bodies present at a time on the grid."""
        if not self.boxes:
            return NO_BODIES
        i = min(t_us // self.step_us, len(self.times) - 1)
        keep = np.flatnonzero(self.present[i])
        return bodies_from(
            self.xy[i, keep],
            self.yaw[i, keep],
            [self.boxes[k] for k in keep],
            self.velocity[i, keep],
        )

    def rows(self, t_us: int) -> I64:
        """Return the grid rows of now and of the look-ahead."""
        rows = (t_us + np.round(TIMES_S * 1e6).astype(np.int64)) // self.step_us
        return np.minimum(rows, len(self.times) - 1)


@dataclass(frozen=True)
class PredictedBodies:
    """Road users now (first row) and after each time of `LOOKAHEAD_S`."""

    xy: F64  # (1 + n, K, 2)
    yaw: F64  # (1 + n, K)
    velocity: F64  # (1 + n, K, 2)
    present: Bool  # (1 + n, K)
    boxes: tuple[Box, ...]
    yields: Bool  # (K,) reactive: it lets the ego go first when it is behind


def yielding_acceleration(
    path: Path, front_s: float, speed_mps: float, box: Box, ahead: PredictedBodies, min_gap_m: float
) -> float:
    """Return the largest acceleration that keeps behind everyone who will come into the corridor;
    infinite without such a one.

    For a body that will be in the corridor after ``tau`` seconds with its rear at ``r``, the own
    front must then not be beyond ``r - gap``: with constant acceleration ``a <= 2 (r - gap - front
    - v tau) / tau^2``. Not counted are bodies that are in the corridor already (they are followed,
    or come from behind), bodies that the ego will have passed by then, and reactive cars that are
    behind the own front now (they are the ones to yield).

    Args:
        path: The ego's line.
        front_s: Arc length of the front bumper.
        speed_mps: Own speed.
        box: Ego body.
        ahead: Everyone who moves.
        min_gap_m: Gap to keep from a standing body; half a second is added for a moving one.
    """
    n, k = ahead.yaw.shape
    if k == 0:
        return float("inf")
    flat = bodies_from(
        ahead.xy.reshape(-1, 2),
        ahead.yaw.reshape(-1),
        ahead.boxes * n,
        ahead.velocity.reshape(-1, 2),
    )
    span = spans(path, front_s, flat, HORIZON_M)
    if span is None:
        return float("inf")
    half = box.width_m / 2 + SIDE_M
    rear = np.full(n * k, np.inf)
    front = np.full(n * k, -np.inf)
    speed = np.zeros(n * k)
    inside = np.zeros(n * k, dtype=np.bool_)
    rear[span.index], front[span.index], speed[span.index] = span.rear, span.front, span.speed
    inside[span.index] = (span.low < half) & (span.high > -half)
    rear, front, speed, inside = (
        a.reshape(n, k) for a in (rear, front, speed, inside & ahead.present.reshape(-1))
    )
    tau = TIMES_S[:, None]
    passed = front < front_s + speed_mps * tau - box.length_m - 1.0
    behind = ahead.yields & (rear[0] < front_s + 0.5)
    counts = inside & ~passed & (front >= front_s) & ~inside[0] & ~behind & ahead.present[0]
    counts[0] = False
    if not counts.any():
        return float("inf")
    allowed = rear - (min_gap_m + 0.5 * speed) - front_s - speed_mps * tau
    return float(np.min(2.0 * allowed[counts] / np.broadcast_to(tau, counts.shape)[counts] ** 2))


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
class Drive:
    """What came out: the ego's log and one track per follower."""

    ego_log: Trajectory  # rig poses
    followers: tuple[Trajectory, ...]  # box centres


def drive(
    path: Path,
    s0_m: float,
    vehicle: Vehicle,
    style: ExpertStyle,
    scripts: Sequence[Actor],
    followers: Sequence[Follower],
    end_us: int,
    signals: Sequence[Signal] | None = None,
) -> Drive:
    """Drive from time 0 to ``end_us``, or to the end of the path.

    Args:
        path: Line of the rear axle.
        s0_m: Where the rear axle starts.
        vehicle: Ego body.
        style: Speeds and limits.
        scripts: Tracks known in advance.
        followers: Drivers that react to the ego and to each other.
        end_us: Last time.
        signals: Traffic lights, at which all stop.
    """
    table = ScriptedTracks(scripts, end_us, DECISION_US)
    expert = _Expert(path, s0_m, vehicle, style, table, lights_on(path, signals))
    standing = {
        id(f.path): spans(f.path, 0.0, table.standing, f.path.length_m + 100.0, window=False)
        for f in followers
    }
    paths = {id(f.path): f.path for f in followers}
    lights = {key: lights_on(line, signals) for key, line in paths.items()}
    cars = [_Car(f, standing[id(f.path)], lights[id(f.path)]) for f in followers]
    number = {key: i for i, key in enumerate(paths)}
    lines = Lines(list(paths.values())) if paths else None
    line = np.array([number[id(f.path)] for f in followers], dtype=np.int64)
    half_widths = np.array([f.box.width_m / 2 for f in followers])
    horizons = np.full(len(cars), FOLLOWED_M)
    log_s, log_t = [expert.s], [0]
    sub_s = LOG_STEP_US * 1e-6
    for t in range(0, end_us, DECISION_US):
        driving = [car for car in cars if car.s <= car.f.path.length_m]
        moving = concatenate([table.moving(t), _bodies(driving)])
        wanted = expert.decide(moving, cars, t)
        everybody = concatenate([expert.bodies(), moving])
        own_row = {
            id(car): row for row, car in enumerate(driving, start=len(everybody.xy) - len(driving))
        }
        if lines is not None:
            rows = np.array([own_row.get(id(car), -1) for car in cars], dtype=np.int64)
            fronts = np.array([car.front_s for car in cars])
            found = find_leaders(lines, line, fronts, half_widths, everybody, horizons, rows)
            for car, leader in zip(cars, found, strict=True):
                car.decide(leader, t)
        for _ in range(DECISION_US // LOG_STEP_US):
            expert.advance(wanted, sub_s)
            log_s.append(expert.s)
            log_t.append(log_t[-1] + LOG_STEP_US)
        for car in cars:
            car.advance(DECISION_US * 1e-6)
        if expert.front_s + 1.0 > path.length_m:
            break
    t_us = np.array(log_t, dtype=np.int64)
    times = t_us[:: DECISION_US // LOG_STEP_US]
    keep = t_us < end_us + LOG_STEP_US  # the first pose at or after the end is the last
    xyz, yaw = path.at(np.array(log_s)[keep])
    return Drive(
        Trajectory(t_us[keep], xyz, quat_from_yaw(yaw)), tuple(car.track(times) for car in cars)
    )


def speed_limits(path: Path, style: ExpertStyle) -> F64:
    """Return the speed ``(N,)`` that bends allow, reachable with a comfortable brake from
    everywhere before them.
    """
    k = np.abs(path.curvature)
    v2 = np.minimum(style.cruise_mps**2, style.max_lateral_accel_mps2 / np.maximum(k, 1e-6))
    # v^2(s) <= v^2(s') + 2 b (s' - s) for all s' > s: a running minimum from the far end.
    rising = v2 + 2 * COMFORT_BRAKE_MPS2 * path.s
    return np.sqrt(np.minimum.accumulate(rising[::-1])[::-1] - 2 * COMFORT_BRAKE_MPS2 * path.s)


class _Expert:
    """The ego while it drives."""

    def __init__(
        self,
        path: Path,
        s0_m: float,
        vehicle: Vehicle,
        style: ExpertStyle,
        table: ScriptedTracks,
        lights: Sequence[LightAhead],
    ) -> None:
        self.path, self.vehicle, self.table, self.lights = path, vehicle, table, lights
        self.lookup = path.coarser(
            4
        )  # projections search every station; 1 m apart is enough for them
        self.limit = speed_limits(path, style)
        self.s, self.a, self.cap = s0_m, 0.0, float("inf")
        self.v = min(style.speed_mps, float(np.interp(s0_m, path.s, self.limit)))
        self.params = IdmParams(
            style.cruise_mps, style.headway_s, MIN_GAP_M, MAX_ACCEL_MPS2 * 0.75, 2.0, MAX_BRAKE_MPS2
        )
        self.front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
        self.standing = spans(path, 0.0, table.standing, path.length_m + 100.0, window=False)

    @property
    def front_s(self) -> float:
        return self.s + self.front_m

    def bodies(self) -> Bodies:
        xyz, yaw = self.path.at(self.s)
        direction = np.array([np.cos(float(yaw)), np.sin(float(yaw))])
        return bodies_from(
            xyz[:2] + self.vehicle.rear_axle_to_centre_m * direction,
            yaw,
            [self.vehicle.box],
            self.v * direction,
        )

    def decide(self, others: Bodies, cars: Sequence[_Car], t_us: int) -> float:
        """Return the wanted acceleration."""
        ahead = float(np.interp(self.s + 0.4 * self.v, self.path.s, self.limit))
        wanted = min(1.5 * (ahead - self.v), MAX_ACCEL_MPS2)
        half = self.vehicle.box.width_m / 2
        moving = find_leader(self.lookup, self.front_s, half, others, margin_m=0.3)
        for leader in (moving, nearest_ahead(self.standing, self.front_s, half)):
            if leader.index >= 0:
                wanted = min(
                    wanted,
                    idm_acceleration(self.v, leader.gap_m, self.v - leader.speed_mps, self.params),
                )
        red_m = red_gap_m(self.lights, self.front_s, self.v, t_us)
        if red_m < np.inf:
            wanted = min(wanted, idm_acceleration(self.v, red_m, self.v, self.params))
        if t_us % LOOKAHEAD_US == 0:
            self.cap = yielding_acceleration(
                self.lookup,
                self.front_s,
                self.v,
                self.vehicle.box,
                _predicted(self.table, cars, t_us),
                MIN_GAP_M,
            )
        return max(min(wanted, self.cap), -MAX_BRAKE_MPS2)

    def advance(self, wanted: float, dt_s: float) -> None:
        step = MAX_JERK_MPS3 * dt_s
        # The brake is released while stopping: v = a^2 / 2 j leaves no jolt at standstill.
        wanted = max(wanted, -float(np.sqrt(2.0 * STOP_JERK_MPS3 * self.v)))
        self.a = float(np.clip(wanted, self.a - step, self.a + step))
        self.a = max(self.a, -self.v / dt_s)  # it stands
        self.s, self.v = moved_on(self.s, self.v, self.a, dt_s)


class _Car:
    """A follower while it drives."""

    def __init__(self, f: Follower, standing: Spans | None, lights: Sequence[LightAhead]) -> None:
        self.f, self.s, self.v, self.a = f, f.s_m, f.speed_mps, 0.0
        self.log_s = [self.s]
        self.standing = standing  # places of the standing bodies on its line
        self.lights = lights

    @property
    def front_s(self) -> float:
        return self.s + self.f.box.length_m / 2

    def decide(self, moving: Leader, t_us: int) -> None:
        red_m = red_gap_m(self.lights, self.front_s, self.v, t_us)
        a = idm_acceleration(self.v, red_m, self.v, self.f.params)
        for leader in (moving, nearest_ahead(self.standing, self.front_s, self.f.box.width_m / 2)):
            if leader.index >= 0:
                a = min(
                    a,
                    idm_acceleration(
                        self.v, leader.gap_m, self.v - leader.speed_mps, self.f.params
                    ),
                )
        self.a = a

    def advance(self, dt_s: float) -> None:
        self.s, self.v = moved_on(self.s, self.v, self.a, dt_s)
        self.log_s.append(self.s)

    def track(self, times: I64) -> Trajectory:
        return track_on_path(
            self.f.path, times, np.array(self.log_s[: len(times)]), self.f.box, self.f.offset_m
        )


def _bodies(cars: Sequence[_Car]) -> Bodies:
    """Return where reactive cars are, in their order; cars on one line are placed together."""
    if not cars:
        return NO_BODIES
    xy, yaw = np.empty((len(cars), 2)), np.empty(len(cars))
    for path, rows in _by_path(cars):
        xyz, yaw[rows] = path.at(
            np.array([cars[i].s for i in rows]), np.array([cars[i].f.offset_m for i in rows])
        )
        xy[rows] = xyz[:, :2]
    velocity = np.array([car.v for car in cars])[:, None] * np.stack(
        [np.cos(yaw), np.sin(yaw)], axis=1
    )
    return bodies_from(xy, yaw, [car.f.box for car in cars], velocity)


def _by_path(cars: Sequence[_Car]) -> list[tuple[Path, list[int]]]:
    """Group the indices of cars by the line that they drive on."""
    groups: dict[int, tuple[Path, list[int]]] = {}
    for i, car in enumerate(cars):
        groups.setdefault(id(car.f.path), (car.f.path, []))[1].append(i)
    return list(groups.values())


def _predicted(table: ScriptedTracks, cars: Sequence[_Car], t_us: int) -> PredictedBodies:
    """Return scripted tracks as they are written, and reactive cars at their present speed on their
    own lines.
    """
    rows = table.rows(t_us)
    xy, yaw = [table.xy[rows]], [table.yaw[rows]]
    velocity, present = [table.velocity[rows]], [table.present[rows]]
    order = [i for _, rows_of in _by_path(cars) for i in rows_of]
    for path, group in _by_path(cars):
        v = np.array([cars[i].v for i in group])
        s = np.array([cars[i].s for i in group]) + v * TIMES_S[:, None]  # (1 + n, K)
        xyz, heading = path.at(s, np.array([cars[i].f.offset_m for i in group]))
        xy.append(xyz[..., :2])
        yaw.append(heading)
        velocity.append(v[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1))
        present.append(s <= path.length_m)
    return PredictedBodies(
        np.concatenate(xy, axis=1),
        np.concatenate(yaw, axis=1),
        np.concatenate(velocity, axis=1),
        np.concatenate(present, axis=1),
        (*table.boxes, *(cars[i].f.box for i in order)),
        np.arange(len(table.boxes) + len(cars)) >= len(table.boxes),
    )
