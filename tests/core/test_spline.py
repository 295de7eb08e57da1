"""Cubic splines against scipy: few points, uneven steps, coordinates far from the origin."""

import numpy as np
import pytest
import scipy.interpolate
import scipy.linalg
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.spline import CubicSpline, solve_tridiagonal

TOLERANCE = 1e-12  # of the largest value


def assert_equals_scipy(s, points):
    spline = CubicSpline.through(s, points)
    reference = scipy.interpolate.CubicSpline(s, points)
    places = np.concatenate([np.linspace(s[0], s[-1], 97), s, [s[0] - 0.5, s[-1] + 0.5]])
    for derivative in range(3):
        expected = reference(places, derivative)
        allowed = TOLERANCE * max(np.abs(expected).max(), 1.0)
        assert_allclose(spline.at(places, derivative), expected, rtol=0, atol=allowed)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 30, 900])
@pytest.mark.parametrize("columns", [1, 2, 3])
def test_a_spline_is_that_of_scipy(count, columns):
    rng = np.random.default_rng(count)
    s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.5, 6.0, count - 1))])
    assert_equals_scipy(s, rng.normal(0.0, 20.0, (count, columns)).cumsum(axis=0))


@pytest.mark.parametrize(
    "steps", [[1e-4, 5.0, 5.0], [5.0, 5.0, 1e-4], [0.01, 8.0, 0.01, 8.0, 0.01]]
)
def test_steps_of_which_one_is_far_smaller(steps):
    s = np.concatenate([[0.0], np.cumsum(steps)])
    assert_equals_scipy(s, np.column_stack([np.sin(s), np.cos(s)]))


def test_points_far_from_the_origin():
    angle = np.linspace(0.0, 1.5, 40)
    arc = 30.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    origin = np.array([4.5e5, 5.4e6])
    assert_equals_scipy(30.0 * angle, arc + origin)


def test_it_passes_through_its_points_and_reproduces_a_cubic():
    s = np.array([0.0, 1.0, 2.5, 3.0, 5.0])
    points = np.column_stack([s**3 - 2 * s, 4 - s**2])
    spline = CubicSpline.through(s, points)
    assert_array_equal(spline.at(s[:-1]), points[:-1])
    fine = np.linspace(0.0, 5.0, 51)
    assert_allclose(spline.at(fine)[:, 0], fine**3 - 2 * fine, atol=1e-11)
    assert_allclose(spline.at(fine, derivative=2)[:, 1], -2.0, atol=1e-11)


@pytest.mark.parametrize("s", [[0.0], [0.0, 1.0, 1.0], [0.0, 2.0, 1.0], [0.0, np.nan]])
def test_places_that_do_not_ascend_are_refused(s):
    with pytest.raises(ValueError, match="ascending"):
        CubicSpline.through(np.array(s), np.zeros((len(s), 2)))


@pytest.mark.parametrize("count", [2, 3, 12])
def test_a_system_with_small_diagonals_is_solved_by_exchanging_rows(count):
    rng = np.random.default_rng(count)
    below, above = rng.normal(size=(2, count - 1))
    diagonal = 1e-9 * rng.normal(size=count)
    diagonal[-1] = 1.0
    right = rng.normal(size=(count, 2))
    matrix = np.diag(diagonal) + np.diag(below, -1) + np.diag(above, 1)
    solution = solve_tridiagonal(below, diagonal, above, right)
    assert_allclose(solution, scipy.linalg.solve(matrix, right), rtol=1e-8)
