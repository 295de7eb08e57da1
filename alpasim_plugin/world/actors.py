"""Road users while a scene is driven: replay of tracks, and drivers that react once the loop is
closed.

Replayed actors exist exactly during their track; some wait for the ego on it. Reactive drivers follow their track until the loop
closes, then drive along the same line, on along the lanes where it ends, and leave the scene at the
end of the map; some change lanes. Where a track turns back on itself, as into a parking place, they stop and stand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.geometry import (
    arc_lengths,
    direction_of,
    heading_of,
    interpolate,
    se2,
    se3,
    slerp,
    unit,
    wrap_angle,
    yaw_from_quat,
    yaw_of,
)
from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    EgoState,
    HeightField,
    LaneMap,
    Scenario,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.world.ground import STACKED_M, ground_pose
from alpasim_plugin.world.idm import (
    Bodies,
    IdmParams,
    Leader,
    at_place,
    bend_speeds,
    bodies_from,
    concatenate,
    find_leaders,
    idm_acceleration,
    moved_on,
    wanted_gap_m,
)
from alpasim_plugin.world.lane_change import KEPT_M, LanesBeside, gain_mps2
from alpasim_plugin.world.path import Lines, Path, polyline_path, smoothstep, thinned
from alpasim_plugin.world.route import LaneIndex
from alpasim_plugin.world.signals import LightAhead, give_way_gap_m, lights_on, red_gap_m
from alpasim_plugin.world.walkers import Walker

MAX_STEP_S = 0.05  # the model is integrated in steps no longer than this
MIN_PATH_M = 1.0  # a reactive driver whose track is shorter than this follows it to its end
LINE_STEP_M = 0.5  # poses nearer to each other than this say nothing about a track's direction
EXTENSION_M = 300.0
SAME_M = 1e-3  # a way that is shorter has no direction
MAX_TURN_RAD = 0.8
FOLD = -0.5  # cosine between two steps of a track, below which it turns back on itself
FADE_M = 20.0
FADE_STEP_M = 2.0
SPEED_SPAN_US = 100_000
CONSIDERS_US = 500_000  # between looks at the lanes beside
CHANGED_US = 6_000_000  # from a change to the next look
DRIVING = ("idm", "adversary")  # behaviours of those who leave their track
# An adversary: share of its speed between which it chooses, gain and time of its control.
SLOWEST = 0.5
FASTEST = 1.5
PULL_PER_S = 1.0
CONTROL_S = 0.5
MAX_ACCEL_MPS2 = 3.0


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
        self.vehicle = vehicle
        self.closed_us = closed_us
        reactive = [actor for actor in actors if actor.behaviour.kind in DRIVING]
        index = LaneIndex(lane_map) if lane_map is not None and reactive else None
        self.drivers = [_Driver(actor, index, ground, lane_map, closed_us) for actor in reactive]
        for number, driver in enumerate(d for d in self.drivers if d.course is not None):
            driver.line = number
        self._beside = None if index is None else LanesBeside(index)
        self.replayed = _Tracks([a for a in actors if a.behaviour.kind not in DRIVING])
        self._on_tracks = _Tracks([d.actor for d in self.drivers if d.course is None])
        self.reset()

    def reset(self) -> None:
        """Go back to the beginning of the scene."""
        self.t_us: int | None = None
        self.walkers = {
            actor.actor_id: Walker(actor)
            for actor in self.replayed.actors
            if actor.behaviour.kind == "yield"
        }
        for driver in self.drivers:
            driver.motion = None
            driver.present = True
        self._put_on_lines()

    def _put_on_lines(self) -> None:
        """Put the ways that the reactive drivers have now into one array."""
        courses = [
            driver.course if driver.motion is None else driver.motion.course
            for driver in self.drivers
        ]
        paths = [course.path for course in courses if course is not None]
        self._lines = Lines(paths) if paths else None

    def step(self, t_us: int, ego: EgoState) -> Mapping[str, F64]:
        """Advance to ``t_us`` and return ``T_world_box`` ``(4, 4)`` of every actor present.

        Reactive drivers take one acceleration from the positions at the last call and hold it over
        the step.
        """
        if self.t_us is not None and t_us > self.closed_us:
            for walker in self.walkers.values():
                walker.step(max(self.t_us, self.closed_us), t_us, ego, self.vehicle)
        replayed, poses, velocity = self.replayed.at(t_us, self.walkers)
        out = {actor.actor_id: pose for actor, pose in zip(replayed, poses, strict=True)}
        if self._lines is not None and self.t_us is not None and t_us > self.closed_us:
            waiting = _bodies_of(*self._on_tracks.at(t_us, {}))
            yaw = yaw_of(ego.T_world_rig)
            direction = direction_of(yaw)
            centre = ego.T_world_rig[:2, 3] + self.vehicle.rear_axle_to_centre_m * direction
            height_m = ego.T_world_rig[2:3, 3] + self.vehicle.box.height_m / 2
            ego_body = bodies_from(
                centre, np.array([yaw]), [self.vehicle.box], ego.speed_mps * direction, height_m
            )
            others = concatenate([ego_body, _bodies_of(replayed, poses, velocity), waiting])
            self._advance(max(self.t_us, self.closed_us), t_us, others)
        for driver in self.drivers:
            pose = driver.pose(t_us, self.closed_us, driver.motion)
            if pose is not None:
                out[driver.actor.actor_id] = pose
        self.t_us = t_us
        return out

    def forecast(self) -> ActorForecast:
        """Return a forecast from the present instant, which does not change as the actors move
        on.
        """
        reactive = [
            (d, None if d.motion is None else replace(d.motion)) for d in self.drivers if d.present
        ]
        walkers = {key: replace(walker) for key, walker in self.walkers.items()}
        return ActorForecast(self.replayed, walkers, tuple(reactive), self.t_us, self.closed_us)

    def _advance(self, from_us: int, to_us: int, others: Bodies) -> None:
        """Move all reactive drivers, who see each other and the others' bodies."""
        n = max(1, int(np.ceil((to_us - from_us) * 1e-6 / MAX_STEP_S)))
        dt_s = (to_us - from_us) * 1e-6 / n
        for driver in self.drivers:
            driver.close(from_us, to_us)
        for _ in range(n):
            driving = [(d, d.motion) for d in self.drivers if d.motion is not None]
            if not driving:
                return
            lines = self._lines
            assert lines is not None
            line = np.array([driver.line for driver, _ in driving])
            moving = _bodies_on_lines(lines, line, driving)
            everybody = concatenate([others, moving])
            boxes = [driver.actor.box for driver, _ in driving]
            leaders = find_leaders(
                lines,
                line,
                np.array([motion.s_m for _, motion in driving]) + moving.half_length_m,
                np.array([box.width_m / 2 for box in boxes]),
                everybody,
                np.array([driver.horizon_m(motion) for driver, motion in driving]),
                np.arange(len(others.xy), len(everybody.xy)),
                lets_merge=True,
            )
            first_moving = len(others.xy)
            changed = False
            # Who changes lanes is in both until it has.
            in_lanes = concatenate([everybody, *_in_new_lanes(driving, to_us)])
            for row, ((driver, motion), leader) in enumerate(zip(driving, leaders, strict=True)):
                accel_mps2 = driver.accel_mps2(motion, leader, everybody, first_moving + row, to_us)
                if motion.since_us > from_us:
                    continue
                surroundings = (in_lanes, first_moving + row)
                if self._beside is not None and driver.change_lane(
                    self._beside, motion, leader, surroundings, to_us
                ):
                    changed = True
                    new_lane = _in_new_lanes([(driver, motion)], to_us)
                    in_lanes = concatenate([in_lanes, *new_lane])
                driver.move(motion, accel_mps2, dt_s)
            if changed:
                self._put_on_lines()


