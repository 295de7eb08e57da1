"""How far a request lies from the predicted one."""

import math

import numpy as np
import pytest

from alpasim_plugin.block_fixers.speculation import deviation, rotation_rad
from alpasim_plugin.core.geometry import se2, se3
from alpasim_plugin.core.types import CameraSpec, RenderRequest

CAMERA = CameraSpec("front", 8, 8, np.eye(3), np.eye(4))


def facing_z(x=0.0, actors=None, start_x=None):
    end = np.eye(4)
    start = np.eye(4)
    end[0, 3], start[0, 3] = x, x if start_x is None else start_x
    return RenderRequest(0, CAMERA, np.stack([start, end]), actors or {})


def at_depth(z, x=0.0):
    return se3([x, 0.0, z], [1.0, 0.0, 0.0, 0.0])


def test_the_pose_at_shutter_start_counts_as_well():
    assert deviation(
        facing_z(0.0, start_x=-0.5), facing_z(0.0, start_x=-0.1)
    ).camera_m == pytest.approx(0.4)


@pytest.mark.parametrize("angle", [1e-9, 1e-6, 1e-3, 0.1, 1.0, 3.0, math.pi])
def test_small_and_large_rotations_are_measured_exactly(angle):
    assert rotation_rad(se2(0, 0, 0.3), se2(5, 5, 0.3 + angle)) == pytest.approx(angle, rel=1e-6)


def test_an_actors_displacement_counts_less_the_further_away_it_is():
    def off(depth):
        return deviation(
            facing_z(actors={"a": at_depth(depth)}), facing_z(actors={"a": at_depth(depth, 0.1)})
        ).actor_m

    assert off(5.0) == off(9.0) == pytest.approx(0.1)
    assert off(40.0) == pytest.approx(0.025, rel=1e-3)


def test_an_actor_that_turns_on_the_spot_counts():
    turned = se3([0.0, 0.0, 10.0], [math.cos(0.02), 0.0, 0.0, math.sin(0.02)])
    assert deviation(
        facing_z(actors={"a": at_depth(10.0)}), facing_z(actors={"a": turned})
    ).actor_m == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize("swap", [False, True])
def test_an_actor_that_came_or_left_is_beyond_any_tolerance_unless_behind(swap):
    def off(depth):
        pair = [facing_z(actors={"a": at_depth(depth)}), facing_z()]
        return deviation(*(reversed(pair) if swap else pair)).actor_m

    assert off(30.0) == math.inf
    assert off(-9.0) == math.inf  # a long vehicle reaches into the picture
    assert off(-11.0) == 0.0
