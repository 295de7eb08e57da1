"""The expert that writes the ego's log on a built road, driven together with the reactive traffic.

The expert follows whoever is in its corridor with the Intelligent Driver Model. It predicts who
will enter the corridor within the next seconds (`yielding_acceleration`) and yields early and
smoothly. Bends limit the speed; acceleration and jerk are bounded.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import direction_of, quat_from_yaw, yaw_from_quat
from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    Behaviour,
    Bool,
    Box,
    LaneMap,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.world.idm import (
    Bodies,
    IdmParams,
    Leader,
    allowed_speeds,
    at_place,
    bend_speeds,
    bodies_from,
    concatenate,
    find_leader,
    find_leaders,
    idm_acceleration,
    moved_on,
)
from alpasim_plugin.world.path import Lines, Path
from alpasim_plugin.world.signals import LightAhead, give_way_gap_m, lights_on, red_gap_m
from alpasim_plugin.world.yielding import (
    MIN_GAP_M,
    TIMES_S,
    PredictedBodies,
    yielding_acceleration,
)
from scenarios.ego_path import track_on_path
from scenarios.schema import EgoSpec

FOLLOWED_M = 120.0  # reactive traffic looks so far ahead
STANDING_M = 0.05  # a track that never moves farther than this stands

LOG_STEP_US = 10_000  # 100 Hz
DECISION_US = 50_000
LOOKAHEAD_US = 100_000
MAX_ACCEL_MPS2 = 2.0
MAX_BRAKE_MPS2 = 7.0
MAX_JERK_MPS3 = 10.0
STOP_JERK_MPS3 = 5.0


class ScriptedTracks:
    """Poses of all scripted tracks on a time grid; those that never move apart.

    Args:
        scripts: Tracks.
        end_us: Last queried time, before the look-ahead.
    """

    def __init__(self, scripts: Sequence[Actor], end_us: int) -> None:
        lookahead_us = int(TIMES_S[-1] * 1e6)
        self.times = np.arange(0, end_us + lookahead_us + DECISION_US, DECISION_US)
        still: list[Actor] = []
        going: list[Actor] = []
        for script in scripts:
            reach_m = np.ptp(script.track.xyz[:, :2], axis=0).max()
            stands = reach_m < STANDING_M and script.track.t_us[-1] >= end_us
            (still if stands else going).append(script)
        xy = np.array([script.track.xyz[0, :2] for script in still])
        yaw = np.array([float(yaw_from_quat(script.track.quat[0])) for script in still])
        boxes = [script.box for script in still]
        z = np.array([script.track.xyz[0, 2] for script in still])
        self.standing = bodies_from(xy, yaw, boxes, np.zeros((len(still), 2)), z)
        n = len(self.times)
        self.boxes = [script.box for script in going]
        self.xy = np.zeros((n, len(going), 2))
        self.z = np.zeros((n, len(going)))
        self.yaw = np.zeros((n, len(going)))
        self.velocity = np.zeros((n, len(going), 2))
        self.present = np.zeros((n, len(going)), dtype=np.bool_)
        for j, script in enumerate(going):
            track = script.track
            first_us = int(track.t_us[0])
            last_us = int(track.t_us[-1])
            t = np.clip(self.times, first_us, last_us)
            for d in range(2):
                self.xy[:, j, d] = np.interp(t, track.t_us, track.xyz[:, d])
            self.z[:, j] = np.interp(t, track.t_us, track.xyz[:, 2])
            self.yaw[:, j] = np.interp(t, track.t_us, np.unwrap(yaw_from_quat(track.quat)))
            self.velocity[:, j] = np.gradient(self.xy[:, j], DECISION_US * 1e-6, axis=0)
            # A track that ends with the scene (and not by leaving the road) goes on standing in the
            # look-ahead.
            ends = last_us < end_us
            self.present[:, j] = (self.times >= first_us) & (not ends or self.times <= last_us)

    def rows(self, t_us: int) -> I64:
        """Return the grid rows of now and of the look-ahead."""
        rows = (t_us + np.round(TIMES_S * 1e6).astype(np.int64)) // DECISION_US
        return np.minimum(rows, len(self.times) - 1)


@dataclass(frozen=True)
class Follower:
    """A reactive driver that is simulated together with the expert."""

    actor_id: str
    label: str
    path: Path
    s_m: float  # of the box centre
    speed_mps: float
    box: Box
    params: dict[str, float]  # see `IdmParams`
    offset_m: float = 0.0


def drive(
    path: Path,
    s0_m: float,
    vehicle: Vehicle,
    ego: EgoSpec,
    scripts: Sequence[Actor],
    followers: Sequence[Follower],
    end_us: int,
    lane_map: LaneMap | None = None,
    posted_mps: F64 | None = None,
    traffic_until_us: Callable[[int], int] | None = None,
) -> tuple[Trajectory, tuple[Actor, ...]]:
    """Drive from time 0 to ``end_us``, or to the end of the path.

    Args:
        path: Line of the rear axle.
        s0_m: Where the rear axle starts.
        vehicle: Ego body.
        ego: Speeds and limits.
        scripts: Tracks known in advance.
        followers: Drivers that react to the ego and to each other.
        end_us: Last time.
        lane_map: Traffic lights at which all stop, and lines at which all let others pass.
        posted_mps: Speed limit at each vertex of the path.
        traffic_until_us: Up to when the followers drive on, without the ego, after it has come to
            the end of the path before ``end_us``, from the time at which it has; None: no longer.

    Returns:
        The ego's log (rig poses), and the followers as they drove.
    """
    last_us = end_us if traffic_until_us is None else max(end_us, traffic_until_us(end_us))
    table = ScriptedTracks(scripts, last_us)
    expert = _Expert(path, s0_m, vehicle, ego, table, *_lines_on(path, lane_map), posted_mps)
    traffic = _Traffic(followers, lane_map, table)
    log_s = [expert.s]
    t_us = 0
    while t_us < end_us and not (t_us and expert.has_arrived):
        ahead = traffic.predicted(t_us)
        target = expert.decide(ahead.now(), ahead, t_us)
        traffic.step(ahead, expert.bodies(), t_us)
        for _ in range(DECISION_US // LOG_STEP_US):
            expert.advance(target, LOG_STEP_US * 1e-6)
            log_s.append(expert.s)
        t_us += DECISION_US
    if traffic_until_us is not None and t_us < end_us:
        for beyond_us in range(t_us, traffic_until_us(t_us), DECISION_US):
            traffic.step(traffic.predicted(beyond_us), None, beyond_us)
    log_us = LOG_STEP_US * np.arange(len(log_s), dtype=np.int64)
    keep = log_us < end_us + LOG_STEP_US  # the first pose at or after the end is the last
    xyz, yaw = path.at(np.array(log_s)[keep])
    return Trajectory(log_us[keep], xyz, quat_from_yaw(yaw)), traffic.driven()


def _lines_on(
    path: Path, lane_map: LaneMap | None
) -> tuple[Sequence[LightAhead], Sequence[LightAhead]]:
    """Return the lights and the lines to give way at on a path."""
    if lane_map is None:
        return (), ()
    lanes = lane_map.lanes
    return lights_on(path, lane_map.signals, lanes), lights_on(path, lane_map.give_way, lanes)


class _Expert:
    """The ego while it drives."""

    def __init__(
        self,
        path: Path,
        s0_m: float,
        vehicle: Vehicle,
        ego: EgoSpec,
        table: ScriptedTracks,
        lights: Sequence[LightAhead],
        give_way: Sequence[LightAhead],
        posted_mps: F64 | None,
    ) -> None:
        self.path, self.vehicle, self.table, self.lights = path, vehicle, table, lights
        self.give_way = give_way
        self.line = Lines([path])
        most_mps = np.minimum(ego.cruise_mps, np.inf if posted_mps is None else posted_mps)
        self.limit = allowed_speeds(path, most_mps, ego.max_lateral_accel_mps2)
        self.s, self.a, self.cap = s0_m, 0.0, float("inf")
        self.v = min(ego.speed_mps, float(np.interp(s0_m, path.s, self.limit)))
        self.params = IdmParams(
            ego.cruise_mps, ego.headway_s, MIN_GAP_M, MAX_ACCEL_MPS2 * 0.75, 2.0, MAX_BRAKE_MPS2
        )
        self.front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2

    @property
    def front_s(self) -> float:
        return self.s + self.front_m

    @property
    def has_arrived(self) -> bool:
        """Tell whether it is at the end of its path."""
        return self.front_s + 1.0 > self.path.length_m

    def bodies(self) -> Bodies:
        xyz, yaw = self.path.at(self.s)
        direction = np.array([np.cos(float(yaw)), np.sin(float(yaw))])
        return bodies_from(
            xyz[:2] + self.vehicle.rear_axle_to_centre_m * direction,
            yaw,
            [self.vehicle.box],
            self.v * direction,
            xyz[2:] + self.vehicle.box.height_m / 2,
        )

    def decide(self, others: Bodies, ahead: PredictedBodies, t_us: int) -> float:
        """Return the wanted acceleration."""
        limit = float(np.interp(self.s + 0.4 * self.v, self.path.s, self.limit))
        wanted = min(1.5 * (limit - self.v), MAX_ACCEL_MPS2)
        half = self.vehicle.box.width_m / 2
        for bodies, margin_m in ((others, 0.3), (self.table.standing, 0.2)):
            leader = find_leader(self.line, self.front_s, half, bodies, margin_m=margin_m)
            if leader.index >= 0:
                closing = self.v - leader.speed_mps
                accel = idm_acceleration(self.v, leader.gap_m, closing, self.params)
                wanted = min(wanted, accel)
        red_m = min(
            red_gap_m(self.lights, self.front_s, self.v, t_us),
            give_way_gap_m(self.give_way, self.path, self.front_s, others, -1),
        )
        if red_m < np.inf:
            wanted = min(wanted, idm_acceleration(self.v, red_m, self.v, self.params))
        if t_us % LOOKAHEAD_US == 0:
            self.cap = yielding_acceleration(
                self.line, self.front_s, self.v, self.vehicle.box, ahead
            )
        return max(min(wanted, self.cap), -MAX_BRAKE_MPS2)

    def advance(self, wanted: float, dt_s: float) -> None:
        step = MAX_JERK_MPS3 * dt_s
        # The brake is released while stopping: v = a^2 / 2 j leaves no jolt at standstill.
        wanted = max(wanted, -float(np.sqrt(2.0 * STOP_JERK_MPS3 * self.v)))
        self.a = min(max(wanted, self.a - step), self.a + step)
        self.a = max(self.a, -self.v / dt_s)  # it stands
        self.s, self.v = moved_on(self.s, self.v, self.a, dt_s)


class _Car:
    """A follower while it drives."""

    def __init__(
        self, f: Follower, lights: Sequence[LightAhead], give_way: Sequence[LightAhead]
    ) -> None:
        self.f, self.s, self.v, self.a = f, f.s_m, f.speed_mps, 0.0
        self.params = IdmParams(**f.params)
        self.lights = lights
        self.give_way = give_way
        self.wanted_mps = bend_speeds(f.path, self.params)
        self.log_s = [self.s]

    @property
    def front_s(self) -> float:
        return self.s + self.f.box.length_m / 2

    def decide(self, leader: Leader, bodies: Bodies, own_row: int, t_us: int) -> None:
        closing = self.v - leader.speed_mps
        stop_m = min(
            red_gap_m(self.lights, self.front_s, self.v, t_us),
            give_way_gap_m(self.give_way, self.f.path, self.front_s, bodies, own_row),
        )
        params = at_place(self.params, self.f.path, self.wanted_mps, self.s)
        self.a = min(
            idm_acceleration(self.v, leader.gap_m, closing, params),
            idm_acceleration(self.v, stop_m, self.v, params),
        )

    def advance(self, dt_s: float) -> None:
        self.s, self.v = moved_on(self.s, self.v, self.a, dt_s)
        self.log_s.append(self.s)

    def driven(self) -> Actor:
        """Return the road user with the track that it drove."""
        s_m = np.array(self.log_s)
        t_us = DECISION_US * np.arange(len(s_m), dtype=np.int64)
        f = self.f
        track = track_on_path(f.path, t_us, s_m, f.box, f.offset_m)
        return Actor(f.actor_id, f.label, f.box, track, behaviour=Behaviour("idm", f.params))


class _Traffic:
    """The followers while they drive, beside those who follow written tracks."""

    def __init__(
        self, followers: Sequence[Follower], lane_map: LaneMap | None, table: ScriptedTracks
    ) -> None:
        self.table = table
        self.cars = [_Car(follower, *_lines_on(follower.path, lane_map)) for follower in followers]
        self.lines = Lines([follower.path for follower in followers]) if followers else None

    def step(self, ahead: PredictedBodies, ego: Bodies | None, t_us: int) -> None:
        """Let the followers drive on for `DECISION_US`.

        Args:
            ahead: As `predicted` says.
            ego: The ego where it takes part in the traffic.
            t_us: Now.
        """
        if self.lines is None:
            return
        beside = [self.table.standing] if ego is None else [self.table.standing, ego]
        everybody = concatenate([*beside, ahead.now()])
        driving = ahead.present[0, len(self.table.boxes) :]
        _let_followers_decide(self.cars, self.lines, everybody, driving, t_us)
        for car in self.cars:
            car.advance(DECISION_US * 1e-6)

    def driven(self) -> tuple[Actor, ...]:
        """Return the followers with the tracks that they drove."""
        return tuple(car.driven() for car in self.cars)

    def predicted(self, t_us: int) -> PredictedBodies:
        """Return scripted tracks as they are written, and reactive cars at their present speed on
        their own lines.
        """
        table = self.table
        rows = table.rows(t_us)
        xy = [table.xy[rows]]
        yaw = [table.yaw[rows]]
        velocity = [table.velocity[rows]]
        present = [table.present[rows]]
        z = [table.z[rows]]
        cars = self.cars
        if self.lines is not None:
            s, v, offset = np.array([(car.s, car.v, car.f.offset_m) for car in cars]).T
            stations = s + v * TIMES_S[:, None]  # (1 + n, K)
            line = np.broadcast_to(np.arange(len(cars)), stations.shape)
            points, heading = self.lines.at(
                line.ravel(), stations.ravel(), np.broadcast_to(offset, stations.shape).ravel()
            )
            heading = heading.reshape(stations.shape)
            xy.append(points[:, :2].reshape(*stations.shape, 2))
            yaw.append(heading)
            velocity.append(v[:, None] * direction_of(heading))
            present.append(stations <= self.lines.length_m)
            half_m = np.array([car.f.box.height_m / 2 for car in cars])
            z.append(points[:, 2].reshape(stations.shape) + half_m)
        return PredictedBodies(
            np.concatenate(xy, axis=1),
            np.concatenate(yaw, axis=1),
            np.concatenate(velocity, axis=1),
            np.concatenate(present, axis=1),
            (*table.boxes, *(car.f.box for car in cars)),
            np.concatenate(z, axis=1),
            np.arange(len(table.boxes) + len(cars)) >= len(table.boxes),
        )


def _let_followers_decide(
    cars: Sequence[_Car], lines: Lines, everybody: Bodies, driving: Bool, t_us: int
) -> None:
    """Let each follower decide by its leader.

    Args:
        cars: The followers.
        lines: The paths of the followers.
        everybody: All bodies; those of the followers that drive are the last.
        driving: ``(F,)`` which followers drive.
        t_us: Now.
    """
    row_of_car = np.full(len(cars), -1)
    n_driving = int(driving.sum())
    row_of_car[driving] = np.arange(len(everybody.xy) - n_driving, len(everybody.xy))
    leaders = find_leaders(
        lines,
        np.arange(len(cars)),
        np.array([car.front_s for car in cars]),
        np.array([car.f.box.width_m / 2 for car in cars]),
        everybody,
        np.full(len(cars), FOLLOWED_M),
        row_of_car,
        lets_merge=True,
    )
    for car, leader, row in zip(cars, leaders, row_of_car.tolist(), strict=True):
        car.decide(leader, everybody, row, t_us)
