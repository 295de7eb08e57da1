"""Clothoids against Fresnel integrals, connectors between headings, and projection onto paths."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import fresnel

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.world.path import (
    connect,
    offset_line,
    polyline_path,
    sample_clothoid,
    smooth_path,
    smoothstep,
)
from tests.examples import examples


def clothoid_by_fresnel(s, rate):
    """Points of a clothoid from the origin with zero start curvature: x + iy = sqrt(pi/rate) (C +
    iS)(s sqrt(rate/pi)).
    """
    scale = np.sqrt(np.pi / abs(rate))
    sine, cosine = fresnel(s / scale)
    return np.stack([scale * cosine, np.sign(rate) * scale * sine], axis=1)


@pytest.mark.parametrize("end_curvature", [0.2, 0.02, -0.05, 1e-4])
@pytest.mark.parametrize("step_m", [0.5, 1.0])
def test_clothoid_agrees_with_fresnel_integrals(end_curvature, step_m):
    length = 60.0
    curve = sample_clothoid((0.0, 0.0, 0.0), length, 0.0, end_curvature, step_m)
    s = np.linspace(0.0, length, len(curve))
    assert_allclose(curve[:, :2], clothoid_by_fresnel(s, end_curvature / length), atol=1e-11)


def test_arc_with_positive_curvature_turns_left_on_its_circle():
    curve = sample_clothoid((3.0, 4.0, 0.0), 30.0, 0.05, 0.05)
    assert_allclose(np.hypot(curve[:, 0] - 3.0, curve[:, 1] - 24.0), 20.0, atol=1e-12)
    assert curve[-1, 1] > 4.0
    assert_allclose(curve[-1, 2], 1.5)


def test_straight_keeps_its_heading_far_from_the_origin():
    curve = sample_clothoid((5e5, 4e6, np.pi / 2), 100.0, 0.0, 0.0)
    assert_allclose(curve[-1, :2], [5e5, 4e6 + 100.0], atol=1e-8)


@settings(deadline=None, max_examples=examples(40))
@given(st.floats(8, 40), st.floats(8, 40), st.sampled_from([np.pi / 2, -np.pi / 2, 0.0]))
def test_connector_meets_both_poses_exactly_and_never_bends_backwards(ahead, aside, turn):
    p0 = np.array([1.0, 2.0, 0.0])
    p1 = p0 + np.array([ahead, np.sign(turn) * aside, 0.0])
    curve = connect(p0, 0.0, p1, turn)
    assert (curve[0, :2] == p0[:2]).all()
    assert (curve[-1, :2] == p1[:2]).all()
    d = np.diff(curve[:, :2], axis=0)
    heading = np.arctan2(d[:, 1], d[:, 0])
    assert (np.abs(heading) <= abs(turn) + 0.02).all()
    assert_allclose(heading[[0, -1]], [0.0, turn], atol=0.05)


def test_offset_line_lies_left_of_the_curve():
    line = offset_line(sample_clothoid((0, 0, 0), 10, 0, 0), 2.0)
    assert_allclose(line[:, 1], 2.0)


def test_smoothstep_is_flat_at_both_ends():
    h = 1e-4
    assert smoothstep(h) < 1e-10
    assert smoothstep(1 - h) > 1 - 1e-10
    assert smoothstep(0.5) == 0.5
    assert_array_equal(smoothstep([-1.0, 2.0]), [0.0, 1.0])


@settings(deadline=None, max_examples=examples(60))
@given(st.floats(1, 58), st.floats(-6, 6), st.sampled_from([0.0, 0.03, -0.06]))
def test_projection_finds_arc_length_and_offset_again(s, d, curvature):
    curve = sample_clothoid((10.0, -3.0, 0.7), 60.0, curvature, curvature)
    path = smooth_path(np.column_stack([curve[:, :2], np.zeros(len(curve))]), step_m=0.5)
    point, _ = path.at(s, d)
    s_found, d_found = path.project(point[None, :2])
    assert abs(s_found[0] - s) < 0.02
    assert abs(d_found[0] - d) < 0.01


def test_projection_beyond_the_ends_follows_the_tangent():
    path = polyline_path(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))
    s, d = path.project(np.array([[-3.0, 1.0], [7.0, -2.0]]))
    assert_allclose(s, [-3.0, 7.0], atol=1e-6)
    assert_allclose(d, [1.0, -2.0], atol=1e-6)


@pytest.mark.parametrize("curvature", [0.08, -0.05])
@pytest.mark.parametrize("along", [-6.0, 6.0])
def test_projection_beyond_an_end_of_a_bend_leaves_the_bend(curvature, along):
    curve = sample_clothoid((10.0, -3.0, 2.9), 40.0, curvature, curvature)
    path = smooth_path(np.column_stack([curve[:, :2], np.zeros(len(curve))]), step_m=0.5)
    end = 0 if along < 0 else -1
    yaw = path.yaw[end]
    tangent = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-tangent[1], tangent[0]])
    point = path.xyz[end, :2] + along * tangent + 1.5 * left
    s, d = path.project(point[None])
    assert_allclose(s, path.s[end] + along, atol=1e-6)
    assert_allclose(d, 1.5, atol=1e-6)


def test_path_of_one_point_is_refused():
    with pytest.raises(InputError):
        polyline_path(np.zeros((3, 3)))
