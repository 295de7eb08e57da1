"""The privileged expert that the learned policy imitates: a recovery path to the lane centre, and a
speed profile.

The expert knows the exact reference line, its curvature, all actors and where they will be: it lets
pass whoever will come into its way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.geometry import inverse, speeds
from alpasim_plugin.core.types import F64, Actor, Bool, Box, Vehicle
from alpasim_plugin.world.idm import (
    Bodies,
    IdmParams,
    Leader,
    allowed_speeds,
    find_leader,
    idm_acceleration,
)
from alpasim_plugin.world.path import Lines, Path
from alpasim_plugin.world.yielding import PredictedBodies, yielding_acceleration
from policies.base import follow, make_path
from policies.learned_net import KNOTS_M, TIMES_S, path_grid
from scenarios.expert import ScriptedTracks

STEP_S = 0.1
FORECAST_S = 0.5  # between the instants of a forecast
DECISION_STEPS = 4  # between two forecasts of the other road users
LATERAL_MPS2 = 2.0
ACCEL_MPS2 = 1.5
BRAKE_MPS2 = 2.0
HARD_BRAKE_MPS2 = 7.0
LINE_BEFORE_M = 4.0
LINE_AHEAD_M = 80.0
MIN_PURSUIT_MPS = 4.0  # so that a stationary car has a path too
SIGHT_M = 60.0  # objects beyond cover only a few pixels of the image
SIDE_SIGHT_M = 42.0  # the same, of the smaller views to the sides


@dataclass(frozen=True)
class DrivingStyle:
    """Desired speed and car-following parameters of a driver."""

    desired_mps: float
    headway_s: float = 1.5
    min_gap_m: float = 3.5
    brake_mps2: float = BRAKE_MPS2

    @property
    def idm(self) -> IdmParams:
        """Parameters of the intelligent driver model (IDM)."""
        return IdmParams(
            max(self.desired_mps, 1.0),
            self.headway_s,
            self.min_gap_m,
            ACCEL_MPS2,
            self.brake_mps2,
            HARD_BRAKE_MPS2,
        )


@dataclass(frozen=True)
class ReferenceLine:
    """A path with speed limits from its curvature."""

    path: Path
    limit_mps: F64  # (N,) at the path's stations

    @staticmethod
    def along(path: Path, fastest_mps: float) -> ReferenceLine:
        """Return the line with its speed limits, at most ``fastest_mps``."""
        return ReferenceLine(path, allowed_speeds(path, fastest_mps, LATERAL_MPS2))


@dataclass(frozen=True)
class RightOfWay:
    """The other road users of a scene, whom a car on a line lets pass if they come into its way."""

    table: ScriptedTracks
    line: Lines  # one path
    box: Box  # of the car
    front_m: float  # from the rear axle to the front bumper

    @staticmethod
    def along(path: Path, vehicle: Vehicle, actors: Sequence[Actor], end_us: int) -> RightOfWay:
        """Return what a car on a path knows until ``end_us``.

        Who moves is as much longer as it goes between two instants of the forecast, so that it does
        not pass unnoticed between them.
        """
        front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
        longer = []
        for actor in actors:
            length_m = actor.box.length_m + FORECAST_S * speeds(actor.track).max()
            longer.append(replace(actor, box=replace(actor.box, length_m=length_m)))
        return RightOfWay(ScriptedTracks(longer, end_us), Lines([path]), vehicle.box, front_m)

    def in_sight(self, t_us: int, s_m: float) -> Bool:
        """Return which of the others ``(K,)`` are within `SIDE_SIGHT_M` of the car."""
        car, _ = self.line.at(np.zeros(1, dtype=np.int64), np.array([s_m]))
        apart = self.table.xy[self.table.rows(t_us)[0]] - car[:, :2]
        return np.asarray(np.hypot(apart[:, 0], apart[:, 1]) < SIDE_SIGHT_M)

    def acceleration(
        self, t_us: int, s_m: float, speed_mps: float, style: DrivingStyle, in_sight: Bool
    ) -> float:
        """Return the largest acceleration, m/s^2, behind all whom the driver has seen and who are or
        will be in the way; infinite without such ones.
        """
        table = self.table
        if not table.boxes:
            return float("inf")
        rows = table.rows(t_us)
        ahead = PredictedBodies(
            table.xy[rows],
            table.yaw[rows],
            table.velocity[rows],
            table.present[rows] & in_sight,
            tuple(table.boxes),
            np.full(table.yaw[rows].shape, np.nan),  # the reference line knows no heights
            np.zeros(len(table.boxes), dtype=np.bool_),
        )
        front_s = s_m + self.front_m
        half_m = self.box.width_m / 2
        most = yielding_acceleration(self.line, front_s, speed_mps, self.box, ahead)
        leader = find_leader(self.line, front_s, half_m, ahead.now(), horizon_m=SIGHT_M)
        return min(most, following_acceleration(speed_mps, leader, style))


def following_acceleration(speed_mps: float, leader: Leader, style: DrivingStyle) -> float:
    """Return the acceleration, m/s^2, behind a leader; infinite without one."""
    if leader.index < 0:
        return float("inf")
    return idm_acceleration(speed_mps, leader.gap_m, speed_mps - leader.speed_mps, style.idm)


def acceleration(
    line: ReferenceLine, s_m: float, speed_mps: float, most_mps2: float, style: DrivingStyle
) -> float:
    """Return the acceleration, m/s^2, of a driver at arc length ``s_m`` of the line, at most
    ``most_mps2``.
    """
    limit = min(
        float(np.interp(s_m + 0.5 * speed_mps, line.path.s, line.limit_mps)), style.desired_mps
    )
    wanted = min(1.5 * (limit - speed_mps), ACCEL_MPS2, most_mps2)
    return max(wanted, -HARD_BRAKE_MPS2)


def advance(s_m: float, speed_mps: float, accel_mps2: float, dt_s: float) -> tuple[float, float]:
    """Return arc length and speed after a step of constant acceleration; speeds are not
    negative.
    """
    after = max(speed_mps + accel_mps2 * dt_s, 0.0)
    return s_m + 0.5 * (speed_mps + after) * dt_s, after


def leader_on(
    line: ReferenceLine, s_m: float, front_m: float, half_width_m: float, bodies: Bodies
) -> Leader:
    """Return the leader of a car with the rear axle at ``s_m`` and the front bumper ``front_m``
    ahead of it.
    """
    alone = Lines([line.path])
    return find_leader(alone, s_m + front_m, half_width_m, bodies, horizon_m=SIGHT_M)


def expert_speeds(
    line: ReferenceLine,
    s_m: float,
    speed_mps: float,
    leader: Leader,
    style: DrivingStyle,
    others: RightOfWay | None = None,
    t_us: int = 0,
) -> F64:
    """Return the changes of speed ``(8,)`` until `TIMES_S`, metres per second; the leader's speed
    is constant, and the others that are seen at ``t_us`` move on as recorded.
    """
    s = s_m
    v = speed_mps
    gap = leader.gap_m
    driven = [v]
    yields = float("inf")
    in_sight = None if others is None else others.in_sight(t_us, s_m)
    for step in range(round(TIMES_S[-1] / STEP_S)):
        before = s
        most = following_acceleration(v, Leader(gap, leader.speed_mps, leader.index), style)
        if others is not None and in_sight is not None and step % DECISION_STEPS == 0:
            yields = others.acceleration(t_us + round(step * STEP_S * 1e6), s, v, style, in_sight)
        s, v = advance(s, v, acceleration(line, s, v, min(most, yields), style), STEP_S)
        gap += leader.speed_mps * STEP_S - (s - before)
        driven.append(v)
    return np.array([driven[round(t / STEP_S)] for t in TIMES_S]) - speed_mps


def expert_path(line: Path, s_m: float, T_world_rig: F64, speed_mps: float) -> tuple[F64, F64]:
    """Return points ``(9, 2)`` and headings ``(9,)`` at `KNOTS_M` of the recovery path to a line,
    in the rig frame, metres and radians.

    Args:
        line: The line.
        s_m: Arc length of the car's projection on the line.
        T_world_rig: Pose of the car.
        speed_mps: Its speed: faster cars recover over a longer distance.
    """
    stations = np.arange(s_m - LINE_BEFORE_M, s_m + LINE_AHEAD_M, 1.0)
    xyz, yaw = line.at(stations)
    over = np.maximum(stations - line.length_m, 0.0)  # extend the line straight beyond its end
    xyz = xyz + over[:, None] * np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    T = inverse(T_world_rig)
    points = xyz[stations >= 0] @ T[:3, :3].T + T[:3, 3]
    pursued = max(speed_mps, MIN_PURSUIT_MPS)
    grid = path_grid()
    xy, heading = follow(make_path(points[:, :2], speed_mps=pursued), grid, pursued)
    return (
        np.stack([np.interp(KNOTS_M, grid, xy[:, axis]) for axis in (0, 1)], axis=1),
        np.interp(KNOTS_M, grid, heading),
    )