@dataclass(frozen=True)
class ActorForecast:
    """Predicted poses of road users, from what is known at one instant.

    Replayed ones follow their track, those who wait go on waiting, reactive ones keep their speed
    along their line.
    """

    replayed: _Tracks
    walkers: Mapping[str, Walker]
    reactive: tuple[tuple[_Driver, _Motion | None], ...]
    t_us: int | None
    closed_us: int

    def at(self, t_us: int) -> dict[str, F64]:
        """Return ``T_world_box`` ``(4, 4)`` of every actor expected at ``t_us``, not earlier than
        the instant of the forecast.
        """
        waiting = {
            key: replace(w, lag_us=w.lag_us + (1.0 - w.rate) * (t_us - (self.t_us or t_us)))
            for key, w in self.walkers.items()
        }
        replayed, poses, _ = self.replayed.at(t_us, waiting)
        out = {actor.actor_id: pose for actor, pose in zip(replayed, poses, strict=True)}
        for driver, motion in self.reactive:
            if motion is None:
                pose = driver.pose(t_us, t_us, None)
            else:
                assert self.t_us is not None
                ahead_m = motion.speed_mps * (t_us - self.t_us) * 1e-6
                pose = driver.pose(t_us, self.closed_us, replace(motion, s_m=motion.s_m + ahead_m))
            if pose is not None:
                out[driver.actor.actor_id] = pose
        return out


