"""Flat Gaussians that lie on surfaces: how they are turned."""

import numpy as np
from numpy.testing import assert_allclose

from alpasim_plugin.core.geometry import direction_of, matrix_from_quat, unit
from alpasim_plugin.streets.surfels import quats_along, upright_quats


def test_surfels_lie_across_their_normals_and_point_along_their_heading():
    normals = unit(
        np.array([[0.2, 0.1, 1.0], [-0.1, 0.3, 1.0], [0.15, -0.2, 1.0], [0.0, 0.0, 1.0]])
    )
    for yaw in np.radians([40.0, 178.0, -95.0]):
        R = matrix_from_quat(upright_quats(normals, yaw))
        assert_allclose(R[:, :, 2], normals, atol=1e-12)
        # The tilt turns about a level axis: it leaves what is level and square to the slope's rise.
        level = np.column_stack([-normals[:, 1], normals[:, 0], np.zeros(len(normals))])
        ahead = np.append(direction_of(yaw), 0.0)
        assert_allclose(np.sum(R[:, :, 0] * level, axis=1), level @ ahead, atol=1e-12)


def test_surfels_along_a_direction_have_it_as_their_x_axis_and_stand_upright():
    directions = np.array([[1.0, 2.0, 0.5], [-3.0, -0.1, 0.2], [0.1, -1.0, -0.3]])
    R = matrix_from_quat(quats_along(directions))
    assert_allclose(R[:, :, 0], unit(directions), atol=1e-12)
    assert (R[:, 2, 2] > 0).all()
    assert_allclose(R[:, 2, 1], 0.0, atol=1e-12)
