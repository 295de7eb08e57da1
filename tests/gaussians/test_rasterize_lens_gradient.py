"""Check gradients through lenses against finite differences of the definition."""

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import CameraSpec, LensModel
from alpasim_plugin.gaussians import GaussianCloud
from alpasim_plugin.gaussians.cloud import sigmoid
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster import rasterize_lens_gradient
from alpasim_plugin.gaussians.raster.rasterize_gradient import Splats, rasterize_gradient
from tests.gaussians.gradient_scenes import (
    assert_close,
    central_differences,
    kernel_gradients,
    scene,
    weights_of,
)
from tests.gaussians.lens_reference import LensReference
from tests.gaussians.test_rasterize_lens import BACK, WORLD, camera as rolling_camera, pose

WIDTH = 24
HEIGHT = 18
LENSES = {
    "opencv": (
        14.0,
        LensModel(
            "opencv",
            (-0.28, 0.08, 1e-2, -7e-3, -0.01, 0.0, 0.0, 0.0, 1e-2, -5e-3, 8e-3, 3e-3),
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
BESIDE = [[3.0, 0.2, 0.5], [-2.0, 0.3, -0.2], [0.1, 2.0, 0.1]]
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
        image = np.concatenate([colour, alpha[..., None], s.depth_weight * depth[..., None]], axis=2)
        return float((image * weights_of(s.camera)).sum())

    return {name: central_differences(loss, array, 1e-6) for name, array in values.items()}


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("case", CASES)
def test_gradients_are_finite_differences_of_the_definition(case, name):
    s = CASES[case](name)
    gradients, out = kernel_gradients(s)
    assert_close(gradients, numeric(s), 1e-3)
    assert np.abs(gradients["means"]).max() > 1e-3
    assert len(out.index) > 0