def make_actors(scenario: Scenario) -> Actors:
    """Return the actors of a scenario; the loop closes at ``start_us + warmup_us``."""
    closed_us = scenario.start_us + scenario.warmup_us
    return Actors(scenario.actors, scenario.vehicle, closed_us, scenario.lane_map, scenario.ground)


@dataclass(frozen=True)
class _TrackPiece:
    """The piece of an actor's track that covers a time.

    Attributes:
        actor: Whose track it is.
        t_us: The time on the actor's own clock: a walker's may run slower than the scene's.
        begin, end: Indices of the poses before and after; equal in a track of one pose.
        rate: Seconds of the actor's clock in a second of the scene; 0 for one that stands.
    """

    actor: Actor
    t_us: int
    begin: int
    end: int
    rate: float

    @property
    def span_us(self) -> int:
        """Return the length of the piece, at least a microsecond."""
        times = self.actor.track.t_us
        return max(int(times[self.end] - times[self.begin]), 1)

    @property
    def share(self) -> float:
        """Return how much of the piece has passed, 0 to 1."""
        return (self.t_us - int(self.actor.track.t_us[self.begin])) / self.span_us


def _track_piece(actor: Actor, scene_us: int, walker: Walker | None) -> _TrackPiece | None:
    """Return the piece of a track at a time; None where the track does not cover it."""
    track = actor.track
    t_us = scene_us if walker is None else walker.own_us(scene_us)
    if not track.t_us[0] <= t_us <= track.t_us[-1]:
        return None
    end = min(int(np.searchsorted(track.t_us, t_us, side="right")), len(track) - 1)
    rate = float(not actor.is_static) if walker is None else walker.rate
    return _TrackPiece(actor, t_us, max(end - 1, 0), end, rate)


class _Tracks:
    """Actors that follow their tracks, with an index of when each track begins and ends.

    A step looks only at tracks that cover it: in a town most road users come and go. Walkers have
    clocks of their own and are always looked at.
    """

    def __init__(self, actors: Sequence[Actor]) -> None:
        self.actors = tuple(actors)
        self.first_us = np.array([actor.track.t_us[0] for actor in actors], dtype=np.int64)
        self.last_us = np.array([actor.track.t_us[-1] for actor in actors], dtype=np.int64)
        self.yields = np.array(
            [actor.behaviour.kind == "yield" for actor in actors], dtype=np.bool_
        )

    def at(self, scene_us: int, walkers: Mapping[str, Walker]) -> tuple[list[Actor], F64, F64]:
        """Return the actors whose track covers a time, their poses ``(N, 4, 4)`` there, and their
        velocities ``(N, 2)`` in the track's current piece; those that stand have none.
        """
        covers = (self.first_us <= scene_us) & (scene_us <= self.last_us)
        pieces = []
        for index in np.flatnonzero(covers | self.yields):
            actor = self.actors[index]
            piece = _track_piece(actor, scene_us, walkers.get(actor.actor_id))
            if piece is not None:
                pieces.append(piece)
        if not pieces:
            return [], np.zeros((0, 4, 4)), np.zeros((0, 2))
        share = np.array([piece.share for piece in pieces])
        xyz = np.array([piece.actor.track.xyz[piece.begin] for piece in pieces])
        step = np.array([piece.actor.track.xyz[piece.end] for piece in pieces]) - xyz
        quat_begin = np.array([piece.actor.track.quat[piece.begin] for piece in pieces])
        quat_end = np.array([piece.actor.track.quat[piece.end] for piece in pieces])
        poses = se3(xyz + share[:, None] * step, slerp(quat_begin, quat_end, share))
        steps_per_s = np.array([piece.rate * 1e6 / piece.span_us for piece in pieces])
        velocity_mps = step[:, :2] * steps_per_s[:, None]
        return [piece.actor for piece in pieces], poses, velocity_mps


