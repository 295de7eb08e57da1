from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import (
    BackgroundFile,
    Behaviour,
    Trajectory,
)
from alpasim_plugin.gaussians import write_ply
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.renderers.gaussian import clear_cache, scene_of
from tests.gaussians.scene_maps import parked, straight
from tests.renderers.requests import request


@pytest.fixture(scope="module")
def scenario():
    moving = parked("moving", 30.0, -5.4)
    t = np.array([0, 10_000_000])
    drive = Trajectory(
        t, np.array([[30.0, -5.4, 0.75], [90.0, -5.4, 0.75]]), np.tile(quat_from_yaw(0.0), (2, 1))
    )
    yield straight(
        actors=(
            parked("car", 40.0, -1.8),
            replace(moving, track=drive, is_static=False, behaviour=Behaviour()),
        )
    )
    clear_cache()


def test_frame_has_the_shapes_types_and_ranges_of_the_contract(scenario):
    renderer = make_renderer("clean", scenario)
    assert isinstance(renderer, Renderer)
    frame = renderer.render(request(scenario))
    assert frame.camera == "front"
    assert frame.t_us == scenario.ego_log.t_us[8]
    assert frame.rgb.shape == (144, 256, 3)
    assert frame.rgb.dtype == np.uint8
    assert frame.alpha.shape == frame.depth.shape == (144, 256)
    assert frame.alpha.min() >= 0
    assert frame.alpha.max() <= 1
    assert frame.alpha[:20].mean() > 0.97  # sky counts as shown
    assert frame.alpha[100:].min() > 0.5  # ground
    assert 3.0 < frame.depth[-1, 128] < 8.0
    assert frame.events == ()


def test_depth_of_the_road_is_that_of_the_plane(scenario):
    frame = make_renderer("clean", scenario).render(request(scenario))
    camera = scenario.cameras[0]
    for row in (100, 120, 140):
        expected = 1.5 / ((row + 0.5 - camera.K[1, 2]) / camera.K[1, 1])
        assert frame.depth[row, 100:120] == pytest.approx(expected, rel=0.06)


def test_same_request_gives_the_same_frame_whatever_came_before(scenario):
    a = make_renderer("clean", scenario, seed=3)
    b = make_renderer("clean", scenario, seed=3)
    for i in (30, 5, 17):
        a.render(request(scenario, i, 1.7))
    first = a.render(request(scenario, left_m=0.9))
    second = b.render(request(scenario, left_m=0.9))
    assert_array_equal(first.rgb, second.rgb)
    assert_array_equal(first.alpha, second.alpha)


def test_actor_hides_the_road_where_it_stands(scenario):
    renderer = make_renderer("clean", scenario)
    r = request(scenario)
    with_car = renderer.render(r)
    without = renderer.render(replace(r, actors={}))
    changed = np.any(with_car.rgb != without.rgb, axis=2)
    assert 100 < changed.sum() < 0.3 * changed.size
    assert with_car.depth[changed].mean() < without.depth[changed].mean()


def test_file_background_replaces_the_street_and_keeps_actors_and_sky(scenario, tmp_path):
    wall = scene_of(scenario).actors["car"].levels[0].cloud
    path = f"{tmp_path}/model.ply"
    write_ply(path, wall)
    T = np.eye(4)
    T[:3, :3] *= 3.0
    T[:3, 3] = (45.0, 4.0, 3.0)
    filed = replace(scenario, background=BackgroundFile(path, T))
    renderer = make_renderer("clean", filed)
    frame = renderer.render(request(filed))
    assert frame.alpha[-1].max() == 0  # no road
    assert frame.alpha.max() > 0.9
    without = renderer.render(replace(request(filed), actors={}))
    assert np.any(without.rgb != frame.rgb)


def test_clean_frame_is_taken_at_the_end_of_the_shutter(scenario):
    r = request(scenario)
    moved = replace(
        r, T_world_camera=np.stack([request(scenario, 2).T_world_camera[0], r.T_world_camera[1]])
    )
    renderer = make_renderer("clean", scenario)
    assert_array_equal(renderer.render(r).rgb, renderer.render(moved).rgb)
