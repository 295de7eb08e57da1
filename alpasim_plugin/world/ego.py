"""The ego as its recording has it: states read off a log of poses."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.geometry import interpolate, wrap_angle, yaw_of
from alpasim_plugin.types import EgoState, Trajectory, Vehicle

DIFFERENCE_US = 100_000  # half window of the differences: long enough to bridge the noise of 200 Hz poses


def ego_state_from_log(ego_log: Trajectory, t_us: int, vehicle: Vehicle) -> EgoState:
    """Return the recorded state at ``t_us``, motion by differences over at most +-0.1 s inside the log.

    Speed is the component of velocity along the rig's x axis (negative in reverse). The steering angle is the one with which a
    kinematic bicycle makes the recorded yaw rate, limited to what the vehicle can do, so that the loop closes without a jump.

    Raises:
        InputError: ``t_us`` lies outside the log.
    """
    before = max(t_us - DIFFERENCE_US, int(ego_log.t_us[0]))
    after = min(t_us + DIFFERENCE_US, int(ego_log.t_us[-1]))
    pose = interpolate(ego_log, t_us)
    if after == before:
        return EgoState(t_us, pose, 0.0)
    window = interpolate(ego_log, np.array([before, t_us, after]))
    dt_s = (after - before) * 1e-6
    forward = pose[:3, 0]
    speed = float((window[2, :3, 3] - window[0, :3, 3]) @ forward) / dt_s
    yaw_rate = float(wrap_angle(yaw_of(window[2]) - yaw_of(window[0]))) / dt_s
    accel = 0.0
    if before < t_us < after:
        v0 = float((window[1, :3, 3] - window[0, :3, 3]) @ forward) / ((t_us - before) * 1e-6)
        v1 = float((window[2, :3, 3] - window[1, :3, 3]) @ forward) / ((after - t_us) * 1e-6)
        accel = 2.0 * (v1 - v0) / dt_s
    steer = float(np.arctan(vehicle.wheelbase_m * yaw_rate / speed)) if abs(speed) > 0.5 else 0.0
    return EgoState(t_us, pose, speed, accel, yaw_rate, float(np.clip(steer, -vehicle.max_steer_rad, vehicle.max_steer_rad)))
