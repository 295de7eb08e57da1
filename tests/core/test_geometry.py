"""Rigid motion and polylines against scipy and closed forms, at the corners where such code
breaks.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    interpolate,
    matrix_from_quat,
    offset_trajectory,
    project,
    quat_from_matrix,
    quat_from_yaw,
    resample,
    se2,
    slerp,
    trajectory_from_poses,
    turned,
    wrap_angle,
    yaw_from_quat,
)
from alpasim_plugin.core.types import Trajectory
from tests.examples import examples

EPOCH_US = 1_689_697_803_493_732  # a recorded time stamp: larger than a float32, and than 2^50

four = st.lists(st.floats(-1, 1), min_size=4, max_size=4)
unit_quats = four.filter(lambda q: np.linalg.norm(q) > 1e-3).map(
    lambda q: np.array(q) / np.linalg.norm(q)
)


@settings(deadline=None)
@given(st.floats(-180, 180), st.floats(-180, 180))
def test_a_yaw_and_a_pitch_are_those_of_scipy(yaw_deg, pitch_deg):
    expected = Rotation.from_euler("ZY", [yaw_deg, pitch_deg], degrees=True).as_matrix()
    assert_allclose(turned(*np.deg2rad([yaw_deg, pitch_deg])), expected, atol=1e-15)


@settings(deadline=None)
@given(unit_quats)
def test_rotation_matrix_agrees_with_scipy_and_survives_the_way_back(quat):
    matrix = matrix_from_quat(quat)
    assert_allclose(matrix, Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix(), atol=1e-12)
    back = quat_from_matrix(matrix)
    assert abs(abs(back @ quat) - 1) < 1e-12
    assert back[0] >= 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turn_about_each_axis_has_a_stable_quaternion(axis):
    quat = np.zeros(4)
    quat[1 + axis] = 1.0
    back = quat_from_matrix(matrix_from_quat(quat))
    assert_allclose(np.abs(back), np.abs(quat), atol=1e-15)


def test_heading_of_180_degrees_wraps_to_the_lower_end():
    assert float(wrap_angle(np.pi)) == -np.pi
    assert_allclose(yaw_from_quat(quat_from_yaw(np.array([3.0, -3.0]))), [3.0, -3.0])


def test_the_heading_of_a_body_that_rolls_and_pitches_is_that_of_its_nose():
    turns = Rotation.from_euler("ZYX", [[175.0, 8.0, -20.0], [-172.0, -10.0, 35.0]], degrees=True)
    x, y, z, w = turns.as_quat().T
    assert_allclose(yaw_from_quat(np.column_stack([w, x, y, z])), np.radians([175.0, -172.0]))


@settings(deadline=None, max_examples=examples(50))
@given(unit_quats, unit_quats, st.floats(0, 1))
def test_slerp_agrees_with_scipy(q0, q1, fraction):
    ours = slerp(q0[None], q1[None], np.array([fraction]))[0]
    if abs(q0 @ q1) < 1e-6:
        return  # opposite rotations: the shorter arc is not unique
    theirs = Slerp([0, 1], Rotation.from_quat(np.stack([q0, q1])[:, [1, 2, 3, 0]]))(
        fraction
    ).as_quat()[[3, 0, 1, 2]]
    assert abs(abs(ours @ theirs) - 1) < 1e-9


def test_interpolation_at_epoch_microseconds_keeps_every_microsecond():
    line = Trajectory(
        EPOCH_US + np.array([0, 100_000]),
        np.array([[0.0, 0, 0], [1.0, 0, 0]]),
        quat_from_yaw(np.zeros(2)),
    )
    for dt in (0, 1, 50_000, 99_999, 100_000):
        assert interpolate(line, EPOCH_US + dt)[0, 3] == pytest.approx(dt / 100_000, abs=1e-15)


def test_interpolation_outside_the_trajectory_is_refused():
    line = Trajectory(np.array([0, 10]), np.zeros((2, 3)), quat_from_yaw(np.zeros(2)))
    with pytest.raises(InputError, match=r"covers 0\.\.10 us"):
        interpolate(line, 11)


def test_offset_trajectory_turns_the_offset_with_the_body():
    left_turn = trajectory_from_poses([0, 1], [se2(0, 0, 0), se2(0, 0, np.pi / 2)])
    moved = offset_trajectory(left_turn, se2(2.0, 0.0, 0.0))
    assert_allclose(moved.xyz, [[2, 0, 0], [0, 2, 0]], atol=1e-12)


def test_projection_left_of_a_line_is_positive_and_clamps_at_the_ends():
    line = np.array([[0.0, 0, 0], [10.0, 0, 0]])
    assert project(line, np.array([4.0, 1.5])) == (4.0, 1.5)
    assert project(line, np.array([4.0, -1.5])) == (4.0, -1.5)
    assert project(line, np.array([13.0, 4.0])) == (10.0, 5.0)


def test_resampling_skips_repeated_points():
    line = np.array([[0.0, 0], [1.0, 0], [1.0, 0], [2.0, 0]])
    assert_allclose(resample(line, [0.0, 0.5, 1.5, 9.0])[:, 0], [0.0, 0.5, 1.5, 2.0])
