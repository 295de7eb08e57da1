"""Check gradients through lenses against finite differences of the definition."""

import gc
import weakref

import numpy as np
import pytest
import torch

from alpasim_plugin.cameras.lens import projected, rays_at
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import CameraSpec, LensModel
from alpasim_plugin.gaussians import GaussianCloud, rasterize
from alpasim_plugin.gaussians.cloud import sigmoid
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster import rasterize_lens_gradient
from alpasim_plugin.gaussians.raster.rasterize_gradient import rasterize_gradient
from alpasim_plugin.gaussians.raster.rasterize_lens import drawn_splats
from alpasim_plugin.gaussians.raster.rasterize_lens_gradient import _is_along_ray, _prepared
from alpasim_plugin.gaussians.raster.splats import Splats
from tests.gaussians.gradient_scenes import (
    assert_close,
    central_differences,
    kernel_gradients,
    scene,
    weights_of,
)
from tests.gaussians.lens_reference import LensReference
from tests.gaussians.lens_scenes import WORLD, around, cloud_of
from tests.gaussians.lens_scenes import camera as rolling_camera

WIDTH = 24
HEIGHT = 18
TOLERANCE = 2e-3  # of the largest gradient of a Gaussian in a field
LENSES = {
    "opencv": (
        14.0,
        LensModel(
            "opencv",
            (-0.1, 0.01, 1e-2, -7e-3, 0.0, 0.0, 0.0, 0.0, 1e-2, -5e-3, 8e-3, 3e-3),
        ),
    ),
    "fisheye": (7.0, LensModel("fisheye", (0.02, -0.004, 0.001), max_angle_rad=np.deg2rad(100))),
    "ftheta": (1.0, LensModel("ftheta", (0.0, 12.0, 0.0, -0.2), (), (1.01, 0.01, -0.02))),
}


def camera(name, focal_px=0.0):
    focal, lens = LENSES[name]
    focal = focal_px or focal
    K = np.array([[focal, 0, WIDTH / 2 + 1], [0, 1.02 * focal, HEIGHT / 2 - 1], [0, 0, 1]])
    spec = CameraSpec(name, WIDTH, HEIGHT, K, np.eye(4), 0, lens)
    return LensCamera.from_pose(spec, WORLD)


def in_world(p):
    return np.asarray(p) @ WORLD[:3, :3].T + WORLD[:3, 3]


def placed(p, scales, cam, **other):
    """Return a scene of Gaussians at places of the camera's axes."""
    return scene(in_world(p), scales, cam, **other)


AHEAD = [[0.3, -0.2, 2.0], [-0.5, 0.1, 3.0], [0.1, 0.4, 4.0], [0.9, 0.2, 2.5]]
BESIDE = [[3.0, 0.2, 0.5], [-2.4, 0.3, -0.2], [0.1, 2.0, 0.1]]
ALONG = [[0.95, 0.05, 0.02, 0.3], [0.9, 0.0, 0.01, -0.2], [0.99, 0.01, 0.02, 0.05]]
CASES = {
    "overlapping": lambda name: placed(AHEAD, [[0.5, 0.3, 0.4]], camera(name)),
    "beside and behind": lambda name: placed(BESIDE, [[0.8, 0.5, 0.6]], camera(name)),
    "needles": lambda name: placed(
        [[0.02, 0.01, 0.4], [-0.1, 0.0, 0.8], [0.2, 0.1, 1.0]],
        [[2.0, 0.004, 0.004], [5.0, 0.008, 0.002], [12.0, 0.01, 0.01]],
        camera(name),
        quaternions=ALONG,
    ),
    "discs": lambda name: placed(AHEAD, [[1.0, 0.8, 1e-4]], camera(name)),
    "enclosing": lambda name: placed(
        [[0.1, 0.3, 0.4], [0.2, -0.3, -0.5], [0.0, 0.0, 2.0]],
        [[1.5, 1.0, 0.8], [1.2, 1.0, 0.9], [0.4, 0.3, 0.2]],
        camera(name),
    ),
    "smaller than a pixel": lambda name: placed(AHEAD, [[0.01, 0.02, 0.005]], camera(name)),
    "opaque": lambda name: placed(
        AHEAD, [[0.5, 0.4, 0.4]], camera(name), opacities=[0.6, 0.999, 0.998, 0.9]
    ),
}


def numeric(s):
    """Return central differences of the definition, of each field and of the background."""
    values = {name: array.copy() for name, array in s.arrays().items()}
    values["background"] = np.array(s.background)

    def loss():
        quaternions = values["quaternions"]
        cloud = GaussianCloud(
            values["means"],
            quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
            np.exp(values["log_scales"]),
            sigmoid(values["logit_opacities"]),
            values["sh"],
        )
        colour, alpha, depth = LensReference([(cloud, None)], s.camera).image()
        colour = colour + (1 - alpha)[..., None] * values["background"]
        image = np.concatenate(
            [colour, alpha[..., None], s.depth_weight * depth[..., None]], axis=2
        )
        return float((image * weights_of(s.camera)).sum())

    return {name: central_differences(loss, array, 1e-6) for name, array in values.items()}


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("case", CASES)
def test_gradients_are_finite_differences_of_the_definition(case, name):
    s = CASES[case](name)
    gradients, out = kernel_gradients(s)
    assert_close(gradients, numeric(s), TOLERANCE)
    assert np.abs(gradients["means"]).max() > 1e-3
    assert len(out.index) > 0


