"""What the learned policy is taught: how to go back to the lane's middle, and how fast, from where a car happens to be.

The teacher sees what the policy cannot: the exact line, its bends, and everybody on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.geometry import inverse
from alpasim_plugin.types import F64
from alpasim_plugin.world.idm import Bodies, IdmParams, Leader, find_leader, idm_acceleration
from alpasim_plugin.world.path import Path
from policies.learned_net import KNOTS_M, TIMES_S, path_grid
from policies.paths import follow, make_path
from scenarios.expert import ExpertStyle, speed_limits

STEP_S = 0.1
LATERAL_MPS2 = 2.0
ACCEL_MPS2, BRAKE_MPS2, HARD_BRAKE_MPS2 = 1.5, 2.0, 7.0
LINE_BEFORE_M, LINE_AHEAD_M = 4.0, 80.0
MIN_PURSUIT_MPS = 4.0  # a standing car has a way to go as well
SIGHT_M = 60.0  # further things fill a few pixels of the view


@dataclass(frozen=True)
class Habit:
    """How a driver keeps speed and distance."""

    wanted_mps: float
    headway_s: float = 1.5
    min_gap_m: float = 3.5
    brake_mps2: float = BRAKE_MPS2

    @property
    def idm(self) -> IdmParams:
        """Give the parameters of the car-following model."""
        return IdmParams(max(self.wanted_mps, 1.0), self.headway_s, self.min_gap_m, ACCEL_MPS2, self.brake_mps2, HARD_BRAKE_MPS2)


@dataclass(frozen=True)
class Line:
    """A line to drive along, with the speed that its bends allow."""

    path: Path
    limit_mps: F64  # (N,) at the path's stations

    @staticmethod
    def along(path: Path, fastest_mps: float) -> Line:
        """Return the line with its limits, none above ``fastest_mps``."""
        return Line(path, speed_limits(path, ExpertStyle(fastest_mps, fastest_mps, LATERAL_MPS2, 1.5)))


def acceleration(line: Line, s_m: float, speed_mps: float, leader: Leader, habit: Habit) -> float:
    """Return the acceleration of a driver at an arc length of the line."""
    limit = min(float(np.interp(s_m + 0.5 * speed_mps, line.path.s, line.limit_mps)), habit.wanted_mps)
    wanted = min(1.5 * (limit - speed_mps), ACCEL_MPS2)
    if leader.index >= 0:
        wanted = min(wanted, idm_acceleration(speed_mps, leader.gap_m, speed_mps - leader.speed_mps, habit.idm))
    return max(wanted, -HARD_BRAKE_MPS2)


def advance(s_m: float, speed_mps: float, accel_mps2: float, dt_s: float) -> tuple[float, float]:
    """Return arc length and speed a step later; a car that brakes stops, it does not reverse."""
    after = max(speed_mps + accel_mps2 * dt_s, 0.0)
    return s_m + 0.5 * (speed_mps + after) * dt_s, after


def leader_on(line: Line, s_m: float, front_m: float, half_width_m: float, bodies: Bodies) -> Leader:
    """Return who is ahead of a car whose rear axle is at an arc length and whose bumper is ``front_m`` further."""
    return find_leader(line.path, s_m + front_m, half_width_m, bodies, horizon_m=SIGHT_M)


def taught_speeds(line: Line, s_m: float, speed_mps: float, leader: Leader, habit: Habit) -> F64:
    """Return the changes of speed ``(8,)`` until `TIMES_S`, metres per second; whoever is ahead keeps the speed it has."""
    s, v, gap = s_m, speed_mps, leader.gap_m
    speeds = [v]
    for _ in range(round(TIMES_S[-1] / STEP_S)):
        before = s
        s, v = advance(s, v, acceleration(line, s, v, Leader(gap, leader.speed_mps, leader.index), habit), STEP_S)
        gap += leader.speed_mps * STEP_S - (s - before)
        speeds.append(v)
    return np.array([speeds[round(t / STEP_S)] for t in TIMES_S]) - speed_mps


def taught_path(line: Path, s_m: float, T_world_rig: F64, speed_mps: float) -> tuple[F64, F64]:
    """Return points ``(9, 2)`` and headings ``(9,)`` at `KNOTS_M` of the way back to a line, in the rig frame, metres and radians.

    Args:
        line: The line.
        s_m: Arc length beside which the car is.
        T_world_rig: Where it is.
        speed_mps: How fast it is: a fast car goes back over a longer way.
    """
    stations = np.arange(s_m - LINE_BEFORE_M, s_m + LINE_AHEAD_M, 1.0)
    xyz, yaw = line.at(stations)
    over = np.maximum(stations - line.length_m, 0.0)  # straight on where the line ends
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
