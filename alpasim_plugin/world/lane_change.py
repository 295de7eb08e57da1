"""When a driver changes lanes: MOBIL beside the Intelligent Driver Model.

Source: A. Kesting, M. Treiber, D. Helbing, "General Lane-Changing Model MOBIL for Car-Following
    Models",
Transportation Research Record 1999 (2007), the safety criterion (equation 2) and the symmetric
incentive criterion (equation 3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.geometry import wrap_angle
from alpasim_plugin.core.types import F64, Lane, LaneMap
from alpasim_plugin.world.idm import (
    Bodies,
    IdmParams,
    Leader,
    find_leaders,
    idm_acceleration,
)
from alpasim_plugin.world.path import Lines, Path, polyline_path, smoothstep
from alpasim_plugin.world.precedence import chains_to, lanes_before
from alpasim_plugin.world.route import LaneIndex

CHANGE_S = 4.0  # a change takes so long ...
SHORTEST_M = 15.0  # ... and at least this way
BEHIND_M = 60.0  # followers are looked for so far behind
AHEAD_M = 300.0  # leaders are looked for so far ahead, and a new way leads at least so far
KEPT_M = 10.0  # of the own way behind the driver, which its rear is still on
STEP_M = 2.0  # between points of a change
ALONG_RAD = 0.3  # between lanes side by side that are driven the same way, at most
IN_LANE_M = 1.5  # from its middle
SAME_WAY = 0.7  # cosine between a lane and those who follow on it


@dataclass(frozen=True)
class Change:
    """A change into a lane beside.

    Attributes:
        way: From `KEPT_M` behind the driver into the lane and on along it.
        along: The middle of the lane, from behind the driver on.
    """

    way: Path
    along: Path


class LanesBeside:
    """Finds the lanes into which drivers may change.

    Args:
        index: The map's lanes.
    """

    def __init__(self, index: LaneIndex) -> None:
        self._index = index
        self._lanes: Mapping[str, Lane] = index.lane_map.lanes
        self._before = lanes_before(self._lanes)

    @classmethod
    def of(cls, lane_map: LaneMap) -> LanesBeside:
        """Return those of a map."""
        return cls(LaneIndex(lane_map))

    def changes(
        self, path: Path, s_m: float, speed_mps: float, half_height_m: float
    ) -> list[Change]:
        """Return the changes that a driver can make: into lanes that run beside its own, outside of
        junctions and for as long as a change takes.

        Args:
            path: Of the middle of its box.
            s_m: Where it is.
            speed_mps: Its speed.
            half_height_m: Of its box.
        """
        place, yaw = path.at(s_m)
        foot = place - np.array([0.0, 0.0, half_height_m])
        length_m = max(CHANGE_S * speed_mps, SHORTEST_M)
        current = next(
            (key for key in self._index.containing(foot) if self._is_along(key, foot, yaw)), None
        )
        if current is None or self._lanes[current].is_intersection:
            return []
        beside = (self._lanes[current].left_neighbour, self._lanes[current].right_neighbour)
        out = []
        for key in beside:
            if key is None or key not in self._lanes or not self._is_along(key, foot, yaw):
                continue
            along = self._along(key, half_height_m, max(AHEAD_M, path.length_m - s_m))
            at_m, offset_m = (float(a[0]) for a in along.path.project(place[None, :2]))
            if along.end_m - at_m >= length_m:
                out.append(
                    Change(_change(path, s_m, along.path, at_m, offset_m, length_m), along.path)
                )
        return out

    def _is_along(self, key: str, place: F64, yaw: F64) -> bool:
        """Return whether a lane is one for cars that runs along a heading at a place."""
        turn_rad = float(wrap_angle(self._index.heading_rad(key, place) - yaw))
        return self._lanes[key].kind == "vehicle" and abs(turn_rad) < ALONG_RAD

    def _along(self, key: str, half_height_m: float, ahead_m: float) -> _Along:
        """Return the middle of a lane with those before it, and with those behind it for ``ahead_m``."""
        chain = chains_to(key, self._lanes, self._before, BEHIND_M)[0]
        line = np.concatenate([self._lanes[name].centre for name in chain])
        end_m = polyline_path(line).length_m
        ahead = self._index.path_ahead(key, ahead_m, start=line[-1]).xyz
        xyz = np.concatenate([line, ahead])
        xyz[:, 2] += half_height_m
        return _Along(polyline_path(xyz), end_m)


@dataclass(frozen=True)
class _Along:
    """The middle of a lane, and where on it the lane ends."""

    path: Path
    end_m: float


def _change(
    path: Path, s_m: float, along: Path, at_m: float, offset_m: float, length_m: float
) -> Path:
    """Return the way from a place on a path into the middle of a lane.

    Args:
        path: The own way.
        s_m: Where the driver is on it.
        along: The middle of the lane.
        at_m: Abreast of the driver.
        offset_m: Of the driver, to the left of the middle.
        length_m: Of the change.
    """
    behind = path.at(np.arange(max(s_m - KEPT_M, 0.0), s_m - STEP_M / 2, STEP_M))[0]
    stations = np.arange(at_m, along.length_m, STEP_M)
    share = 1.0 - smoothstep((stations - at_m) / length_m)
    return polyline_path(np.concatenate([behind, along.at(stations, offset_m * share)[0]]))


def gain_mps2(
    change: Change,
    path: Path,
    s_m: float,
    speed_mps: float,
    now_mps2: float,
    bodies: Bodies,
    row: int,
    params: IdmParams,
) -> float:
    """Return the incentive of a change: what the driver gains in acceleration, and `politeness`
    times what its followers gain; minus infinity where the new follower had to brake harder than
    `safe_brake_mps2`.

    Args:
        change: The change.
        path: The driver's way.
        s_m: Where it is.
        speed_mps: Its speed.
        now_mps2: Its acceleration behind its leader.
        bodies: Everybody.
        row: The driver's row among them.
        params: The driver, whose parameters stand for its followers' too.
    """
    at_m = float(change.along.project(bodies.xy[row : row + 1])[0][0])
    in_own_lane = _Place(path, s_m, bodies, row)
    in_new_lane = _Place(change.along, at_m, bodies, row)
    new_leader = in_new_lane.leader()
    closing_mps = speed_mps - new_leader.speed_mps
    then_mps2 = idm_acceleration(speed_mps, new_leader.gap_m, closing_mps, params)
    follower = in_new_lane.follower()
    joined_mps2 = follower.behind(speed_mps, follower.gap_m, params)
    if joined_mps2 < -params.safe_brake_mps2:
        return -np.inf
    length_m = 2 * float(bodies.half_length_m[row])
    alone_mps2 = follower.behind(
        new_leader.speed_mps, follower.gap_m + length_m + new_leader.gap_m, params
    )
    left = in_own_lane.follower()
    old_leader = in_own_lane.leader()
    left_mps2 = left.behind(old_leader.speed_mps, left.gap_m + length_m + old_leader.gap_m, params)
    held_mps2 = left.behind(speed_mps, left.gap_m, params)
    others_mps2 = joined_mps2 - alone_mps2 + left_mps2 - held_mps2
    return then_mps2 - now_mps2 + params.politeness * others_mps2


@dataclass(frozen=True)
class _Follower:
    """Who drives behind, and how far behind the driver's rear; infinitely far: nobody."""

    gap_m: float
    speed_mps: float

    def behind(self, leader_mps: float, gap_m: float, params: IdmParams) -> float:
        """Return its acceleration behind a leader at a gap, if it drives as fast as it wants to."""
        wanted_mps = max(params.desired_speed_mps, self.speed_mps)
        driver = replace(params, desired_speed_mps=wanted_mps)
        return idm_acceleration(self.speed_mps, gap_m, self.speed_mps - leader_mps, driver)


