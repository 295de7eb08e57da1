import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import se2, yaw_of
from alpasim_plugin.core.types import HeightField
from alpasim_plugin.world.ground import flat, from_points, ground_pose, height_at
from tests.examples import examples

FIELD = HeightField(-3.0, 7.0, 0.5, np.random.default_rng(5).normal(size=(9, 13)))


def test_grid_nodes_give_their_own_height_a_middle_the_mean_and_the_border_goes_on_level():
    assert height_at(FIELD, np.array([[-2.75, 7.25]]))[0] == pytest.approx(FIELD.z[:2, :2].mean())
    assert height_at(FIELD, np.array([[-3.0, 7.0]]))[0] == FIELD.z[0, 0]
    assert height_at(FIELD, np.array([[3.0, 11.0]]))[0] == FIELD.z[-1, -1]
    assert height_at(FIELD, np.array([[100.0, 100.0]]))[0] == FIELD.z[-1, -1]


def test_one_cell_grid_is_level():
    field = HeightField(0.0, 0.0, 1.0, np.array([[4.0]]))
    assert_array_equal(height_at(field, np.array([[0.0, 0.0], [9.0, -9.0]])), [4.0, 4.0])


@given(
    st.floats(-0.2, 0.2),
    st.floats(-0.2, 0.2),
    st.floats(-50, 50),
    st.sampled_from([0.0, 5_000.0, 4_512_345.0]),
)
@settings(deadline=None, max_examples=examples(25))
def test_points_of_a_plane_give_back_the_plane_wherever_it_lies(slope_x, slope_y, height, shift):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-40, 40, (400, 2))
    points = np.column_stack([xy + shift, height + xy @ [slope_x, slope_y]])
    field = from_points(points, 2.0)
    inside = rng.uniform(-25, 25, (50, 2))
    assert_allclose(
        height_at(field, inside + shift), height + inside @ [slope_x, slope_y], atol=1e-6
    )


def test_points_in_any_order_give_the_same_ground():
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 30, (200, 3))
    one = from_points(points)
    two = from_points(points[::-1])
    assert_allclose(one.z, two.z, atol=1e-9)


@pytest.mark.parametrize(
    "points", [[[1.0, 2.0, 3.0]], [[0.0, 0.0, 3.0], [10.0, 0.0, 3.0], [20.0, 0.0, 3.0]]]
)
def test_one_point_or_a_line_of_points_is_ground_enough(points):
    field = from_points(np.array(points))
    assert_allclose(height_at(field, np.array([[0.0, 0.0], [11.0, 5.0]])), 3.0)


def test_ground_of_a_continent_is_refused_before_memory_is_taken():
    with pytest.raises(InputError):
        from_points(np.array([[0.0, 0.0, 0.0], [4e6, 3e6, 0.0]]), 1.0)


def test_level_ground_leaves_a_planar_pose():
    assert_allclose(ground_pose(flat(2.0), 3.0, -4.0, 0.7), se2(3.0, -4.0, 0.7, 2.0), atol=1e-15)


@pytest.mark.parametrize("yaw", [0.0, 0.7, np.pi / 2, 3.0, -2.4])
def test_pose_on_a_slope_keeps_its_heading_and_stands_upright_on_the_surface(yaw):
    x, y = np.meshgrid(np.arange(-20.0, 21), np.arange(-20.0, 21))
    points = np.column_stack([x.ravel(), y.ravel(), 0.1 * x.ravel() - 0.05 * y.ravel()])
    pose = ground_pose(from_points(points, 1.0), 2.0, 3.0, yaw)
    normal = np.array([-0.1, 0.05, 1.0]) / np.linalg.norm([-0.1, 0.05, 1.0])
    assert_allclose(pose[:3, 2], normal, atol=1e-9)
    assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert yaw_of(pose) == pytest.approx(yaw)
    assert pose[2, 3] == pytest.approx(0.2 - 0.15)


def test_uphill_lifts_the_nose():
    x = np.repeat(np.arange(0.0, 30), 5)
    points = np.column_stack([x, np.tile(np.arange(5.0), 30), 0.1 * x])
    assert ground_pose(from_points(points, 1.0), 15.0, 2.0, 0.0)[2, 0] == pytest.approx(
        0.1 / np.hypot(1, 0.1)
    )
    assert ground_pose(from_points(points, 1.0), 15.0, 2.0, np.pi)[2, 0] == pytest.approx(
        -0.1 / np.hypot(1, 0.1)
    )
