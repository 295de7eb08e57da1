"""Hold every CPU-capable backend against closed forms, symmetries and the brute-force
definition.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera, rasterize
from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from tests.examples import examples
from tests.gaussians.gaussian_scenes import (
    assert_same_image,
    camera,
    random_cloud,
    random_rigid,
    splats,
)

BACKENDS = ("reference", "cpu", "torch")


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_isotropic_splat_on_axis_is_its_analytic_bell(backend):
    cam = camera()
    z = 4.0
    s = 0.35
    o = 0.7
    f = 80.0
    out = rasterize(splats([0, 0, z], s, o, (0.9, 0.5, 0.2)), cam, backend=backend)
    x, y = np.meshgrid(np.arange(96) + 0.5 - cam.cx, np.arange(64) + 0.5 - cam.cy)
    alpha = o * np.exp(-(x * x + y * y) / (2 * (f * f * s * s / (z * z) + 0.3)))
    alpha[alpha < 1 / 255] = 0
    assert np.abs(out.alpha - alpha).max() < 3e-6
    assert np.abs(out.rgb - alpha[..., None] * [0.9, 0.5, 0.2]).max() < 3e-6
    assert np.abs(out.depth - z * (alpha > 0)).max() < 1e-4


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("swap", [False, True])
def test_two_overlapping_splats_mix_front_to_back(backend, swap):
    z = np.array([3.0, 5.0])[:: -1 if swap else 1]
    rgb = np.array([[1.0, 0.2, 0.0], [0.0, 0.3, 1.0]])
    a = np.array([0.6, 0.75])
    cloud = splats(np.column_stack([np.zeros(2), np.zeros(2), z]), 5.0, a, rgb)
    # Splats this wide are flat at their centre.
    cam = PinholeCamera(3, 3, np.array([[80.0, 0, 1.5], [0, 80, 1.5], [0, 0, 1]]), np.eye(4))
    out = rasterize(cloud, cam, (0.5, 0.5, 0.5), backend=backend)
    front, back = np.argsort(z)
    want = a[front] * rgb[front] + (1 - a[front]) * (a[back] * rgb[back] + (1 - a[back]) * 0.5)
    assert out.rgb[1, 1] == pytest.approx(want, abs=2e-6)
    weight = np.array([a[front], (1 - a[front]) * a[back]])
    assert out.alpha[1, 1] == pytest.approx(weight.sum(), abs=2e-6)
    assert out.depth[1, 1] == pytest.approx(weight @ z[[front, back]] / weight.sum(), abs=1e-5)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@settings(max_examples=examples(12), deadline=None)
@given(
    seed=st.integers(0, 10_000), degree=st.integers(0, 3), near_m=st.sampled_from([0.1, 1.0, 3.0])
)
def test_random_scenes_equal_brute_force(backend, seed, degree, near_m):
    cloud = random_cloud(200, seed, degree)
    T = random_rigid(seed)
    cam = camera(T_camera_world=np.linalg.inv(T))
    cloud = cloud.transformed(T)
    want = rasterize_reference(cloud, cam, (0.2, 0.6, 0.9), near_m=near_m, brute=True)
    # A pixel may sit on the alpha cut or the stop: one in five thousand.
    assert_same_image(
        rasterize(cloud, cam, (0.2, 0.6, 0.9), backend, near_m=near_m), want, 2e-5, odd_share=2e-4
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_moving_scene_and_camera_together_changes_nothing(backend):
    cloud = random_cloud(300, 7)
    T = random_rigid(3, 40.0)
    here = rasterize(cloud, camera(), backend=backend)
    there = rasterize(
        cloud.transformed(T), camera(T_camera_world=np.linalg.inv(T)), backend=backend
    )
    assert_same_image(there, here, 5e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_background_image_shows_through(backend):
    image = np.linspace(0, 1, 64 * 96 * 3).reshape(64, 96, 3)
    out = rasterize(random_cloud(50, 2), camera(), image, backend=backend)
    want = rasterize_reference(random_cloud(50, 2), camera(), image, brute=True)
    assert_same_image(out, want)
    assert np.array_equal(
        rasterize(GaussianCloud.empty(), camera(), image, backend=backend).rgb,
        image.astype(np.float32),
    )


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("width", "height"), [(481, 271), (1, 1), (16, 16), (17, 15), (33, 5)])
def test_sizes_that_are_no_multiple_of_the_tile(backend, width, height):
    cloud = random_cloud(80, 4)
    cam = camera(width, height, f=0.8 * max(width, 8))
    out = rasterize(cloud, cam, (0.3, 0.3, 0.3), backend=backend)
    assert out.rgb.shape == (height, width, 3)
    assert_same_image(out, rasterize_reference(cloud, cam, (0.3, 0.3, 0.3)), 2e-5, odd_share=1e-4)


@pytest.mark.parametrize("background", [(0.1, 0.2), np.zeros((3, 3, 3)), (np.nan, 0, 0)])
def test_background_that_does_not_fit_is_an_error(background):
    with pytest.raises(InputError):
        rasterize(splats([0, 0, 1]), camera(), background)


def test_output_as_bytes_rounds_to_nearest():
    out = rasterize(GaussianCloud.empty(), camera(4, 4), (0.5, 1.0, 0.0))
    assert out.to_uint8()[0, 0].tolist() == [128, 255, 0]
