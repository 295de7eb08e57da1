"""Check the pinhole camera."""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians import PinholeCamera
from tests.gaussians.gaussian_scenes import random_rigid

K = np.array([[50.0, 0, 20], [0, 50, 10], [0, 0, 1]])


def test_pose_and_its_inverse_describe_one_camera():
    T = random_rigid(1)
    cam = PinholeCamera.from_pose(40, 20, K, T)
    assert np.abs(cam.T_camera_world @ T - np.eye(4)).max() < 1e-12
    assert np.abs(cam.centre_world - T[:3, 3]).max() < 1e-12


def test_slope_limits_follow_an_off_centre_principal_point():
    low_x, high_x, _, _ = PinholeCamera(
        40, 20, K + np.array([[0, 0, 10.0], [0, 0, 0], [0, 0, 0]]), np.eye(4)
    ).slope_limits()
    assert low_x == pytest.approx(-(30 / 50 + 0.3 * 0.4))
    assert high_x == pytest.approx(10 / 50 + 0.3 * 0.4)


@pytest.mark.parametrize(("width", "height"), [(0, 10), (10, -1)])
def test_no_pixels_is_an_error(width, height):
    with pytest.raises(InputError):
        PinholeCamera(width, height, K, np.eye(4))


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [(0, 1, 0.5), (0, 0, -50.0), (1, 1, 0.0), (2, 2, 2.0), (0, 2, np.nan)],
)
def test_intrinsics_that_are_no_pinhole_are_an_error(row, column, value):
    bad = K.copy()
    bad[row, column] = value
    with pytest.raises(InputError):
        PinholeCamera(40, 20, bad, np.eye(4))
