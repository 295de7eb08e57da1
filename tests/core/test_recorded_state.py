"""States read off a recording, at the ends of the log too."""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.recorded_state import ego_states_from_log
from alpasim_plugin.core.types import Trajectory, Vehicle

T_US = (
    np.arange(0, 2_000_001, 50_000, dtype=np.int64) + 1_700_000_000_000_000
)  # epoch times: too long for a float's mantissa


def circle(speed_mps, radius_m, yaw_rad=0.0):
    """Drive a left circle that begins with a heading."""
    s = speed_mps * (T_US - T_US[0]) * 1e-6
    yaw = yaw_rad + s / radius_m
    xyz = np.stack([radius_m * np.sin(yaw), radius_m * (1 - np.cos(yaw)), np.zeros(len(s))], axis=1)
    return Trajectory(T_US, xyz, quat_from_yaw(yaw))


@pytest.mark.parametrize("yaw_rad", [0.0, np.radians(172.0)])
def test_a_circle_has_its_speed_yaw_rate_and_steering_up_to_its_ends(yaw_rad):
    vehicle = Vehicle()
    for one in ego_states_from_log(circle(8.0, 40.0, yaw_rad), T_US, vehicle):
        assert one.speed_mps == pytest.approx(8.0, rel=1e-3)
        assert one.yaw_rate_radps == pytest.approx(0.2, rel=1e-6)
        assert one.steer_rad == pytest.approx(np.arctan(vehicle.wheelbase_m / 40.0), rel=2e-3)
        assert one.accel_mps2 == pytest.approx(0.0, abs=0.05)


def test_a_log_of_one_pose_stands_still_and_times_outside_are_refused():
    log = circle(8.0, 40.0)
    alone = Trajectory(log.t_us[:1], log.xyz[:1], log.quat[:1])
    (still,) = ego_states_from_log(alone, [int(T_US[0])], Vehicle())
    assert (still.speed_mps, still.accel_mps2, still.yaw_rate_radps, still.steer_rad) == (
        0.0,
        0.0,
        0.0,
        0.0,
    )
    with pytest.raises(InputError, match="the trajectory covers"):
        ego_states_from_log(log, [int(T_US[-1]) + 1], Vehicle())
