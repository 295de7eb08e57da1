"""What a renderer declares of the recorded drive: the built scene's own frames, where the
reconstruction believes that they were taken.
"""

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.types import Degradation
from alpasim_plugin.gaussians.fit.views import logged_views
from alpasim_plugin.renderers.gaussian import scene_of
from alpasim_plugin.renderers.reconstruction_build import misplaced
from alpasim_plugin.renderers.reconstruction_key import recipe_of
from alpasim_plugin.renderers.recorded import FIRST_US, INTERVAL_US, built_recording
from tests.gaussians.scene_maps import straight, with_camera


def street(degradation):
    return with_camera(straight(degradation=degradation), 64, 36)


def test_a_built_scene_has_a_frame_of_every_camera_twice_a_second_never_at_the_time_of_a_rendered_one():
    scenario = street(Degradation("none"))
    scene = scene_of(scenario)
    frames = built_recording(scenario, scene, scene.render, None)
    times = [frame.t_us for frame in frames]
    log = scenario.ego_log.t_us
    assert times == list(range(int(log[0]) + FIRST_US, int(log[-1]), INTERVAL_US))
    assert all((t - int(log[0])) % 100_000 == 50_000 for t in times)
    for frame in frames[:2]:
        expected = interpolate(scenario.ego_log, frame.t_us) @ scenario.cameras[0].T_rig_camera
        assert np.allclose(frame.T_world_camera, expected, atol=1e-9)
        rgb, depth = frame.read()
        assert (rgb.shape, rgb.dtype, depth.shape) == ((36, 64, 3), np.uint8, (36, 64))
        assert (depth[:4] == 0).mean() > 0.5  # sky
        assert (depth[-4:] > 0).all()


def test_a_recorded_frame_is_believed_where_registration_put_the_views_beside_it():
    damage = Degradation("reconstruction", pose_error_m=0.1, views_per_s=12.0)
    scenario = street(damage)
    recipe = recipe_of(scenario)
    (frame, *_) = built_recording(scenario, scene_of(scenario), scene_of(scenario).render, recipe)
    (camera,) = scenario.cameras
    (view, *_) = logged_views(scenario, scene_of(scenario), recipe.splat.views, 32)
    at_its_time = replace(view, t_us=frame.t_us)
    (moved,) = misplaced([at_its_time], recipe.pose_error_m, scenario.scene_id, recipe.splat.seed)
    true = inverse(interpolate(scenario.ego_log, frame.t_us) @ camera.T_rig_camera)
    of_view = moved.camera.T_camera_world @ inverse(view.camera.T_camera_world)
    np.testing.assert_allclose(inverse(frame.T_world_camera) @ inverse(true), of_view, atol=1e-9)
