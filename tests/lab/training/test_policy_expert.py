"""The expert of the learned policy: recovery to the line, and speed behind others."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from alpasim_plugin.core.geometry import quat_from_yaw, se2
from alpasim_plugin.core.types import Actor, Box, Trajectory, Vehicle
from alpasim_plugin.lab.training.policy import integrate_path
from alpasim_plugin.lab.training.policy_expert import (
    DrivingStyle,
    ReferenceLine,
    RightOfWay,
    acceleration,
    advance,
    expert_path,
    expert_speeds,
    following_acceleration,
    leader_on,
)
from alpasim_plugin.world.idm import NO_LEADER, Leader, bodies_from
from alpasim_plugin.world.path import smooth_path
from policies.learned_net import KNOTS_M, TIMES_S, knot_weights, path_grid

STRAIGHT = smooth_path(np.stack([np.linspace(0.0, 200.0, 60), np.zeros(60)], axis=1))
STYLE = DrivingStyle(10.0)


def speeds(
    speed_mps,
    leader=NO_LEADER,
    line=None,
    s_m=20.0,
):
    return speed_mps + expert_speeds(
        line or ReferenceLine.along(STRAIGHT, 20.0), s_m, speed_mps, leader, STYLE
    )


@pytest.mark.parametrize("offset_m", [-1.5, 0.0, 0.7])
def test_car_beside_a_straight_line_is_led_back_to_it_without_a_jump(offset_m):
    points, heading = expert_path(STRAIGHT, 50.0, se2(50.0, offset_m, 0.0), 10.0)
    assert points[-1, 1] == pytest.approx(-offset_m, abs=0.05)
    assert np.abs(heading[-1]) < 0.01
    assert (
        abs(points[0, 1]) < 0.2 * abs(offset_m) + 1e-6
    )  # the first metres go where the car already points
    assert (np.diff(np.abs(points[:, 1])) > -0.2).all()


def test_free_car_at_the_wanted_speed_keeps_it_and_a_slower_one_gains_it():
    assert_allclose(speeds(10.0), 10.0, atol=1e-6)
    after = speeds(0.0)
    assert (np.diff(after) > 0).all()
    assert after[0] == pytest.approx(0.75, abs=0.1)


def test_car_stops_before_what_stands_and_stays_there():
    for gap_m in (12.0, 20.0, 30.0):
        s = 20.0
        v = 8.0
        line = ReferenceLine.along(STRAIGHT, 20.0)
        wall = 20.0 + gap_m
        for _ in range(150):
            most = following_acceleration(v, Leader(wall - s, 0.0, 0), STYLE)
            s, v = advance(s, v, acceleration(line, s, v, most, STYLE), 0.1)
        assert v < 0.1
        assert 1.0 < wall - s < 4.5
    assert speeds(8.0, Leader(12.0, 0.0, 0))[TIMES_S.index(2.5)] < 2.0


@pytest.mark.parametrize("meets", [True, False])
def test_who_comes_from_the_side_is_let_pass_unless_the_car_is_gone_by_then(meets):
    """A car crosses 30 m ahead of the rear axle, when the own car would be there or 4 s later."""
    t_us = np.array([0, 20_000_000])
    y = 9.0 * (t_us * 1e-6 - (2.6 if meets else 6.6))
    xyz = np.column_stack([np.full(2, 50.0), y, np.full(2, 0.7)])
    track = Trajectory(t_us, xyz, quat_from_yaw(np.full(2, np.pi / 2)))
    crosses = Actor("crosses", "car", Box(4.5, 1.8, 1.5), track)
    others = RightOfWay.along(STRAIGHT, Vehicle(), [crosses], 20_000_000)
    line = ReferenceLine.along(STRAIGHT, 20.0)
    near, far = (expert_speeds(line, s, 10.0, NO_LEADER, STYLE, others, 0) for s in (20.0, 12.0))
    assert near.min() < -2.0 if meets else near.min() == pytest.approx(0.0, abs=1e-6)
    assert_allclose(far, 0.0, atol=1e-6)  # 44 m away: the views to the sides hardly show it


def test_only_bodies_that_reach_into_the_way_are_leaders():
    line = ReferenceLine.along(STRAIGHT, 20.0)
    car = Box(4.5, 1.8, 1.5)
    there = bodies_from(
        np.array([[40.0, 3.4], [60.0, 0.3]]),
        np.zeros(2),
        [car, car],
        np.array([[0.0, 0.0], [5.0, 0.0]]),
    )
    leader = leader_on(line, 10.0, 3.8, 0.94, there)
    assert leader.index == 1
    assert leader.gap_m == pytest.approx(60.0 - 2.25 - 13.8, abs=0.05)
    assert leader.speed_mps == pytest.approx(5.0)
    nobody = bodies_from(np.zeros((0, 2)), np.zeros(0), [], np.zeros((0, 2)))
    assert leader_on(line, 10.0, 3.8, 0.94, nobody).index == -1


def test_headings_of_a_circle_lay_out_the_circle():
    heading = torch.tensor([[s / 40.0 for s in KNOTS_M]], dtype=torch.float64)
    points, yaw = integrate_path(heading, torch.from_numpy(knot_weights()))
    s = path_grid()
    assert_allclose(yaw[0].numpy(), s / 40.0, atol=1e-12)
    assert_allclose(
        points[0].numpy(),
        40.0 * np.stack([np.sin(s / 40.0), 1 - np.cos(s / 40.0)], axis=1),
        atol=2e-3,
    )