@pytest.mark.parametrize("name", ["opencv", "fisheye"])
def test_gradients_of_ellipses_are_nearly_those_of_the_definition(name):
    cam = camera(name, 700.0)
    rays = cam.rays()[[4, 9, 13], [6, 12, 20]]
    s = placed(rays * [[9.0], [11.0], [14.0]], [[0.02, 0.015, 0.018]], cam)
    gradients, out = kernel_gradients(s)
    assert not _is_along_ray(drawn_of(s)).any()
    assert len(out.index) == 3
    assert_close(gradients, numeric(s), 0.03)


def drawn_of(s):
    nodes = [(_prepared(splats_of(s)), None)]
    return drawn_splats(nodes, s.camera, near_m=0.1, threads=1)


def splats_of(s):
    return Splats(*(torch.tensor(array, dtype=torch.float32) for array in s.arrays().values()))


@pytest.mark.parametrize(("name", "focal_px"), [("fisheye", 60.0), ("opencv", 700.0)])
def test_the_gradient_on_the_image_moves_means_across_the_lines_of_sight(name, focal_px):
    """Along rays and as ellipses: with its chain through the lens it is what the means receive but for
    what their distance, the size of a pixel there and the colours' directions change.
    """
    cam = camera(name, focal_px)
    rays = cam.rays()[[4, 9, 13], [6, 12, 20]]
    size = 0.5 if name == "fisheye" else 0.02
    sh = np.full((3, 1, 3), 0.3)
    s = placed(rays * [[9.0], [11.0], [14.0]], np.full((3, 3), size), cam, sh=sh)
    gradients, out = kernel_gradients(s)
    moved = 1e-4
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = moved
        pixel, _ = projected(cam.spec, rays)
        turned = rays_at(cam.spec, pixel + step).ray
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        by_step = (turned - rays) / moved * [[9.0], [11.0], [14.0]] @ cam.T_camera_world[:3, :3]
        expected = (gradients["means"][out.index] * by_step[out.index]).sum(axis=1)
        largest = np.abs(out.uv.grad.numpy()).max()
        assert np.allclose(out.uv.grad[:, axis].double(), expected, atol=0.02 * largest)
    assert largest > 1e-2


def test_the_image_is_that_of_the_renderer():
    rng = np.random.default_rng(1)
    cloud = cloud_of(
        around(300, 2), np.exp(rng.uniform(-4, 0, (300, 3))), rng.uniform(0.05, 1, 300)
    )
    cam = camera("fisheye")
    behind = (0.3, 0.2, 0.1)
    drawn = rasterize(cloud, cam, behind)
    out = rasterize_gradient(Splats.from_cloud(cloud), cam, background=torch.tensor(behind))
    for image, expected, most in (
        (out.rgb.clamp(0, 1), drawn.rgb, 1e-4),
        (out.alpha, drawn.alpha, 1e-4),
        (out.depth, drawn.depth, 1e-2),
    ):
        assert np.mean(np.abs(image.numpy() - expected) > most) < 5e-3
    assert drawn.alpha[cam.visible].mean() > 0.1


def test_gradients_do_not_depend_on_threads():
    rng = np.random.default_rng(3)
    cloud = cloud_of(around(9000, 4), np.exp(rng.uniform(-4, -2, (9000, 3))))
    runs = []
    for threads in (1, 2):
        splats = Splats.from_cloud(cloud)
        splats.means.requires_grad_(True)
        splats.log_scales.requires_grad_(True)
        out = rasterize_gradient(splats, rolling_camera("fisheye"), threads=threads)
        (out.rgb.square().sum() + out.alpha.sum() + 0.1 * out.depth.sum()).backward()
        runs.append([out.rgb.detach(), splats.means.grad, splats.log_scales.grad])
    for first, second in zip(*runs, strict=True):
        assert first.abs().max() > 0
        assert torch.equal(first, second)


def test_a_basis_that_jumps_is_that_of_the_records():
    """Whitened means across the last axis, where rounding decides which basis a record is of."""
    p = [[0.8, 0.3, 0.0], [-0.9, 0.2, 0.0], [0.5, -0.7, 0.0], [0.6, 0.65, 0.0]]
    sizes = [[0.5, 0.5, 0.5]]
    spec = camera("fisheye").spec
    cam = LensCamera.from_pose(spec, np.eye(4))
    s = scene(p, sizes, cam, quaternions=[1.0, 0.0, 0.0, 0.0])
    gradients, _ = kernel_gradients(s)
    assert_close(gradients, numeric(s), TOLERANCE)


def test_memory_of_an_image_is_given_back_after_its_gradient(monkeypatch):
    """A graph that holds its own images would be collected by nobody: every update of a fit would stay."""
    views = []
    init = rasterize_lens_gradient._LensView.__init__

    def noted(view, *args):
        init(view, *args)
        views.append(weakref.ref(view))

    monkeypatch.setattr(rasterize_lens_gradient._LensView, "__init__", noted)
    cam = camera("opencv")
    splats = splats_of(placed(AHEAD, [[0.5, 0.3, 0.4]], cam))
    splats.means.requires_grad_()
    rasterize_gradient(splats, cam, threads=1).rgb.sum().backward()
    gc.collect()
    assert [view() for view in views] == [None]


def test_what_cannot_be_fitted_is_refused():
    s = CASES["overlapping"]("fisheye")
    with pytest.raises(InputError, match="rolling shutter"):
        rasterize_gradient(splats_of(s), rolling_camera("fisheye", True))