def _bodies_of(actors: Sequence[Actor], poses: F64, velocity_mps: F64) -> Bodies:
    """Return road users with poses ``(N, 4, 4)`` and velocities ``(N, 2)`` as bodies."""
    return bodies_from(
        poses[:, :2, 3],
        heading_of(poses[:, :2, 0]),
        [actor.box for actor in actors],
        velocity_mps,
        poses[:, 2, 3],
    )


def _bodies_on_lines(lines: Lines, line: I64, driving: Sequence[tuple[_Driver, _Motion]]) -> Bodies:
    """Return reactive drivers, each on its line ``(N,)``, as bodies."""
    s_m, offset_m, speed_mps = np.array([(m.s_m, m.offset_m, m.speed_mps) for _, m in driving]).T
    xyz, yaws = lines.at(line, s_m, offset_m)
    boxes = [driver.actor.box for driver, _ in driving]
    velocity = speed_mps[:, None] * direction_of(yaws)
    return bodies_from(xyz[:, :2], yaws, boxes, velocity, xyz[:, 2])


def _in_new_lanes(driving: Sequence[tuple[_Driver, _Motion]], t_us: int) -> list[Bodies]:
    """Return the drivers that change lanes now as bodies in the lanes into which they do, abreast of
    where they are.
    """
    out = []
    for driver, motion in driving:
        if motion.into is None or t_us >= motion.considers_us:
            continue
        place, _ = motion.course.path.at(motion.s_m, motion.offset_m)
        xyz, yaw = motion.into.at(float(motion.into.project(place[None, :2])[0][0]))
        velocity = motion.speed_mps * direction_of(float(yaw))
        out.append(bodies_from(xyz[:2], yaw, [driver.actor.box], velocity, xyz[2]))
    return out


@dataclass(frozen=True)
class _Course:
    """A driver's way, and what stands on it.

    Attributes:
        path: Of the middle of its box.
        lights, give_way: Lines at which to stop.
        wanted_mps: ``(N,)`` speeds that bends allow; None: any.
    """

    path: Path
    lights: tuple[LightAhead, ...] = ()
    give_way: tuple[LightAhead, ...] = ()
    wanted_mps: F64 | None = None

    @classmethod
    def along(cls, path: Path, lane_map: LaneMap | None, params: IdmParams) -> _Course:
        """Return the way along a path of a driver on a map."""
        if lane_map is None:
            return cls(path)
        return cls(
            path,
            lights_on(path, lane_map.signals, lane_map.lanes),
            lights_on(path, lane_map.give_way, lane_map.lanes),
            bend_speeds(path, params),
        )


@dataclass
class _Motion:
    """Where a reactive driver is on its line."""

    course: _Course
    s_m: float
    speed_mps: float
    offset_m: float  # left of the line, kept
    since_us: int  # when it left its track
    considers_us: int = 0  # when it next looks whether to change lanes
    into: Path | None = None  # the middle of the lane into which it changes


