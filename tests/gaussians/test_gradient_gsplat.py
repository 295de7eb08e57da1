"""Exercise the GPU way to train without a GPU: arguments, results and gradients against a stand-in
that follows gsplat's interface.
"""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError, RendererError
from alpasim_plugin.gaussians import PinholeCamera
from alpasim_plugin.gaussians.raster import rasterize_gsplat
from alpasim_plugin.gaussians.raster.gradient_types import Splats
from alpasim_plugin.gaussians.raster.rasterize_gradient import rasterize_gradient
from alpasim_plugin.gaussians.raster.rasterize_gsplat import rasterize_gradient_gsplat
from tests.gaussians.gaussian_scenes import camera, random_cloud, random_rigid
from tests.gaussians.gradient_scenes import FIELDS
from tests.gaussians.torch_rasterizer import GaussianTensors, rasterize_tensors


def stand_in(
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
    packed,
    render_mode,
    sh_degree,
    **_,
):
    """Return what ``gsplat.rasterization`` returns for one camera, unpacked; means on the screen
    get a gradient of (3, 4) each.
    """
    assert not packed
    assert render_mode == "RGB+ED"
    assert colors.shape == (len(means), (sh_degree + 1) ** 2, 3)
    assert torch.allclose(quats.norm(dim=1), torch.ones(len(quats)))
    cam = PinholeCamera(width, height, Ks[0].double().numpy(), viewmats[0].double().numpy())
    out = rasterize_tensors(
        GaussianTensors(means, quats, scales, opacities, colors), cam, near_m=near_plane
    )
    on_screen = torch.zeros(1, len(means), 2) + 0 * means[None, :, :2]
    image = torch.cat([out.rgb, out.depth[..., None]], dim=2)
    image = image + (on_screen * torch.tensor([3.0, 4.0])).sum() / out.rgb.numel() * torch.tensor(
        [1.0, 1.0, 1.0, 0.0]
    )
    radii = torch.tensor([[7, 9]]).expand(len(means), 2)
    return image[None], out.alpha[None, ..., None], {"means2d": on_screen, "radii": radii[None]}


@pytest.fixture
def gsplat(monkeypatch):
    """Replace gsplat by the stand-in; the one-Gaussian check of the device has tests of its own."""
    module = types.ModuleType("gsplat")
    module.rasterization = stand_in
    monkeypatch.setattr(
        "alpasim_plugin.gaussians.raster.rasterize_gsplat.require_gsplat", lambda device: module
    )


def test_gradients_and_images_equal_those_of_the_cpu(gsplat):
    T = random_rigid(4)
    cloud, cam = random_cloud(60, 4, 1).transformed(T), camera(T_camera_world=np.linalg.inv(T))
    results = []
    for draw in (
        rasterize_gradient,
        lambda s, c, background: rasterize_gradient_gsplat(s, c, background, 0.1),
    ):
        splats = Splats.from_cloud(cloud)
        leaves = [getattr(splats, name).requires_grad_(True) for name in FIELDS]
        out = draw(splats, cam, background=torch.tensor([0.2, 0.4, 0.6]))
        (out.rgb.sum() + out.depth.sum()).backward()
        results.append((out, [leaf.grad for leaf in leaves]))
    (wanted, wanted_gradients), (found, found_gradients) = results
    assert (found.rgb - wanted.rgb).abs().max() < 1e-4
    assert (found.alpha - wanted.alpha).abs().max() < 1e-4
    for name, one, other in zip(FIELDS, found_gradients, wanted_gradients, strict=True):
        assert (one - other).norm() < 1e-3 * other.norm(), name


def test_what_density_control_needs_comes_from_gsplat_s_own_records(gsplat):
    splats = Splats.from_cloud(random_cloud(5, 4))
    splats.means.requires_grad_(True)
    out = rasterize_gradient_gsplat(splats, camera(), None, 0.1)
    assert out.screen.radii.tolist() == [9] * 5
    assert out.screen.gradient_norm is None
    out.rgb.sum().backward()
    assert torch.allclose(out.screen.gradient_norm, torch.full((5,), 5.0))


def test_a_device_without_gsplat_is_an_error_and_not_the_cpu(monkeypatch):
    rasterize_gsplat.require_gsplat.cache_clear()
    monkeypatch.setitem(sys.modules, "gsplat", None)
    splats = Splats(*(t.to("meta") for t in vars(Splats.from_cloud(random_cloud(3))).values()))
    with pytest.raises(RendererError):
        rasterize_gradient(splats, camera())
    rasterize_gsplat.require_gsplat.cache_clear()


def test_tensors_on_two_devices_are_refused():
    t = vars(Splats.from_cloud(random_cloud(3)))
    with pytest.raises(InputError):
        rasterize_gradient(Splats(**{**t, "sh": t["sh"].to("meta")}), camera())


@pytest.mark.gpu
def test_gpu_gradients_equal_those_of_the_cpu():
    cloud, results = random_cloud(300, 4), []
    cloud = type(cloud)(
        cloud.means, cloud.quats, cloud.scales, np.minimum(cloud.opacities, 0.9), cloud.sh
    )  # gsplat 1.5 saturates at 0.999
    for device in ("cpu", "cuda"):
        splats = Splats.from_cloud(cloud, device=device)
        leaves = [getattr(splats, name).requires_grad_(True) for name in FIELDS]
        out = rasterize_gradient(splats, camera())
        (out.rgb.sum() + out.depth.sum()).backward()
        results.append([leaf.grad.cpu() for leaf in leaves] + [out.screen.gradient_norm.cpu()])
    for one, other in zip(*results, strict=True):
        assert (one - other).norm() < 1e-2 * other.norm()
