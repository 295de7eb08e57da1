"""What every controller shares: the checks on a plan, and the move from a world pose to the plane and back."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.control.bicycle import BicycleState, Command, step
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.geometry import se2, yaw_of
from alpasim_plugin.core.types import EgoState, Trajectory, Vehicle

GENTLE_BRAKE_MPS2 = 2.0  # what a vehicle without a plan does


def check_plan(plan: Trajectory) -> None:
    """Raise PolicyError unless the plan has a pose, finite values, and strictly increasing times."""
    found = ""
    if len(plan) == 0 or plan.xyz.shape != (len(plan), 3) or plan.quat.shape != (len(plan), 4):
        found = f"shapes t {plan.t_us.shape}, xyz {plan.xyz.shape}, quat {plan.quat.shape}"
    elif not np.isfinite(plan.xyz).all():
        row = int(np.flatnonzero(~np.isfinite(plan.xyz).all(axis=1))[0])
        found = f"position {plan.xyz[row].tolist()} in row {row}"
    elif not np.isfinite(plan.quat).all():
        row = int(np.flatnonzero(~np.isfinite(plan.quat).all(axis=1))[0])
        found = f"rotation {plan.quat[row].tolist()} in row {row}"
    elif (np.diff(plan.t_us) <= 0).any():
        row = int(np.flatnonzero(np.diff(plan.t_us) <= 0)[0])
        found = f"times {int(plan.t_us[row])} and then {int(plan.t_us[row + 1])} us in rows {row} and {row + 1}"
    if found:
        raise PolicyError(
            "following a plan",
            f"a plan of {len(plan)} poses",
            found,
            "make the policy return at least one finite pose and strictly increasing times; `check_policy` finds such faults",
        )


def check_interval(state: EgoState, to_us: int) -> float:
    """Return the seconds from the state to ``to_us``; raise InputError unless they are positive."""
    if to_us <= state.t_us:
        raise InputError(
            "advancing the ego", f"a state at {state.t_us} us", f"the target time {to_us} us is not later", "ask for a later time"
        )
    return (to_us - state.t_us) * 1e-6


def planar(state: EgoState) -> BicycleState:
    """Return the state of the rear axle in the world's xy plane."""
    pose = state.T_world_rig
    return BicycleState(float(pose[0, 3]), float(pose[1, 3]), yaw_of(pose), state.speed_mps, state.steer_rad)


def spatial(now: BicycleState, t_us: int, z_m: float, accel_mps2: float, vehicle: Vehicle) -> EgoState:
    """Return the ego state of a planar state: level, at height ``z_m``."""
    return EgoState(
        t_us=t_us,
        T_world_rig=se2(now.x_m, now.y_m, now.yaw_rad, z_m),
        speed_mps=now.speed_mps,
        accel_mps2=accel_mps2,
        yaw_rate_radps=now.speed_mps * float(np.tan(now.steer_rad)) / vehicle.wheelbase_m,
        steer_rad=now.steer_rad,
    )


def coast_to_stop(state: EgoState, to_us: int, vehicle: Vehicle) -> EgoState:
    """Return the state at ``to_us`` without a plan: gentle braking, steering held."""
    dt_s = check_interval(state, to_us)
    before = planar(state)
    after = step(before, Command(before.steer_rad, 0.0, GENTLE_BRAKE_MPS2), dt_s, vehicle)
    accel = 0.0 if after.speed_mps == 0 else (after.speed_mps - before.speed_mps) / dt_s
    return spatial(after, to_us, float(state.T_world_rig[2, 3]), accel, vehicle)
