"""The privileged expert that the learned policy imitates: a recovery path to the lane centre, and a
speed profile.

The expert knows the exact reference line, its curvature and all actors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64
from alpasim_plugin.world.idm import (
    Bodies,
    IdmParams,
    Leader,
    allowed_speeds,
    find_leader,
    idm_acceleration,
)
from alpasim_plugin.world.path import Lines, Path
from policies.base import follow, make_path
from policies.learned_net import KNOTS_M, TIMES_S, path_grid

STEP_S = 0.1
LATERAL_MPS2 = 2.0
ACCEL_MPS2 = 1.5
BRAKE_MPS2 = 2.0
HARD_BRAKE_MPS2 = 7.0
LINE_BEFORE_M, LINE_AHEAD_M = 4.0, 80.0
MIN_PURSUIT_MPS = 4.0  # so that a stationary car has a path too
SIGHT_M = 60.0  # objects beyond cover only a few pixels of the image


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


def acceleration(
    line: ReferenceLine, s_m: float, speed_mps: float, leader: Leader, style: DrivingStyle
) -> float:
    """Return the acceleration, m/s^2, of a driver at arc length ``s_m`` of the line."""
    limit = min(
        float(np.interp(s_m + 0.5 * speed_mps, line.path.s, line.limit_mps)), style.desired_mps
    )
    wanted = min(1.5 * (limit - speed_mps), ACCEL_MPS2)
    if leader.index >= 0:
        wanted = min(
            wanted,
            idm_acceleration(speed_mps, leader.gap_m, speed_mps - leader.speed_mps, style.idm),
        )
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
    line: ReferenceLine, s_m: float, speed_mps: float, leader: Leader, style: DrivingStyle
) -> F64:
    """Return the changes of speed ``(8,)`` until `TIMES_S`, metres per second; the leader's speed
    is constant.
    """
    s = s_m
    v = speed_mps
    gap = leader.gap_m
    speeds = [v]
    for _ in range(round(TIMES_S[-1] / STEP_S)):
        before = s
        s, v = advance(
            s,
            v,
            acceleration(line, s, v, Leader(gap, leader.speed_mps, leader.index), style),
            STEP_S,
        )
        gap += leader.speed_mps * STEP_S - (s - before)
        speeds.append(v)
    return np.array([speeds[round(t / STEP_S)] for t in TIMES_S]) - speed_mps


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
