"""Where other road users will be: vehicles along the lanes that they are on, up to where they have
to stop, and everybody else straight on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, direction_of, wrap_angle, yaw_of
from alpasim_plugin.core.types import F64, Actor, Box, LaneMap
from alpasim_plugin.world.path import Path, polyline_path
from alpasim_plugin.world.route import LaneIndex
from alpasim_plugin.world.signals import LightAhead, lights_on, red_gap_m
from alpasim_plugin.world.yielding import TIMES_S, PredictedBodies

AHEAD_M = 150.0  # behind the end of a lane, along those that turn least
ALONG_RAD = 0.5  # between a vehicle and the lane that it drives along, at most
LATERAL_MPS = 0.3  # who moves sideways by less stays where it is in its lane
MOVES_MPS = 0.5
WALKERS = ("pedestrian", "person")


@dataclass(frozen=True)
class RoadUser:
    """A road user at one instant.

    Attributes:
        T_world_box: ``(4, 4)`` pose of the middle of its box.
        box: Its size.
        velocity: ``(2,)`` m/s, world.
        label: What it is.
    """

    T_world_box: F64
    box: Box
    velocity: F64
    label: str

    @property
    def speed_mps(self) -> float:
        """Give the speed."""
        return float(np.hypot(*self.velocity))


class RoadUsers:
    """Road users with their velocities, which are estimated from two observations.

    Args:
        actors: Their sizes and kinds.
    """

    def __init__(self, actors: Sequence[Actor]) -> None:
        self._actors = {actor.actor_id: actor for actor in actors}
        self._last: tuple[int, Mapping[str, F64]] | None = None

    def observed(self, t_us: int, poses: Mapping[str, F64]) -> list[RoadUser]:
        """Return who is there; one that was not there before stands, as far as is known."""
        before_us, before = self._last or (t_us, {})
        self._last = t_us, dict(poses)
        dt_s = (t_us - before_us) * 1e-6
        out = []
        for name, T in poses.items():
            actor = self._actors[name]
            velocity = np.zeros(2)
            if name in before and dt_s > 0.0:
                velocity = (T[:2, 3] - before[name][:2, 3]) / dt_s
            out.append(RoadUser(T, actor.box, velocity, actor.label))
        return out


@dataclass(frozen=True)
class _LaneAhead:
    """A lane and what follows it, as a line, and the lines at which one stops on it."""

    path: Path
    lights: tuple[LightAhead, ...]
    give_way: tuple[LightAhead, ...]


class RoadForecast:
    """Predicts road users on a map.

    Args:
        lane_map: The map.
        route_lanes: Lanes of who asks. At lines to give way at that name the lanes which go first,
            others are expected to stop where these are among them.
    """

    def __init__(self, lane_map: LaneMap, route_lanes: Sequence[str] = ()) -> None:
        self._map = lane_map
        self._stops = tuple(
            line
            for line in lane_map.give_way
            if not line.yields_to or not set(line.yields_to).isdisjoint(route_lanes)
        )
        self._index = LaneIndex(lane_map)
        self._ahead: dict[str, _LaneAhead] = {}

    def predicted(self, users: Sequence[RoadUser], t_us: int) -> PredictedBodies:
        """Return where road users are now and after each further time of `TIMES_S`."""
        n = len(TIMES_S)
        xy = np.zeros((n, len(users), 2))
        yaw = np.zeros((n, len(users)))
        z = np.zeros((n, len(users)))
        for column, user in enumerate(users):
            xyz, yaw[:, column] = self._places(user, t_us)
            xy[:, column], z[:, column] = xyz[:, :2], xyz[:, 2]
        velocity = np.diff(xy, axis=0, append=xy[-1:]) / (TIMES_S[1] - TIMES_S[0])
        velocity[0] = np.array([user.velocity for user in users]).reshape(-1, 2)
        boxes = tuple(user.box for user in users)
        present = np.ones((n, len(users)), dtype=np.bool_)
        yields = np.zeros(len(users), dtype=np.bool_)
        return PredictedBodies(xy, yaw, velocity, present, boxes, z, yields)

    def _places(self, user: RoadUser, t_us: int) -> tuple[F64, F64]:
        """Return the places ``(n, 3)`` and headings ``(n,)`` of one road user."""
        T = user.T_world_box
        yaw = float(yaw_of(T))
        lane = None
        if user.label not in WALKERS and user.speed_mps > MOVES_MPS:
            ground = T[:3, 3] - user.box.height_m / 2 * T[:3, 2]
            lane = self._lane_of(ground, float(np.arctan2(user.velocity[1], user.velocity[0])))
        if lane is None:
            step = np.append(user.velocity, 0.0)
            return T[:3, 3] + TIMES_S[:, None] * step, np.full(len(TIMES_S), yaw)
        return self._along(lane, user, t_us)

    def _lane_of(self, xyz: F64, heading_rad: float) -> _LaneAhead | None:
        """Return the lane at a place whose direction is nearest to a heading."""
        turns = {
            key: abs(float(wrap_angle(self._index.heading_rad(key, xyz) - heading_rad)))
            for key in self._index.containing(xyz)
        }
        key = min(turns, key=lambda name: turns[name], default=None)
        if key is None or turns[key] > ALONG_RAD:
            return None
        if key not in self._ahead:
            lanes = self._map.lanes
            lane_m = float(arc_lengths(lanes[key].centre)[-1])
            path = polyline_path(self._index.path_ahead(key, lane_m + AHEAD_M).xyz)
            self._ahead[key] = _LaneAhead(
                path,
                lights_on(path, self._map.signals, lanes),
                lights_on(path, self._stops, lanes),
            )
        return self._ahead[key]

    def _along(self, lane: _LaneAhead, user: RoadUser, t_us: int) -> tuple[F64, F64]:
        """Return places and headings of a vehicle that drives along a lane, keeps moving sideways in
        it, and stops where it has to.
        """
        T = user.T_world_box
        s_m, offset_m = (float(array[0]) for array in lane.path.project(T[None, :2, 3]))
        forward = direction_of(float(lane.path.at(s_m)[1]))
        along_mps = float(user.velocity @ forward)
        left_mps = float(user.velocity @ np.array([-forward[1], forward[0]]))
        front_m = s_m + user.box.length_m / 2
        stop_m = red_gap_m(lane.lights, front_m, along_mps, t_us)
        for line in lane.give_way:
            if line.s_m >= front_m:
                stop_m = min(stop_m, line.s_m - front_m)
        gone_m = np.minimum(along_mps * TIMES_S, max(stop_m, 0.0))
        aside_m = left_mps * TIMES_S if abs(left_mps) > LATERAL_MPS else 0.0 * TIMES_S
        xyz, yaw = lane.path.at(s_m + gone_m, offset_m + aside_m)
        xyz[:, 2] = T[2, 3] + xyz[:, 2] - xyz[0, 2]
        xyz[0, :2] = T[:2, 3]
        return xyz, yaw
