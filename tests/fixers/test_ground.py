"""Recorded frames by two hypotheses of depth: the road shows where the render has a hole, and what
stands on it keeps its own depth.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box
from alpasim_plugin.fixers import ground
from alpasim_plugin.fixers.ground import (
    FLOATING_M,
    NEAREST_M,
    carry,
    ground_hypothesis,
    with_users,
)
from alpasim_plugin.fixers.warp import (
    INCONSISTENT,
    VALID,
    RecordedImage,
    WarpTarget,
    on_boxes,
    place_boxes,
    warp,
)
from tests.fixers.ground_cases import FORWARD, HEIGHT, NOBODY, WIDTH, K, rays, recorded, rig, street


def off(image, truth, where):
    return float(np.abs(image[..., :3].astype(float) - truth)[where].mean())


@pytest.mark.parametrize("wall_m", [np.inf, 20.0])
def test_a_large_window_is_sampled_and_few_pixels_choose_another_depth(wall_m, monkeypatch):
    T, depth, _ = street(10.0, wall_m)
    depth[22:40, 8:56] = 0.0
    depth[30:36, 20:40] = 2.0
    view, pictures = (
        WarpTarget(K, T, depth, NOBODY, {}),
        [recorded(9.0, wall_m), recorded(8.0, wall_m)],
    )
    monkeypatch.setattr(ground, "WINDOW_RAD", 0.94)
    assert ground.step_px(ground.window_px(K)) == 3
    sampled = carry(pictures, view, rig(10.0))
    monkeypatch.setattr(ground, "SAMPLES", 47)
    assert ground.step_px(ground.window_px(K)) == 1
    for image, whole in zip(sampled, carry(pictures, view, rig(10.0)), strict=True):
        assert (image != whole).any(axis=-1).mean() < 0.02


@pytest.mark.parametrize("fog_m", [0.0, 30.0], ids=["a hole", "mist behind the road"])
def test_the_road_is_seen_where_the_render_has(fog_m):
    T, depth, truth = street(10.0)
    road = (slice(22, 40), slice(8, 56))
    depth[road] = fog_m
    view = WarpTarget(K, T, depth, NOBODY, {})
    pictures = [recorded(9.0), recorded(8.0)]
    for image, by_two in zip(
        carry(pictures, view, rig(10.0)), carry(pictures, view, rig(10.0), threads=2), strict=True
    ):
        assert_array_equal(image, by_two)
        assert off(image, truth, road) < 6
        assert (image[road][..., 3] == VALID).mean() > 0.9
    assert off(warp(pictures[0], view), truth, road) > 20


def test_a_wall_beyond_which_the_plane_goes_on_keeps_its_own_depth():
    T, depth, truth = street(10.0, wall_m=20.0)
    wall = (slice(18, 23), slice(8, 56))  # the ground of these pixels lies up to four times as far
    view, pictures = WarpTarget(K, T, depth, NOBODY, {}), [recorded(7.0, 20.0), recorded(5.0, 20.0)]
    assert (ground_hypothesis(view, rig(10.0))[20:23] > 11).any()
    out, by_depth = carry(pictures, view, rig(10.0)), [warp(picture, view) for picture in pictures]
    for image, own in zip(out, by_depth, strict=True):
        assert off(image, truth, wall) < off(own, truth, wall) + 3


def test_what_lies_in_the_box_of_a_road_user_is_never_ground():
    T, depth, _ = street(0.0)
    car, box = se2(8.0, 0.0, 0.0, 0.75), {"car": Box(4.0, 2.0, 1.5)}
    rear = (slice(18, 24), slice(30, 34))
    depth[rear] = 6.0
    free = ground_hypothesis(WarpTarget(K, T, depth, NOBODY, box), rig(0.0))
    held = ground_hypothesis(WarpTarget(K, T, depth, {"car": car}, box), rig(0.0))
    assert (free[22:24, 30:34] > 0).all()
    assert (held[rear] == 0).all()
    elsewhere = np.ones(depth.shape, dtype=bool)
    elsewhere[rear] = False
    assert_array_equal(free[elsewhere & (depth < 5)], held[elsewhere & (depth < 5)])


@pytest.mark.parametrize(("share", "is_free"), [(0.3, False), (0.5, True)])
def test_a_surface_much_nearer_than_the_road_is_no_road(share, is_free):
    T, depth, _ = street(0.0)
    found = ground_hypothesis(WarpTarget(K, T, share * depth, NOBODY, {}), rig(0.0)) > 0
    floating = (share * depth <= FLOATING_M) & (depth > NEAREST_M)
    assert found[floating].all()
    assert found[~floating].any() == is_free


def test_a_box_around_or_beside_the_camera_is_seen_where_it_is():
    def seen(y, width):
        place = {"car": se2(0.0, y, 0.0, 0.75)}
        box = {"car": Box(20.0, width, 9.0)}
        return on_boxes((HEIGHT, WIDTH), place_boxes((HEIGHT, WIDTH), K, FORWARD, place, box).boxes)

    assert seen(0.0, 2.0).all()
    beside = seen(2.0, 2.0)  # from 1 m to the left on, to 10 m ahead
    assert beside[:, :25].all()
    assert not beside[:, 28:].any()


def test_a_road_user_of_the_recorded_frame_is_not_painted_on_the_road():
    box, then = {"car": Box(4.0, 2.0, 1.5)}, se2(17.0, 0.0, 0.0, 0.75)
    T, depth, rgb = street(9.0)
    rear = (slice(18, 26), slice(25, 39))
    rgb[rear] = (
        0  # it hid the road, of which its own reconstruction knows nothing, and has left since
    )
    recorded_car = RecordedImage(K, T, rgb, depth, {"car": then})
    here, own, _ = street(9.0)
    image, _ = carry(
        [with_users(recorded_car, box), recorded(9.5)],
        WarpTarget(K, here, np.zeros_like(own), NOBODY, box),
        rig(9.0),
    )
    hidden = (slice(19, 25), slice(26, 38))
    assert (image[hidden][..., 3] == INCONSISTENT).all()
    assert (image[19:25, :20, 3] == VALID).all()


@pytest.mark.parametrize(
    "height_m", [-1.0, 0.0, 1e-9, 1.5, 400.0]
)  # below the ground, on it, and of a helicopter
def test_the_ground_is_where_a_ray_meets_the_plane_below_the_rig(height_m):
    T_world_rig = se2(3.0, -2.0, 0.7) @ np.array(
        [[1.0, 0, 0, 0], [0, 0.99, -0.14, 0], [0, 0.14, 0.99, 0], [0, 0, 0, 1]]
    )  # rolled
    T_rig_camera = FORWARD.copy()
    T_rig_camera[2, 3] = height_m
    view = WarpTarget(
        K, T_world_rig @ T_rig_camera, np.zeros((HEIGHT, WIDTH), dtype=np.float32), NOBODY, {}
    )
    depth = ground_hypothesis(view, T_world_rig)
    assert (depth > 0).any() == (height_m == 1.5)  # from too far above the road is no plane
    T = view.T_world_camera
    below = (T[:3, 3] + rays(T) * depth[..., None])[depth > 0] - T_world_rig[:3, 3]
    assert np.abs(below @ T_world_rig[:3, 2]).max(initial=0) < 1e-4
