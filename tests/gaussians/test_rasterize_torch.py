"""Check the gradients of the torch rasteriser against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from alpasim_plugin.gaussians.sh import sh_colours
from tests.gaussians.gaussian_scenes import assert_same_image, camera, random_cloud, random_rigid
from tests.gaussians.torch_rasterizer import (
    GaussianTensors,
    rasterize_tensors,
    rasterize_torch,
    sh_colours_torch,
)

FIELDS = ("means", "quats", "scales", "opacities", "sh")


def smooth_scene(n: int = 4) -> GaussianTensors:
    """Wide translucent splats over a small image: no pixel near the alpha cut or the stop, so the
    image is differentiable.
    """
    rng = np.random.default_rng(5)
    return GaussianTensors(
        *(
            torch.tensor(a, dtype=torch.float64)
            for a in (
                rng.uniform([-0.3, -0.3, 2.0], [0.3, 0.3, 4.0], (n, 3)),
                rng.normal(size=(n, 4)),
                rng.uniform(1.0, 2.5, (n, 3)),
                rng.uniform(0.2, 0.6, n),
                rng.normal(size=(n, 4, 3)) * 0.1,
            )
        )
    )


def loss_of(tensors: GaussianTensors, pose: torch.Tensor | None = None) -> torch.Tensor:
    cam = camera(9, 7, 6.0)
    out = rasterize_tensors(
        tensors, cam, torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64), T_camera_world=pose
    )
    weights = torch.tensor(np.random.default_rng(1).normal(size=(7, 9, 5)))
    return (torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None]], dim=2) * weights).sum()


def numeric_gradient(function, value: torch.Tensor, step: float = 1e-6) -> torch.Tensor:
    gradient = torch.zeros_like(value)
    flat, out = value.view(-1), gradient.view(-1)
    for i in range(flat.numel()):
        kept = float(flat[i])
        flat[i] = kept + step
        high = float(function())
        flat[i] = kept - step
        out[i] = (high - float(function())) / (2 * step)
        flat[i] = kept
    return gradient


@pytest.mark.parametrize("field", FIELDS)
def test_gradient_equals_finite_differences(field):
    scene = smooth_scene()
    value = getattr(scene, field)
    value.requires_grad_(True)
    loss_of(scene).backward()
    analytic = value.grad.clone()
    value.requires_grad_(False)
    numeric = numeric_gradient(lambda: loss_of(scene), value)
    assert analytic.abs().max() > 1e-3
    assert torch.allclose(analytic, numeric, rtol=1e-5, atol=1e-7), (analytic - numeric).abs().max()


def test_gradient_of_the_camera_pose_equals_finite_differences():
    scene = smooth_scene()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.05, -0.02, 0.1])
    pose.requires_grad_(True)
    loss_of(scene, pose).backward()
    analytic = pose.grad[:3, 3].clone()
    pose = pose.detach()
    numeric = numeric_gradient(lambda: loss_of(scene, pose), pose)[:3, 3]
    assert analytic.abs().max() > 1e-3
    assert torch.allclose(analytic, numeric, rtol=1e-5, atol=1e-7)


def test_double_precision_equals_the_reference():
    cloud, T = random_cloud(300, 13), random_rigid(13)
    cam = camera(T_camera_world=np.linalg.inv(T))
    cloud = cloud.transformed(T)
    found = rasterize_torch(cloud, cam, (0.3, 0.2, 0.1), dtype=torch.float64)
    assert_same_image(found, rasterize_reference(cloud, cam, (0.3, 0.2, 0.1), brute=True), 1e-6)


def test_given_pose_replaces_that_of_the_camera():
    scene = smooth_scene()
    T = np.eye(4)
    T[:3, 3] = [0.1, 0.2, 0.3]
    by_camera = rasterize_tensors(scene, camera(T_camera_world=T)).rgb
    assert torch.equal(
        by_camera, rasterize_tensors(scene, camera(), T_camera_world=torch.tensor(T)).rgb
    )


@pytest.mark.parametrize("size", [1, 4, 9, 16])
def test_harmonics_equal_the_numpy_twin(size):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(40, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    sh = rng.normal(size=(40, size, 3))
    assert (
        np.abs(
            sh_colours_torch(torch.tensor(sh), torch.tensor(d)).numpy() - sh_colours(sh, d)
        ).max()
        < 1e-12
    )
