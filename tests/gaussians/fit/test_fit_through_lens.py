"""Photographs with distortion: whole in their lens's image, measured in that without it, fitted through
the lens.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.types import CameraSpec, LensModel
from alpasim_plugin.gaussians.fit import drive
from alpasim_plugin.gaussians.fit.drive import prepared_views
from alpasim_plugin.gaussians.fit.lens import (
    Lens,
    distances_through_lens,
    through_lens,
    without_distortion,
)
from alpasim_plugin.gaussians.fit.loop import SplatFit, fit
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.start import Start
from alpasim_plugin.gaussians.fit.views import PosedView, halved, seen_from
from alpasim_plugin.gaussians.lens_camera import LensCamera
from tests.gaussians.fit.conftest import HEIGHT, WIDTH, actor_pose, camera_at

LENSES = {
    "opencv": Lens(WIDTH, HEIGHT, np.array([[30.0, 0, 24.5], [0, 31.0, 15.5], [0, 0, 1]]), np.array([-0.25, 0.06, 1e-3, -2e-3])),
    "fisheye": Lens(WIDTH, HEIGHT, np.array([[16.0, 0, 24.0], [0, 16.0, 16.0], [0, 0, 1]]), np.array([0.02, -0.003, 0.0, 0.0]), "fisheye"),
}  # fmt: skip


def lens_camera_at(name, y_m):
    return LENSES[name].camera(name, np.linalg.inv(camera_at(y_m).T_camera_world))


def seen(posed, name, i):
    """Return a view of the posed scene through a lens."""
    camera = lens_camera_at(name, 0.4 * i - 1.4)
    view = seen_from(camera, posed.scene, {"car": actor_pose(i)}, f"view-{i}", 1)
    return replace(view, mask=None if camera.visible.all() else camera.visible)


@pytest.mark.parametrize("name", LENSES)
def test_a_fit_through_a_lens_comes_near_to_photographs_that_it_did_not_see(posed, name):
    views = [seen(posed, name, i) for i in range(8)]
    held = views.pop(3)
    recipe = replace(SplatRecipe.street(), steps=60, coarse_share=0.3, lr_exposure=0.0)
    model = fit(views, posed.start, recipe, scene_id="fit-tests", threads=1)
    drawn = []
    for background, actors in (
        (posed.start.background, posed.start.actors),
        (model.background, model.actors),
    ):
        graph = replace(model, background=background, actors=actors).graph()
        image = graph.render(held.camera, {"car": actor_pose(3)}, 1).to_uint8()
        drawn.append(psnr_db(image[held.camera.visible], held.rgb[held.camera.visible]))
    assert drawn[1] > drawn[0] + 3.0


def test_a_halved_view_through_a_lens_looks_along_the_rays_of_every_second_pixel():
    spec = CameraSpec("f", 41, 31, np.array([[1.0, 0, 20], [0, 1, 15], [0, 0, 1]]), np.eye(4), 0,
                      LensModel("ftheta", (0.0, 30.0, 0.0, -0.5)))  # fmt: skip
    for camera in (lens_camera_at("opencv", 0.0), LensCamera.from_pose(spec, np.eye(4))):
        rgb = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
        small = halved(PosedView(camera, rgb)).camera
        assert (small.height, small.width) == (camera.height // 2, camera.width // 2)
        every_second = camera.rays()[: 2 * small.height : 2, : 2 * small.width : 2]
        np.testing.assert_allclose(small.rays(), every_second, atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_depth_of_the_image_without_distortion_is_distance_in_that_of_the_lens(name):
    """A slanted plane, whose depth at each pixel of the pinhole is that of the pixel's ray."""
    camera = lens_camera_at(name, 0.0)
    rgb = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    pinhole = without_distortion(PosedView(camera, rgb)).pinhole
    rows, columns = np.divmod(np.arange(HEIGHT * WIDTH), WIDTH)
    slope = pinhole.unprojected(rows, columns, np.ones(len(rows)))
    depth = (5.0 / (1 - 0.2 * slope[:, 0])).reshape(HEIGHT, WIDTH).astype(np.float32)
    distance = distances_through_lens(camera, pinhole, depth)
    ray = camera.rays()
    expected = 5.0 / (ray[..., 2] - 0.2 * ray[..., 0])
    reached = through_lens(camera, pinhole, np.ones_like(depth)) > 0
    assert 0.2 < reached.mean() < 1.0
    np.testing.assert_allclose(distance[reached], expected[reached], rtol=0.01)
    assert not distance[~reached].any()


def test_what_is_measured_without_distortion_stands_in_views_that_stay_whole(posed, monkeypatch):
    views = [replace(seen(posed, "opencv", i), depth=None, sky=None) for i in range(4)]
    depths = [np.full((HEIGHT, WIDTH), 5.0 + i, dtype=np.float32) for i in range(4)]
    upper = np.zeros((HEIGHT, WIDTH), dtype=np.bool_)
    upper[: HEIGHT // 2] = True
    gains = np.arange(12.0).reshape(4, 3) + 1
    monkeypatch.setattr(drive, "LEAST_WAY_M", 0.1)
    monkeypatch.setattr(drive, "depth_maps", lambda *_: depths)
    monkeypatch.setattr(drive, "sky_masks", lambda images: [upper] * len(images))
    monkeypatch.setattr(drive, "balances", lambda *_: gains)
    done, _ = prepared_views(views[::-1], lambda *_: None)
    for view, measured, depth, gain in zip(views, done, depths, gains, strict=True):
        assert measured.camera is view.camera
        assert measured.rgb is view.rgb
        assert measured.gain == tuple(gain)
        pinhole = without_distortion(view).pinhole
        sky = through_lens(view.camera, pinhole, upper.astype(np.float32)) > 0
        assert 0.1 < sky.mean() < 0.6
        np.testing.assert_array_equal(measured.sky, sky)
        distance = distances_through_lens(view.camera, pinhole, np.where(upper, 0, depth))
        assert distance.max() > depth.max() + 0.1
        np.testing.assert_array_equal(measured.depth, distance)


def test_a_pinhole_is_measured_as_it_is(posed):
    view = posed.views[0]
    assert without_distortion(view) is view


def test_an_f_theta_lens_has_no_image_without_distortion(posed):
    camera = lens_camera_at("fisheye", 0.0)
    spec = replace(camera.spec, lens=LensModel("ftheta", (0.0, 16.0)))
    rgb = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    with pytest.raises(InputError, match="f-theta"):
        without_distortion(PosedView(replace(camera, spec=spec), rgb))


def test_a_fit_begun_through_another_lens_is_not_continued(posed, tmp_path):
    recipe = SplatRecipe(steps=1)
    first, second = (replace(posed.views[0], camera=lens_camera_at(name, 0.0)) for name in LENSES)
    fit([first], posed.start, recipe, folder=tmp_path, threads=1)
    with pytest.raises(InputError):
        SplatFit([second], Start(posed.start.background, {}), recipe, "", 1, tmp_path)
