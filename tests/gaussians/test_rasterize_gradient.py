"""Check the compiled backward pass on hard cases against finite differences of the reference."""

import numpy as np
import pytest
import torch

from alpasim_plugin.gaussians import GaussianCloud
from alpasim_plugin.gaussians.raster.rasterize_gradient import rasterize_gradient
from alpasim_plugin.gaussians.raster.rasterize_reference import (
    composite_reference,
    project_gaussians,
)
from alpasim_plugin.gaussians.raster.splats import Splats
from tests.examples import first_of
from tests.gaussians.driving_scene import driving_camera, driving_like_scene
from tests.gaussians.gaussian_scenes import camera, random_cloud
from tests.gaussians.gradient_scenes import (
    FIELDS,
    assert_close,
    central_differences,
    cloud_of,
    kernel_gradients,
    numeric_gradients,
    scene,
    weighted,
    weights_of,
)
from tests.gaussians.hard_gradients import HARD, SMALL, TOLERANCE, overlapping


def cloud_of_scene(s):
    return cloud_of(Splats(*(torch.tensor(a, dtype=torch.float32) for a in s.arrays().values())))


@pytest.mark.parametrize("make", first_of(HARD, 3))
def test_gradient_equals_finite_differences_of_the_reference(make):
    s = make()
    found, _ = kernel_gradients(s)
    assert_close(found, numeric_gradients(s), TOLERANCE)
    assert np.abs(found["means"]).max() > 1e-3


def test_image_equals_the_reference_without_its_clamp():
    cloud = random_cloud(300, 21)
    cam = camera()
    cloud = GaussianCloud(cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh * 3)
    splats = Splats.from_cloud(cloud)
    out = rasterize_gradient(splats, cam, background=torch.tensor([0.3, 0.2, 0.1]))
    projected = project_gaussians(cloud_of(splats), cam)
    colour, alpha, depth = composite_reference(projected, cam, np.array([[[0.3, 0.2, 0.1]]]))
    assert colour.max() > 1.2
    for found, wanted, atol in (
        (out.rgb, colour, 1e-4),
        (out.alpha, alpha, 2e-5),
        (out.depth * out.alpha, depth * alpha, 1e-3),
    ):
        assert np.mean(np.abs(found.numpy() - wanted) > atol) < 1e-3
    box = projected.radii()
    size = np.array([cam.width, cam.height])
    seen = np.all((projected.uv + box >= 0.5) & (projected.uv - box <= size - 0.5), axis=1)
    assert out.index[out.on_screen].tolist() == projected.index[seen].tolist()


def test_gradient_on_the_screen_is_that_of_the_projected_mean():
    s = overlapping()
    _, out = kernel_gradients(s)
    projected = project_gaussians(cloud_of_scene(s), s.camera)

    def loss():
        colour, alpha, depth = composite_reference(
            projected, s.camera, np.array(s.background).reshape(1, 1, 3)
        )
        return float(
            (
                np.concatenate(
                    [colour, alpha[..., None], s.depth_weight * depth[..., None]], axis=2
                )
                * weights_of(s.camera)
            ).sum()
        )

    numeric = central_differences(loss, projected.uv, 1e-6)
    assert out.index.tolist() == projected.index.tolist()
    assert np.allclose(out.uv.grad, numeric, rtol=1e-3, atol=1e-3 * np.abs(numeric).max())


@pytest.mark.parametrize("threads", first_of([2, 5]))
def test_image_and_gradients_do_not_depend_on_threads(threads):
    cloud = driving_like_scene(9000)
    cam = driving_camera(120, 70)
    runs = []
    for count in (1, threads):
        splats = Splats.from_cloud(cloud)
        leaves = [getattr(splats, name).requires_grad_(True) for name in FIELDS]
        out = rasterize_gradient(splats, cam, threads=count)
        (out.rgb.square().sum() + out.alpha.sum() + 0.1 * out.depth.sum()).backward()
        runs.append(
            [
                out.rgb.detach(),
                out.alpha.detach(),
                out.depth.detach(),
                out.uv.grad,
                *(leaf.grad for leaf in leaves),
            ]
        )
    assert int(out.on_screen.sum()) > 5000
    for one, other in zip(*runs, strict=True):
        assert one.abs().max() > 0
        assert torch.equal(one, other)


@pytest.mark.parametrize(("n", "depth"), [(0, 1.0), (3, -1.0)])
def test_nothing_visible_shows_the_background_and_moves_nothing_else(n, depth):
    s = scene(np.full((n, 3), [0.0, 0.0, depth]), np.full((n, 3), 0.1), SMALL)
    found, out = kernel_gradients(s)
    assert torch.equal(out.rgb.detach(), torch.tensor(s.background).expand(18, 24, 3))
    assert not out.on_screen.any()
    assert np.allclose(found["background"], weights_of(SMALL)[..., :3].sum(axis=(0, 1)), atol=1e-4)
    for name in FIELDS:
        assert (found[name] == 0).all()
        assert found[name].shape == s.arrays()[name].shape


def test_a_background_image_gets_its_gradient_through_what_is_transparent():
    s = overlapping()
    splats = Splats(*(torch.tensor(a, dtype=torch.float32) for a in s.arrays().values()))
    image = torch.rand(18, 24, 3, generator=torch.Generator().manual_seed(0)).requires_grad_(True)
    out = rasterize_gradient(splats, s.camera, background=image)
    weighted(out, s).backward()
    assert torch.allclose(
        image.grad,
        (1 - out.alpha)[..., None] * torch.tensor(weights_of(s.camera)[..., :3]).float(),
        atol=1e-6,
    )
