"""Exercise the GPU backend without a GPU: its errors, and its arguments against a stand-in that
follows gsplat's interface.
"""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera, rasterize
from alpasim_plugin.gaussians.raster import rasterize_gsplat
from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from tests.gaussians.gaussian_scenes import (
    assert_same_image,
    camera,
    random_cloud,
    random_rigid,
    splats,
)
from tests.gaussians.torch_rasterizer import GaussianTensors, rasterize_tensors


def stand_in(**changes):
    """Return a module whose `rasterization` takes and returns what gsplat's does, computed on the
    CPU.
    """

    def rasterization(
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmats,
        Ks,
        width,
        height,
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        sh_degree,
        packed,
        tile_size,
        render_mode,
        rasterize_mode,
    ):
        n = len(means)
        assert (means.shape, quats.shape, scales.shape, opacities.shape) == (
            (n, 3),
            (n, 4),
            (n, 3),
            (n,),
        )
        assert colors.shape == (n, (sh_degree + 1) ** 2, 3)
        assert viewmats.shape == (1, 4, 4)
        assert Ks.shape == (1, 3, 3)
        assert all(
            t.dtype == torch.float32
            for t in (means, quats, scales, opacities, colors, viewmats, Ks)
        )
        assert (render_mode, rasterize_mode, eps2d, radius_clip, far_plane) == (
            "RGB+ED",
            "classic",
            0.3,
            0.0,
            1e10,
        )
        cam = PinholeCamera(width, height, Ks[0].double().numpy(), viewmats[0].double().numpy())
        out = rasterize_tensors(
            GaussianTensors(means, quats, scales, opacities, colors), cam, near_m=near_plane
        )
        return (
            torch.cat([out.rgb, out.depth[..., None]], dim=2)[None],
            out.alpha[None, ..., None],
            {},
        )

    module = types.ModuleType("gsplat")
    module.rasterization = changes.get("rasterization", rasterization)
    return module


@pytest.fixture
def fresh(monkeypatch):
    rasterize_gsplat.require_gsplat.cache_clear()
    yield monkeypatch
    rasterize_gsplat.require_gsplat.cache_clear()


def draw(*args, **kwargs):
    return rasterize_gsplat.rasterize_gsplat(*args, device="cpu", **kwargs)


def test_missing_package_is_one_clear_error_and_no_fallback(fresh):
    fresh.setitem(sys.modules, "gsplat", None)
    with pytest.raises(RendererError) as error:
        rasterize(splats([0, 0, 3.0]), camera(), backend="gsplat")
    assert error.value.exit_code == 4


def test_missing_device_is_one_clear_error(fresh):
    fresh.setattr(torch.cuda, "is_available", lambda: False)
    fresh.setitem(sys.modules, "gsplat", stand_in())
    with pytest.raises(RendererError):
        rasterize(splats([0, 0, 3.0]), camera(), backend="gsplat")


def test_a_kernel_that_does_not_build_is_reported_with_its_cause(fresh):
    def broken(**_):
        raise OSError("nvcc not found")

    fresh.setitem(sys.modules, "gsplat", stand_in(rasterization=broken))
    with pytest.raises(RendererError):
        draw(splats([0, 0, 3.0]), camera())


def test_a_kernel_that_draws_nothing_is_reported(fresh):
    def blank(width, height, **_):
        return torch.zeros(1, height, width, 4), torch.zeros(1, height, width, 1), {}

    fresh.setitem(sys.modules, "gsplat", stand_in(rasterization=blank))
    with pytest.raises(RendererError):
        draw(splats([0, 0, 3.0]), camera())


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_arguments_and_results_reproduce_the_reference(fresh, degree):
    fresh.setitem(sys.modules, "gsplat", stand_in())
    T = random_rigid(4)
    T[:3, 3] += [4.5e5, 5.4e6, 100.0]
    base = random_cloud(200, 4, degree)
    cloud = base.transformed(T)
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    cam = camera(T_camera_world=inverse)
    image = np.random.default_rng(0).uniform(0, 1, (64, 96, 3))
    assert_same_image(
        draw(cloud, cam, image, near_m=0.5),
        rasterize_reference(cloud, cam, image, near_m=0.5),
        1e-4,
        odd_share=1e-3,
    )


def test_empty_cloud_needs_no_kernel_call(fresh):
    fresh.setitem(sys.modules, "gsplat", stand_in())
    assert np.all(
        draw(GaussianCloud.empty(), camera(), (0.1, 0.2, 0.3)).rgb == np.float32([0.1, 0.2, 0.3])
    )


@pytest.mark.gpu
def test_gpu_image_equals_the_reference():
    cloud = random_cloud(300, 4)
    # gsplat 1.5.3 saturates at 0.999 where this package does at 0.99: one per cent of full scale.
    assert_same_image(
        rasterize(cloud, camera(), backend="gsplat"),
        rasterize_reference(cloud, camera()),
        0.011,
        odd_share=1e-3,
    )