@dataclass(frozen=True)
class _TrackLine:
    """A track as a line without time, as far as it can be driven forwards.

    Attributes:
        xyz: ``(N, 3)`` metres, world.
        t_us: ``(N,)`` when the track is there.
        folds: Whether the track turns back on itself behind the line.
    """

    xyz: F64
    t_us: I64
    folds: bool

    @classmethod
    def of(cls, track: Trajectory) -> _TrackLine:
        """Return the line of a track up to where it first turns back on itself."""
        kept = thinned(track.xyz, LINE_STEP_M)
        steps = unit(np.diff(track.xyz[kept, :2], axis=0))
        turns_back = np.flatnonzero(np.sum(steps[1:] * steps[:-1], axis=1) < FOLD)
        if len(turns_back):
            kept = kept[: turns_back[0] + 2]
        return cls(track.xyz[kept], track.t_us[kept], len(turns_back) > 0)

    def is_driven(self, heading_rad: float, from_us: int) -> bool:
        """Return whether a vehicle that heads as the track does at its begin can drive along the line
        from a time on: forwards, farther than `MIN_PATH_M`, and not yet at the fold.
        """
        away_m = np.hypot(*(self.xyz[:, :2] - self.xyz[0, :2]).T)
        if float(away_m.max()) < MIN_PATH_M:
            return False
        begins = self.xyz[1, :2] - self.xyz[0, :2]
        forwards = float(begins @ direction_of(heading_rad)) >= 0.0
        return forwards and not (self.folds and from_us >= self.t_us[-1])