@dataclass(frozen=True)
class _Place:
    """A driver's place in a lane, its own one or the one beside."""

    path: Path
    s_m: float
    bodies: Bodies
    row: int

    def leader(self) -> Leader:
        """Return who drives ahead."""
        front_m = self.s_m + self.bodies.half_length_m[self.row]
        return find_leaders(
            Lines([self.path]),
            np.zeros(1, dtype=np.int64),
            np.array([front_m]),
            self.bodies.half_width_m[self.row : self.row + 1],
            self.bodies,
            np.array([AHEAD_M]),
            np.array([self.row]),
            lets_merge=True,
        )[0]

    def follower(self) -> _Follower:
        """Return who drives behind, or beside with its nose not ahead of the driver's."""
        s_m, offset_m = self.path.project(self.bodies.xy)
        _, yaw = self.path.at(s_m)
        behind_m = self.s_m - s_m
        counts = (np.abs(offset_m) < IN_LANE_M) & (np.cos(self.bodies.yaw - yaw) > SAME_WAY)
        # A longer driver is abreast of bodies whose middle is ahead of its own.
        nose_behind_m = behind_m + self.bodies.half_length_m[self.row] - self.bodies.half_length_m
        counts &= (nose_behind_m >= 0.0) & (behind_m < BEHIND_M)
        counts[self.row] = False
        if not counts.any():
            return _Follower(np.inf, 0.0)
        nearest = int(np.argmin(np.where(counts, behind_m, np.inf)))
        half_m = float(self.bodies.half_length_m[nearest] + self.bodies.half_length_m[self.row])
        speed_mps = float(np.hypot(*self.bodies.velocity[nearest]))
        return _Follower(float(behind_m[nearest]) - half_m, speed_mps)
