"""The ego's state at any time of a recorded drive: motion read off its poses."""

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.geometry import heading_of, interpolate, wrap_angle
from alpasim_plugin.core.types import F64, EgoState, Trajectory, Vehicle

# half window of the differences: long enough to bridge the noise of 200 Hz poses
DIFFERENCE_US = 100_000


def ego_state_from_log(ego_log: Trajectory, t_us: int, vehicle: Vehicle) -> EgoState:
    """Return the recorded state at ``t_us``; see `ego_states_from_log`."""
    return ego_states_from_log(ego_log, [t_us], vehicle)[0]


def ego_states_from_log(
    ego_log: Trajectory, t_us: npt.ArrayLike, vehicle: Vehicle
) -> list[EgoState]:
    """Return the recorded state at each of ``(N,)`` times, motion by differences over at most +-0.1
    s inside the log.

    Speed is the component of velocity along the rig's x axis (negative in reverse). The steering
    angle is the one with which a kinematic bicycle makes the recorded yaw rate, limited to what the
    vehicle can do, so that the loop closes without a jump.

    Raises:
        InputError: A time lies outside the log.
    """
    t = np.asarray(t_us, dtype=np.int64)
    before = np.maximum(t - DIFFERENCE_US, ego_log.t_us[0])
    after = np.minimum(t + DIFFERENCE_US, ego_log.t_us[-1])
    poses = interpolate(ego_log, np.stack([before, t, after], axis=-1))  # (N, 3, 4, 4)
    forward = poses[:, 1, :3, 0]
    xyz = poses[:, :, :3, 3]
    # A window of no length, as in a log of one pose, has no motion; one that ends at t has no
    # acceleration.
    span_s, first_s, second_s = (
        np.where(span_us > 0, span_us, 1) * 1e-6
        for span_us in (after - before, t - before, after - t)
    )
    speed = _along(xyz[:, 2] - xyz[:, 0], forward) / span_s
    yaw = heading_of(poses[:, :, :2, 0])
    yaw_rate = wrap_angle(yaw[:, 2] - yaw[:, 0]) / span_s
    v0 = _along(xyz[:, 1] - xyz[:, 0], forward) / first_s
    v1 = _along(xyz[:, 2] - xyz[:, 1], forward) / second_s
    accel = np.where((before < t) & (t < after), 2.0 * (v1 - v0) / span_s, 0.0)
    turns = np.abs(speed) > 0.5
    steer = np.where(
        turns, np.arctan(vehicle.wheelbase_m * yaw_rate / np.where(turns, speed, 1.0)), 0.0
    )
    steer = np.clip(steer, -vehicle.max_steer_rad, vehicle.max_steer_rad)
    columns = (
        t.tolist(),
        poses[:, 1],
        speed.tolist(),
        accel.tolist(),
        yaw_rate.tolist(),
        steer.tolist(),
    )
    return [EgoState(*row) for row in zip(*columns, strict=True)]


def _along(move: F64, forward: F64) -> F64:
    """Return the component ``(N,)`` of moves ``(N, 3)`` along unit vectors ``(N, 3)``."""
    return np.sum(move * forward, axis=-1)