class _Driver:
    """A reactive driver: its line and its number among all lines, its state, its model."""

    def __init__(
        self,
        actor: Actor,
        index: LaneIndex | None,
        ground: HeightField | None,
        lane_map: LaneMap | None,
        closed_us: int,
    ) -> None:
        self.actor = actor
        self.ground = ground
        self.act = actor.behaviour.params if actor.behaviour.kind == "adversary" else None
        self.params = IdmParams(**({} if self.act else actor.behaviour.params))
        line = _TrackLine.of(actor.track)
        self.stands_at_end = line.folds
        self.lane_map = lane_map
        self.course: _Course | None = None
        takeover_us = max(closed_us, int(actor.track.t_us[0]))
        if line.is_driven(float(yaw_from_quat(actor.track.quat[0])), takeover_us):
            path = _with_lanes_ahead(line, index, actor.box.height_m / 2)
            self.course = _Course.along(path, lane_map, self.params)
            self._vertex_us = line.t_us
        self.line = -1
        self.motion: _Motion | None = None
        self.present = True

    def close(self, from_us: int, to_us: int) -> None:
        """Take the state over from the track, once, when the track has begun."""
        first = int(self.actor.track.t_us[0])
        last = int(self.actor.track.t_us[-1])
        if self.motion is not None or not self.present or self.course is None or to_us < first:
            return
        if from_us > last:
            self.present = False  # the track ended while the log was forced
            return
        # Who comes into the scene within the step is then where its track is at the end of it.
        takeover_us = from_us if first <= from_us else min(to_us, last)
        lo = max(first, takeover_us - SPEED_SPAN_US)
        hi = min(last, takeover_us + SPEED_SPAN_US)
        s_m, offset_m = self._place_on_track(takeover_us)
        ahead_m = self._place_on_track(hi)[0] - self._place_on_track(lo)[0]
        speed_mps = ahead_m / ((hi - lo) * 1e-6) if hi > lo else 0.0
        since_us = from_us if first <= from_us else to_us
        self.motion = _Motion(self.course, s_m, max(0.0, speed_mps), offset_m, since_us)

    def _place_on_track(self, t_us: int) -> tuple[float, float]:
        """Return where the track is at a time: arc length on the driver's line and offset to its
        left. A track may pass the same place several times.
        """
        assert self.course is not None
        path = self.course.path
        stations = path.s[: len(self._vertex_us)]
        about_m = np.interp(
            t_us - self._vertex_us[0], self._vertex_us - self._vertex_us[0], stations
        )
        return path.project_about(interpolate(self.actor.track, t_us)[:2, 3], float(about_m))

    def horizon_m(self, motion: _Motion) -> float:
        """Return how far the driver looks: twice the wanted gap behind a standing leader, beyond
        which the interaction is below a quarter of the own acceleration.
        """
        return 20.0 + 2.0 * wanted_gap_m(motion.speed_mps, motion.speed_mps, self.params)

    def accel_mps2(
        self, motion: _Motion, leader: Leader, bodies: Bodies, row: int, t_us: int
    ) -> float:
        """Return the acceleration behind a leader and before a line to stop at; of an adversary that
        by which it acts on the ego, the first of the bodies.
        """
        course = motion.course
        speed_mps = motion.speed_mps
        front_m = motion.s_m + self.actor.box.length_m / 2
        closing_mps = speed_mps - leader.speed_mps
        params = at_place(self.params, course.path, course.wanted_mps, motion.s_m)
        behind = idm_acceleration(speed_mps, leader.gap_m, closing_mps, params)
        if self.act is not None:
            against = self._against_ego_mps2(motion, bodies, self.act)
            return against if leader.index <= 0 else min(against, behind)
        stop_m = min(
            red_gap_m(course.lights, front_m, speed_mps, t_us),
            give_way_gap_m(course.give_way, course.path, front_m, bodies, row),
        )
        if self.stands_at_end:
            stop_m = min(stop_m, course.path.length_m - motion.s_m + self.params.min_gap_m)
        return min(behind, idm_acceleration(speed_mps, stop_m, speed_mps, params))

    def _against_ego_mps2(self, motion: _Motion, bodies: Bodies, act: Mapping[str, float]) -> float:
        """Return the acceleration of an adversary: up to the place where it acts it tries to be
        ``gap_m`` ahead of the ego, within bounds of its speed; from there on it takes another speed.
        """
        act_s_m, _ = self._place_on_track(round(act["act_us"]))
        ego_s_m = float(motion.course.path.project(bodies.xy[:1])[0][0])
        wanted_mps = act["end_speed_mps"]
        if motion.s_m < act_s_m:
            front_m = ego_s_m + float(bodies.half_length_m[0]) + act["gap_m"]
            ahead_m = front_m + self.actor.box.length_m / 2 - motion.s_m
            ego_mps = float(np.hypot(*bodies.velocity[0]))
            least_mps = SLOWEST * act["speed_mps"]
            most_mps = FASTEST * act["speed_mps"]
            wanted_mps = min(max(ego_mps + PULL_PER_S * ahead_m, least_mps), most_mps)
        accel = (wanted_mps - motion.speed_mps) / CONTROL_S
        return min(max(accel, -act["decel_mps2"]), MAX_ACCEL_MPS2)

    def change_lane(
        self,
        beside: LanesBeside,
        motion: _Motion,
        leader: Leader,
        surroundings: tuple[Bodies, int],
        t_us: int,
    ) -> bool:
        """Take the way into a lane beside where that is worth it, and return whether it is. Lights and
        lines to give way at hold both lanes, so that only leaders are compared.

        Args:
            beside: Finds such lanes.
            motion: Where the driver is; its course changes.
            leader: Whom it follows if it stays.
            surroundings: Everybody, and the driver's row among them.
            t_us: Now.
        """
        if self.act is not None or self.stands_at_end:  # its way is a part of the scene
            return False
        params = at_place(self.params, motion.course.path, motion.course.wanted_mps, motion.s_m)
        free_mps2 = idm_acceleration(motion.speed_mps, np.inf, 0.0, params)
        closing_mps = motion.speed_mps - leader.speed_mps
        now_mps2 = idm_acceleration(motion.speed_mps, leader.gap_m, closing_mps, params)
        nothing_to_gain = not free_mps2 - now_mps2 > params.change_gain_mps2
        if nothing_to_gain or t_us < motion.considers_us:
            return False
        motion.considers_us = t_us + CONSIDERS_US
        motion.into = None
        path = motion.course.path
        place = (path, motion.s_m, motion.speed_mps)
        changes = beside.changes(*place, self.actor.box.height_m / 2)
        gains = [gain_mps2(change, *place, now_mps2, *surroundings, params) for change in changes]
        if not gains or max(gains) <= params.change_gain_mps2:
            return False
        change = changes[int(np.argmax(gains))]
        way = change.way
        place_xyz, _ = path.at(motion.s_m, motion.offset_m)
        s_m, offset_m = way.project_about(place_xyz[:2], min(motion.s_m, KEPT_M))
        motion.course = _Course.along(way, self.lane_map, self.params)
        motion.s_m, motion.offset_m = s_m, offset_m
        motion.considers_us = t_us + CHANGED_US
        motion.into = change.along
        return True

    def move(self, motion: _Motion, accel_mps2: float, dt_s: float) -> None:
        """Drive on; the driver leaves the scene at the end of its line, or stands there."""
        motion.s_m, motion.speed_mps = moved_on(motion.s_m, motion.speed_mps, accel_mps2, dt_s)
        length_m = motion.course.path.length_m
        if motion.s_m > length_m and self.stands_at_end:
            motion.s_m, motion.speed_mps = length_m, 0.0
        if motion.s_m > length_m:
            self.present = False
            self.motion = None

    def pose(self, t_us: int, closed_us: int, motion: _Motion | None) -> F64 | None:
        """Return the pose of the box centre for a state of motion (None: on the track), or None
        where the actor is not in the scene.
        """
        if motion is None:
            first = int(self.actor.track.t_us[0])
            last = int(self.actor.track.t_us[-1])
            on_track = (
                first <= t_us <= last
                and self.present
                and (t_us <= closed_us or self.course is None)
            )
            return interpolate(self.actor.track, t_us) if on_track else None
        path = motion.course.path
        if motion.s_m > path.length_m and not self.stands_at_end:
            return None
        xyz, yaw = path.at(motion.s_m, motion.offset_m)
        if self.ground is None:
            return se2(float(xyz[0]), float(xyz[1]), float(yaw), float(xyz[2]))
        T = ground_pose(self.ground, float(xyz[0]), float(xyz[1]), float(yaw))
        T[:3, 3] += self.actor.box.height_m / 2 * T[:3, 2]
        if (
            abs(T[2, 3] - xyz[2]) > STACKED_M
        ):  # the line runs on a bridge above that ground, or below
            return se2(float(xyz[0]), float(xyz[1]), float(yaw), float(xyz[2]))
        return T


