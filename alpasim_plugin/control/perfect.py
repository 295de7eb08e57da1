"""A controller without a vehicle: the ego is exactly where its plan says."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.control.base import check_interval, check_plan, coast_to_stop
from alpasim_plugin.core.geometry import interpolate, wrap_angle, yaw_of
from alpasim_plugin.core.types import Controller, EgoState, Trajectory, Vehicle


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
