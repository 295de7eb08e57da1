"""What every controller shares, and the controller without a vehicle.

Shared are the checks on a plan, and the move from a world pose to the plane and back.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.control.bicycle import BicycleState, Command, step
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.geometry import interpolate, se2, wrap_angle, yaw_of
from alpasim_plugin.core.types import EgoState, Trajectory, Vehicle
from alpasim_plugin.plugins.interfaces import Controller

GENTLE_BRAKE_MPS2 = 2.0  # what a vehicle without a plan does


def check_plan(plan: Trajectory) -> None:
    """Raise PolicyError unless the plan has a pose, finite values, and strictly increasing times."""
    found = ""
    if len(plan) == 0 or plan.xyz.shape != (len(plan), 3) or plan.quat.shape != (len(plan), 4):
        found = f"shapes t {plan.t_us.shape}, xyz {plan.xyz.shape}, quat {plan.quat.shape}"
    elif (bad := ~np.isfinite(plan.xyz).all(axis=1)).any():
        row = int(np.argmax(bad))
        found = f"position {plan.xyz[row].tolist()} in row {row}"
    elif (bad := ~np.isfinite(plan.quat).all(axis=1)).any():
        row = int(np.argmax(bad))
        found = f"rotation {plan.quat[row].tolist()} in row {row}"
    elif (bad := np.diff(plan.t_us) <= 0).any():
        row = int(np.argmax(bad))
        found = f"times {int(plan.t_us[row])} and then {int(plan.t_us[row + 1])} us in rows {row} and {row + 1}"
    if found:
        do_this = "make the policy return at least one finite pose and strictly increasing times; `check_policy` finds such faults"
        raise PolicyError("following a plan", f"a plan of {len(plan)} poses", found, do_this)


def check_interval(state: EgoState, to_us: int) -> float:
    """Return the seconds from the state to ``to_us``; raise InputError unless they are positive."""
    if to_us <= state.t_us:
        found = f"the target time {to_us} us is not later"
        raise InputError("advancing the ego", f"a state at {state.t_us} us", found, "ask for a later time")
    return (to_us - state.t_us) * 1e-6


def planar(state: EgoState) -> BicycleState:
    """Return the state of the rear axle in the world's xy plane."""
    pose = state.T_world_rig
    return BicycleState(float(pose[0, 3]), float(pose[1, 3]), yaw_of(pose), state.speed_mps, state.steer_rad)


def spatial(now: BicycleState, t_us: int, z_m: float, accel_mps2: float, vehicle: Vehicle) -> EgoState:
    """Return the ego state of a planar state: level, at height ``z_m``."""
    pose = se2(now.x_m, now.y_m, now.yaw_rad, z_m)
    yaw_rate = now.speed_mps * float(np.tan(now.steer_rad)) / vehicle.wheelbase_m
    return EgoState(t_us, pose, now.speed_mps, accel_mps2, yaw_rate, now.steer_rad)


def coast_to_stop(state: EgoState, to_us: int, vehicle: Vehicle) -> EgoState:
    """Return the state at ``to_us`` without a plan: gentle braking, steering held."""
    dt_s = check_interval(state, to_us)
    before = planar(state)
    after = step(before, Command(before.steer_rad, 0.0, GENTLE_BRAKE_MPS2), dt_s, vehicle)
    accel = 0.0 if after.speed_mps == 0 else (after.speed_mps - before.speed_mps) / dt_s
    return spatial(after, to_us, float(state.T_world_rig[2, 3]), accel, vehicle)


class PerfectController(Controller):
    """Put the ego on the plan's interpolated pose at the given time; before the first and after the last pose, hold that pose."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle

    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``; see `Controller.advance`. Speed and yaw rate are differences over the step."""
        if plan is None:
            return coast_to_stop(state, to_us, self.vehicle)
        dt_s = check_interval(state, to_us)
        check_plan(plan)
        at_us = min(max(to_us, int(plan.t_us[0])), int(plan.t_us[-1]))
        pose = interpolate(plan, at_us)
        moved = pose[:2, 3] - state.T_world_rig[:2, 3]
        turn = float(wrap_angle(yaw_of(pose) - yaw_of(state.T_world_rig)))
        # The chord of the step points along its mean heading.
        mean_yaw = yaw_of(state.T_world_rig) + turn / 2
        speed = float(moved @ np.array([np.cos(mean_yaw), np.sin(mean_yaw)])) / dt_s
        yaw_rate = turn / dt_s
        steer = float(np.arctan(self.vehicle.wheelbase_m * yaw_rate / speed)) if abs(speed) > 0.5 else state.steer_rad
        return EgoState(to_us, pose, speed, (speed - state.speed_mps) / dt_s, yaw_rate, steer)
