"""Meet the cases in which splatting breaks: near plane, far off-axis, needles, saturation, huge and
countless splats, bad numbers.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians import GaussianCloud, rasterize
from alpasim_plugin.gaussians.constants import ALPHA_MAX, EPS2D_PX2, MIP_PX2
from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from tests.gaussians.gaussian_scenes import (
    HARD,
    LSB,
    assert_same_image,
    camera,
    random_cloud,
    random_rigid,
    splats,
)

FAST = ("cpu", "torch")


def wall(z, n=12, opacity=0.9, rgb=(0.8, 0.3, 0.1), spread=1.0):
    x, y = np.meshgrid(np.linspace(-spread, spread, n), np.linspace(-spread, spread, n))
    return splats(
        np.column_stack([x.ravel(), y.ravel(), np.full(n * n, z)]),
        [spread / n, spread / n, 0.01],
        opacity,
        rgb,
    )


@cache
def reference_of_wall(z, near_m, behind):
    return rasterize_reference(wall(z, spread=0.3), camera(), behind, near_m=near_m)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("near_m", [0.1, 0.2])
def test_wall_moving_through_the_near_plane_never_flashes(backend, near_m):
    behind = (0.1, 0.1, 0.2)
    for z in (
        *np.arange(0.05, near_m - 0.03, 0.05),
        *np.arange(near_m - 0.025, near_m + 0.05, 0.0125),
        *np.arange(near_m + 0.05, 0.4, 0.05),
    ):
        out = rasterize(wall(z, spread=0.3), camera(), behind, backend, near_m=near_m)
        assert_same_image(out, reference_of_wall(z, near_m, behind), 5e-5, odd_share=1e-3)
        # Between the wall's colour and the background, never brighter or darker than both.
        assert np.all(out.rgb <= np.maximum((0.8, 0.3, 0.1), behind) + 1e-5)
        assert np.all(out.rgb >= np.minimum((0.8, 0.3, 0.1), behind) - 1e-5)
        if z < near_m:
            assert not out.alpha.any()
        else:
            assert out.alpha.min() > 0.5


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("angle_deg", [60, 70, 80, 85, 89, 89.99])
def test_splat_far_off_axis_leaves_no_streak(backend, angle_deg):
    angle = np.deg2rad(angle_deg)
    cloud = splats([10 * np.sin(angle), 0, 10 * np.cos(angle)], 0.3, 0.95)
    cam = camera()  # half view 31 degrees
    out = rasterize(cloud, cam, backend=backend, near_m=1e-4)
    assert_same_image(out, rasterize_reference(cloud, cam, near_m=1e-4, brute=True))
    assert out.alpha.max() == 0


@pytest.mark.parametrize("backend", FAST)
def test_centre_behind_the_camera_is_not_drawn_even_where_the_body_reaches_in_front(backend):
    out = rasterize(splats([0, 0, -0.5], 3.0, 0.9), camera(), backend=backend)
    assert not out.alpha.any()


@pytest.mark.parametrize("backend", FAST)
def test_ten_splats_of_a_kilometre_are_exact(backend):
    rng = np.random.default_rng(0)
    cloud = splats(
        rng.uniform(-500, 500, (10, 3)) + np.array([0, 0, 600]),
        1000.0,
        0.3,
        rng.uniform(0, 1, (10, 3)),
    )
    assert_same_image(
        rasterize(cloud, camera(), backend=backend),
        rasterize_reference(cloud, camera(), brute=True),
        5e-5,
    )


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("length_px", [10, 1_000, 10_000, 100_000])
def test_needles_at_every_angle_match_float64(backend, length_px):
    cam = camera()
    for angle in np.linspace(0.05, 3.1, 13):
        s = length_px * 2.0 / 80.0
        quat = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
        cloud = splats([0.1, -0.05, 2.0], [[s, 0.02, 0.003]], 0.9, quats=quat)
        want = rasterize_reference(cloud, cam, brute=True)
        assert want.alpha.max() > 0.8
        assert_same_image(
            rasterize(cloud, cam, backend=backend),
            want,
            1e-3 if length_px > 10_000 else 1e-4,
            odd_share=2e-3,
        )


@pytest.mark.parametrize("backend", FAST)
def test_needle_whose_centre_is_far_outside_still_crosses_the_image_exactly(backend):
    cloud = splats(
        [30.0, 0.0, 2.0], [[40.0, 0.01, 0.01]], 0.9, quats=[np.cos(0.005), 0, 0, np.sin(0.005)]
    )
    want = rasterize_reference(cloud, camera(), brute=True)
    assert want.alpha.max() > 0.5
    assert_same_image(rasterize(cloud, camera(), backend=backend), want, 0.5 * LSB, odd_share=1e-3)


@pytest.mark.parametrize("backend", FAST)
def test_zero_scale_draws_a_dot(backend):
    cloud = splats([0, 0, 3.0], 0.0, 0.9)
    out = rasterize(cloud, camera(), backend=backend)
    assert_same_image(out, rasterize_reference(cloud, camera(), brute=True))
    assert 4 <= np.count_nonzero(out.alpha) <= 16
    assert out.alpha.max() > 0.3


@pytest.mark.parametrize("backend", ["reference", *FAST])
@pytest.mark.parametrize("bad", ["mean", "opacity", "colour", "scale", "quaternion"])
def test_numbers_that_cannot_be_drawn_are_an_error_that_names_the_cure(backend, bad):
    cloud = random_cloud(5)
    field = {
        "mean": "means",
        "opacity": "opacities",
        "colour": "sh",
        "scale": "scales",
        "quaternion": "quats",
    }[bad]
    value = getattr(cloud, field).copy()
    value[3] = 0.0 if bad == "quaternion" else np.inf if bad == "scale" else np.nan
    broken = GaussianCloud(
        **{
            **{f: getattr(cloud, f) for f in ("means", "quats", "scales", "opacities", "sh")},
            field: value,
        }
    )
    with pytest.raises(InputError):
        rasterize(broken, camera(), backend=backend)


@pytest.mark.parametrize("backend", FAST)
def test_largest_scale_that_loading_admits_gives_no_nan(backend):
    cloud, report = GaussianCloud.cleaned(
        [[0, 0, 5.0], [0, 0, 6.0], [0, 0, 7.0]],
        [[1, 0, 0, 0]] * 3,
        [[np.exp(90), 1, 1], [np.exp(19.9), 1e-30, 1.0], [1, 1, 1]],
        [0.5, 0.5, 0.5],
        np.zeros((3, 1, 3)),
    )
    assert report.dropped["overflowing scale"] == 1
    out = rasterize(cloud, camera(), backend=backend)
    assert_same_image(out, rasterize_reference(cloud, camera(), brute=True), 1e-4, odd_share=0.02)


@pytest.mark.parametrize("backend", ["reference", *FAST])
def test_stack_of_opaque_walls_ends_at_099_because_the_second_layer_is_left_out(backend):
    cloud = GaussianCloud.concatenate(
        [splats([0, 0, z], 50.0, 1.0, (1.0, 0.5, 0.0)) for z in np.linspace(4, 9, 10)]
    )
    out = rasterize(cloud, camera(), (0.0, 0.0, 1.0), backend)
    assert out.alpha.max() == pytest.approx(ALPHA_MAX, abs=1e-6)
    assert out.alpha.min() == pytest.approx(ALPHA_MAX, abs=1e-6)
    assert out.depth == pytest.approx(np.full(out.depth.shape, 4.0), abs=1e-4)
    assert out.rgb[0, 0] == pytest.approx([0.99, 0.495, 0.01], abs=1e-5)


@pytest.mark.parametrize("backend", FAST)
def test_opacity_below_the_cut_draws_nothing_and_is_not_carried_along(backend):
    cloud = random_cloud(200, 5)
    faint = GaussianCloud(cloud.means, cloud.quats, cloud.scales, np.full(200, 0.0039), cloud.sh)
    assert_same_image(
        rasterize(GaussianCloud.concatenate([cloud, faint]), camera(), backend=backend),
        rasterize_reference(cloud, camera()),
    )
    assert not rasterize(faint, camera()).alpha.any()


@pytest.mark.parametrize("backend", ["reference", *FAST])
def test_equal_depths_keep_input_order(backend):
    rng = np.random.default_rng(1)
    for n in (6, 200):
        xy = rng.uniform(-1, 1, (n, 2))
        cloud = splats(np.column_stack([xy, np.full(n, 3.0)]), 0.2, 0.7, rng.uniform(0, 1, (n, 3)))
        out = rasterize(cloud, camera(), backend=backend)
        # Nudging the depths apart in input order must not change who is in front.
        apart = GaussianCloud(
            cloud.means + np.arange(n)[:, None] * [0, 0, 1e-5],
            cloud.quats,
            cloud.scales,
            cloud.opacities,
            cloud.sh,
        )
        assert np.abs(out.rgb - rasterize(apart, camera(), backend="reference").rgb).max() < 0.01
        backwards = rasterize(cloud.take(np.arange(n)[::-1]), camera(), backend=backend)
        assert np.abs(out.rgb - backwards.rgb).max() > 0.05


@pytest.mark.parametrize("backend", FAST)
def test_utm_coordinates_give_the_local_image(backend):
    cloud = random_cloud(400, 10)
    T = random_rigid(10)
    offset = np.array([4.5e5, 5.4e6, 120.0])
    local = rasterize_reference(
        cloud.transformed(T), camera(T_camera_world=np.linalg.inv(T)), brute=True
    )
    there = T.copy()
    there[:3, 3] += offset
    moved = cloud.transformed(T)
    moved = GaussianCloud(
        moved.means + offset, moved.quats, moved.scales, moved.opacities, moved.sh
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = there[:3, :3].T, -there[:3, :3].T @ there[:3, 3]
    out = rasterize(moved, camera(T_camera_world=pose), backend=backend)
    assert np.abs(out.rgb - local.rgb).max() < LSB
    assert_same_image(out, local, 1e-4, odd_share=1e-3)


@pytest.mark.parametrize("backend", ["reference", *FAST])
@pytest.mark.parametrize(
    "cloud",
    [GaussianCloud.empty(), splats([0, 0, -5.0]), splats([500.0, 0, 5.0])],
    ids=["none", "behind", "aside"],
)
def test_empty_view_is_the_background(backend, cloud):
    out = rasterize(cloud, camera(), (0.25, 0.5, 0.75), backend)
    assert np.all(out.rgb == np.float32([0.25, 0.5, 0.75]))
    assert not out.alpha.any()
    assert not out.depth.any()


@pytest.mark.parametrize("backend", FAST)
def test_colours_above_one_are_clamped_after_compositing(backend):
    bright = splats([[0, 0, 3.0], [0, 0, 4.0]], 5.0, 0.5, [(3.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    out = rasterize(bright, camera(), backend=backend)
    assert_same_image(out, rasterize_reference(bright, camera(), brute=True))
    assert out.rgb.max() == 1.0
    assert out.rgb[32, 48, 1] > 0.2


@pytest.mark.parametrize("antialias_px2", [MIP_PX2, EPS2D_PX2])
@pytest.mark.parametrize("name", HARD)
def test_a_model_of_antialiasing_matches_float64(name, antialias_px2):
    cloud = replace(HARD[name], antialias_px2=antialias_px2)
    behind = (0.2, 0.3, 0.4)
    wanted = rasterize_reference(cloud, camera(), behind, brute=True)
    assert_same_image(rasterize(cloud, camera(), behind), wanted, LSB)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_antialiasing_keeps_what_a_small_splat_covers_in_all(backend):
    # The integral of alpha over the image is that without any filter, 2 pi sigma^2 opacity, in
    # place of 2 pi (sigma^2 + 0.3) opacity.
    sigma_px = 0.5
    cloud = splats([0, 0, 10.0], sigma_px * 10 / camera().fx, 0.9)
    plain, kept = (
        rasterize(replace(cloud, antialias_px2=px2), camera(), backend=backend).alpha.sum()
        for px2 in (0.0, EPS2D_PX2)
    )
    assert plain == pytest.approx(2 * np.pi * (sigma_px**2 + EPS2D_PX2) * 0.9, rel=0.03)
    assert kept == pytest.approx(2 * np.pi * sigma_px**2 * 0.9, rel=0.03)


def test_antialiasing_is_refused_by_what_does_not_draw_it():
    cloud = replace(wall(3.0), antialias_px2=MIP_PX2)
    for wrong in (
        lambda: rasterize(cloud, camera(), backend="torch"),
        lambda: GaussianCloud.concatenate([cloud, wall(2.0)]),
    ):
        with pytest.raises(InputError, match="antialiasing"):
            wrong()
