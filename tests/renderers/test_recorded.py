"""What a renderer declares of the recorded drive: the built scene's own frames, where the
reconstruction believes that they were taken.
"""

import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, intrinsics, inverse
from alpasim_plugin.core.types import Degradation, Photograph
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import PosedPhotograph
from alpasim_plugin.gaussians.fit.views import logged_views
from alpasim_plugin.renderers.gaussian import scene_of
from alpasim_plugin.renderers.reconstruction_build import misplaced
from alpasim_plugin.renderers.reconstruction_key import recipe_of
from alpasim_plugin.renderers.recorded import (
    FIRST_US,
    INTERVAL_US,
    built_recording,
    photograph_image,
)
from tests.gaussians.scene_maps import straight, with_camera


def upside_down_by_exif(path, image):
    """Write a JPEG whose EXIF data ask viewers to turn it by 180 degrees."""
    data = cv2.imencode(".jpg", image)[1].tobytes()
    orientation = struct.pack(">HHIHH", 0x0112, 3, 1, 3, 0)
    tiff = b"MM" + struct.pack(">HIH", 42, 8, 1) + orientation + struct.pack(">I", 0)
    segment = b"Exif\0\0" + tiff
    header = b"\xff\xe1" + struct.pack(">H", 2 + len(segment))
    path.write_bytes(data[:2] + header + segment + data[2:])


def test_a_photograph_is_shown_as_it_was_fitted_however_viewers_should_turn_it(tmp_path):
    image = np.zeros((48, 64, 3), dtype=np.uint8)
    image[:24] = 200
    path = tmp_path / "0.jpg"
    upside_down_by_exif(path, image)
    assert cv2.imread(str(path))[0, 0, 0] < 100, "the tag is understood"
    K = intrinsics(50.0, 50.0, 32.0, 24.0)
    fitted = PosedPhotograph(path, Lens(64, 48, K), np.eye(4), "", 0, "front", {}).view()
    photograph = Photograph(0, "front", 64, 48, K, np.eye(4), str(path), "fitted", (1.0,) * 3)
    assert_array_equal(photograph_image(photograph, fitted.camera), fitted.rgb)
    with pytest.raises(InputError, match="64x48 pixels, the scenario says 64x50"):
        photograph_image(replace(photograph, height=50), fitted.camera)


def street(degradation):
    return with_camera(straight(degradation=degradation), 64, 36)


def test_a_built_scene_has_a_frame_of_every_camera_twice_a_second_never_at_the_time_of_a_rendered_one():
    scenario = street(Degradation("none"))
    scene = scene_of(scenario)
    frames = built_recording(scenario, scene, scene.render, None, scenario.cameras)
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
    (camera,) = scenario.cameras
    scene = scene_of(scenario)
    (frame, *_) = built_recording(scenario, scene, scene.render, recipe, scenario.cameras)
    (view, *_) = logged_views(scenario, scene, recipe.splat.views, 32)
    at_its_time = replace(view, t_us=frame.t_us)
    (moved,) = misplaced([at_its_time], recipe.pose_error_m, scenario.scene_id, recipe.splat.seed)
    true = inverse(interpolate(scenario.ego_log, frame.t_us) @ camera.T_rig_camera)
    of_view = moved.camera.T_camera_world @ inverse(view.camera.T_camera_world)
    np.testing.assert_allclose(inverse(frame.T_world_camera) @ inverse(true), of_view, atol=1e-9)
