"""Check the compiled backward pass on hard cases against finite differences of the reference."""

import numpy as np
import pytest
import torch

from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera
from alpasim_plugin.gaussians.raster.rasterize_gradient import Splats, rasterize_gradient
from alpasim_plugin.gaussians.raster.rasterize_reference import (
    composite_reference,
    project_gaussians,
)
from alpasim_plugin.gaussians.sh import dc_from_rgb
from tests.gaussians.driving_scene import driving_camera, driving_like_scene
from tests.gaussians.gaussian_scenes import camera, random_cloud, random_rigid
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

pytestmark = pytest.mark.slow

SMALL = camera(24, 18, 20.0)
TOLERANCE = (
    5e-4  # of the largest gradient of a Gaussian in a field; float32 sums of terms that cancel
)


def cloud_of_scene(s):
    return cloud_of(Splats(*(torch.tensor(a, dtype=torch.float32) for a in s.arrays().values())))


def overlapping():
    rng = np.random.default_rng(3)
    means = rng.uniform([-0.6, -0.5, 1.5], [0.6, 0.5, 4.0], (3, 3))
    return scene(means, rng.uniform(0.1, 0.5, (3, 3)), SMALL, opacities=rng.uniform(0.2, 0.95, 3))


def needles_before_the_camera():
    """Splats of up to 3000 pixels by half a pixel, at 0.3 to 1 m."""
    means = [[0.02, 0.01, 0.3], [-0.05, 0.0, 0.6], [0.1, 0.05, 1.0]]
    scales = [[2.0, 0.002, 0.002], [5.0, 0.004, 0.001], [12.0, 0.003, 0.004]]
    aslant = [[0.95, 0.05, 0.02, 0.3], [0.9, 0.0, 0.01, -0.2], [0.99, 0.01, 0.02, 0.05]]
    return scene(means, scales, camera(24, 18, 250.0), quaternions=aslant, opacities=0.7)


def centres_outside_with_clamped_slopes():
    means = [[2.4, 0.0, 1.4], [0.1, -2.2, 1.5], [-2.6, 2.1, 1.6]]
    return scene(means, [[0.9, 0.8, 0.7]], SMALL)


def opaque_stack():
    """Layers of opacity 0.999: alpha is held at 0.99 and the second such layer ends the pixel."""
    means = [[0.0, 0.0, 2.0], [0.05, 0.0, 2.2], [0.0, 0.05, 2.4], [0.1, 0.0, 2.6], [0.0, 0.0, 6.0]]
    return scene(means, [[0.35, 0.3, 0.3]], SMALL, opacities=[0.6, 0.999, 0.998, 0.9, 0.9])


def smaller_than_the_low_pass():
    return scene(
        [[0.1, 0.1, 4.0], [-0.5, 0.2, 5.0], [0.0, -0.3, 6.0]],
        [[0.01, 0.02, 0.005]],
        SMALL,
        opacities=0.9,
    )


def behind_and_before_the_near_plane():
    return scene([[0.0, 0.0, -2.0], [0.02, 0.0, 0.05], [0.0, 0.0, 2.0]], [[0.2, 0.1, 0.3]], SMALL)


def colours_clamped_at_zero():
    sh = np.zeros((3, 4, 3))
    sh[:, 0] = [
        dc_from_rgb([-0.4, 0.5, 0.2]),
        dc_from_rgb([0.3, -0.2, -0.6]),
        dc_from_rgb([-0.5, -0.5, -0.5]),
    ]
    sh[:, 1:] = np.random.default_rng(0).normal(size=(3, 3, 3)) * 0.1
    return scene(
        [[0.0, 0.1, 2.0], [0.2, 0.0, 2.5], [-0.3, 0.0, 3.0]], [[0.4, 0.3, 0.2]], SMALL, sh=sh
    )


def principal_point_beyond_the_corner():
    K = np.array([[22.0, 0, -5.0], [0, 19.0, 25.0], [0, 0, 1]])
    return scene(
        [[1.2, -1.0, 2.0], [2.5, -2.5, 3.5], [0.1, -0.5, 1.5]],
        [[0.4, 0.3, 0.2]],
        PinholeCamera(24, 18, K, np.eye(4)),
    )


def quaternions_of_any_length():
    quaternions = np.random.default_rng(1).normal(size=(3, 4)) * [[1e-2], [1.0], [30.0]]
    return scene(
        [[0.0, 0.1, 2.0], [0.2, 0.0, 2.5], [-0.3, 0.0, 3.0]],
        [[0.4, 0.1, 0.05]],
        SMALL,
        quaternions=quaternions,
    )


def turned_camera_and_harmonics_of_degree_three():
    T = random_rigid(3, 2.0)
    means = np.array([[0.4, -0.2, 2.5], [-0.5, 0.0, 1.2]]) - T[:3, 3]
    sh = np.random.default_rng(2).normal(size=(2, 16, 3)) * 0.2
    return scene(means @ T[:3, :3], [[0.4, 0.3, 0.1]], camera(24, 18, 20.0, T), sh=sh)


HARD = (
    overlapping,
    needles_before_the_camera,
    centres_outside_with_clamped_slopes,
    opaque_stack,
    smaller_than_the_low_pass,
    behind_and_before_the_near_plane,
    colours_clamped_at_zero,
    principal_point_beyond_the_corner,
    quaternions_of_any_length,
    turned_camera_and_harmonics_of_degree_three,
)


@pytest.mark.parametrize("make", HARD)
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


@pytest.mark.parametrize("threads", [2, 5])
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