def _with_lanes_ahead(line: _TrackLine, index: LaneIndex | None, half_height_m: float) -> Path:
    """Return the path of a track's line, and on along the lanes unless the track folds there; the
    track is that of the middle of a box, half its height above the ground.
    """
    path = polyline_path(line.xyz)
    if index is None or line.folds:
        return path
    end, heading = path.at(path.length_m)
    ahead = _lanes_ahead(index, end, float(heading), half_height_m)
    return path if ahead is None else polyline_path(np.concatenate([line.xyz, ahead]))


def _lanes_ahead(index: LaneIndex, end: F64, heading: float, half_height_m: float) -> F64 | None:
    """Return the way on from the end of a track: the lane below it that runs the same way, and what
    follows it.
    """
    below = end - np.array([0.0, 0.0, half_height_m])
    turns = {
        lane: abs(float(wrap_angle(index.heading_rad(lane, end) - heading)))
        for lane in index.containing(below)
    }
    lane = min(turns, key=lambda lane_id: turns[lane_id], default=None)
    if lane is None or turns[lane] >= MAX_TURN_RAD:
        return None
    xyz = index.path_ahead(lane, EXTENSION_M, start=end).xyz
    if float(arc_lengths(xyz)[-1]) < SAME_M:  # the map ends here
        return None
    way = polyline_path(xyz)
    _, offset = way.project(end[None, :2])
    # The track need not run in the lane's middle: keep its offset and fade it out.
    s = np.arange(FADE_STEP_M, way.length_m, FADE_STEP_M)
    points, _ = way.at(s, float(offset[0]) * (1.0 - smoothstep(s / FADE_M)))
    points[:, 2] += end[2] - xyz[0, 2]
    return points
