from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.cameras.shutter import rolling as shares
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.gaussians import (
    GaussianCloud,
    PinholeCamera,
    prepare,
    rasterize,
    rasterize_prepared,
)
from alpasim_plugin.gaussians.camera import Rolling
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster import rasterize_lens
from alpasim_plugin.gaussians.raster.lens_rays import (
    tile_rays,
)
from alpasim_plugin.gaussians.raster.lens_records import INVERSE_O2
from tests.gaussians.lens_reference import LensReference, least_distance_along
from tests.gaussians.lens_scenes import (
    FINE,
    HARD,
    HEIGHT,
    LENSES,
    WIDTH,
    WORLD,
    around,
    camera,
    cloud_of,
    fine_camera,
    largest_small,
    pose,
    spec,
)


def check(nodes, seen, starts=(), count=150, seed=0):
    """Compare pixels with the reference: at most 3/255 apart, nearly all within 1/255.

    Where a splat's opacity is at the cut of 1/255, it is drawn or not, which the opacity shows whole.
    """
    out = rasterize_prepared(
        [(prepare(cloud), T) for cloud, T in nodes], seen, threads=1, starts=starts
    )
    reference = LensReference(nodes, seen, starts)
    rng = np.random.default_rng(seed)
    places = np.argwhere(seen.visible)
    colours_apart = []
    opacities_apart = []
    for row, column in rng.choice(places, min(count, len(places)), replace=False):
        colour, alpha, depth = reference.pixel(row, column)
        colours_apart.append(np.abs(np.clip(colour, 0, 1) - out.rgb[row, column]).max())
        opacities_apart.append(abs(alpha - out.alpha[row, column]))
        if alpha < 0.1:
            continue  # one splat at the cut is drawn or not, and with it all that the depth is of
        assert out.depth[row, column] == pytest.approx(depth, rel=0.02, abs=0.01)
    for apart, most in ((colours_apart, 1.0), (opacities_apart, 1.2)):
        levels = 255 * np.array(apart)
        assert levels.max() <= 3.0
        assert np.mean(levels <= most) >= 0.999
    return out


@pytest.mark.parametrize("rolls", [False, True], ids=["global", "rolling"])
@pytest.mark.parametrize("name", LENSES)
def test_pixels_are_those_of_the_definition(name, rolls):
    rng = np.random.default_rng(1)
    scales = np.exp(rng.uniform(-4, 0, (150, 3)))
    world = cloud_of(around(150, 2), scales, rng.uniform(0.05, 1, 150))
    scales = np.exp(rng.uniform(-4, 0, (60, 3)))
    user = cloud_of(around(60, 3, 0.2, 2), scales, 0.7, 4, 0.1, np.eye(4))
    T = WORLD @ pose([0, 0.3, 0], [0.5, 0.2, 5])
    starts = [None, WORLD @ pose([0.004, 0.31, 0], [0.3, 0.2, 5.2])] if rolls else ()
    out = check([(world, None), (user, T)], camera(name, rolls), starts)
    assert out.alpha[camera(name).visible].mean() > 0.1


@pytest.mark.parametrize("rolls", [False, True], ids=["global", "rolling"])
@pytest.mark.parametrize("name", ["opencv", "fisheye", "turning"])
@pytest.mark.parametrize("case", HARD)
def test_hard_cases_are_those_of_the_definition(case, name, rolls):
    places, scales = HARD[case]
    check([(cloud_of(places, scales, 0.6, 10), None)], camera(name, rolls), count=80)


@pytest.mark.parametrize("rolls", [False, True], ids=["global", "rolling"])
@pytest.mark.parametrize("name", FINE)
def test_ellipses_of_the_image_are_those_of_the_definition(name, rolls):
    seen = fine_camera(name, rolls)
    world = largest_small(seen, 1200, 20)
    user = largest_small(seen, 300, 21)
    T = pose([0.2, 0.1, 0.3], [0.3, 0.2, 0.1])
    moved = user.transformed(inverse(T))
    starts = [None, pose([0.2, 0.104, 0.3], [0.1, 0.2, 0.2])] if rolls else ()
    out = check([(world, None), (moved, T)], seen, starts, count=250)
    assert out.alpha.mean() > 0.05


@pytest.mark.parametrize("antialias_px2", [0.0, 0.1])
@pytest.mark.parametrize("rolls", [False, True], ids=["global", "rolling"])
@pytest.mark.parametrize("name", FINE)
def test_small_gaussians_are_drawn_as_ellipses_also_antialiased(name, rolls, antialias_px2):
    seen = fine_camera(name, rolls)
    small = largest_small(seen, 300, 22)
    shares = []
    for size in (0.5, 40.0):
        world = replace(small, scales=size * small.scales)
        prepared = replace(prepare(world), antialias_px2=antialias_px2)
        splats = rasterize_lens.drawn_splats([(prepared, None)], seen, near_m=0.2, threads=1).splats
        records = splats.records[: len(splats.ids) * splats.size].reshape(-1, splats.size)
        assert len(records) > 100
        shares.append(float(np.mean(records[:, INVERSE_O2] < 0)))
    assert shares[0] > 0.9
    assert shares[1] < 0.1


def test_thin_poles_at_speed_stand_where_the_definition_puts_them():
    poles = GaussianCloud(
        [[x, 0.0, 4.0 + k] for k, x in enumerate((-3, -1.5, 0, 1.5, 3))],
        [[1.0, 0, 0, 0]] * 5,
        [[0.03, 2.0, 0.03]] * 5,
        [0.95] * 5,
        np.ones((5, 1, 3)),
    )
    nodes = [(poles, None)]
    rolled = check(nodes, camera("fisheye", True, np.eye(4)))
    still = check(nodes, camera("fisheye", False, np.eye(4)))
    assert np.abs(rolled.rgb - still.rgb).max() > 0.1


def test_the_response_is_the_greatest_along_a_ray():
    seen = camera("fisheye", True)
    world = cloud_of(around(20, 11, 0.3, 4), (0.8, 0.3, 0.1), 0.9, 12)
    reference = LensReference([(world, None)], seen)
    for row, column in ((10, 20), (30, 40), (50, 70)):
        o, d = reference.ray(row, column, 0)
        q2 = [
            least_distance_along(S, p, o, d, 30.0)
            for S, p in zip(reference.splats.S, reference.splats.p, strict=True)
        ]
        expected = np.minimum(0.99, reference.splats.opacity * np.exp(-0.5 * np.array(q2)))
        np.testing.assert_allclose(reference.alphas(row, column), expected, atol=1e-6)


def test_small_gaussians_in_a_pinhole_are_those_of_the_affine_map():
    rng = np.random.default_rng(13)
    places = np.column_stack([rng.uniform(-2, 2, (200, 2)), rng.uniform(8, 12, 200)])
    world = cloud_of(places, (0.02, 0.01, 0.015), 0.5)
    plain = spec("pinhole")
    flat = rasterize(world, PinholeCamera(WIDTH, HEIGHT, plain.K, inverse(WORLD)))
    along_rays = rasterize(world, LensCamera(plain, inverse(WORLD)))
    assert np.abs(flat.rgb - along_rays.rgb).max() < 3 / 255
    assert flat.alpha.max() > 0.2


@pytest.mark.parametrize("rolls", [False, True], ids=["global", "rolling"])
def test_wide_gaussians_are_listed_in_all_tiles_that_they_touch(rolls, monkeypatch):
    """Many tiles, and large Gaussians near the camera: the image is that of whole boxes."""
    seen = fine_camera("fisheye", rolls)
    world = cloud_of(around(60, 30, 0.5, 6), (1.5, 0.4, 0.05), 0.6, 31)
    images = []
    for wide_tiles in (0, 10**9):
        monkeypatch.setattr(rasterize_lens, "WIDE_TILES", wide_tiles)
        images.append(rasterize_prepared([(prepare(world), None)], seen, threads=2).rgb)
    np.testing.assert_array_equal(images[0], images[1])
    assert images[0].max() > 0.1


def test_the_image_does_not_depend_on_the_threads():
    rng = np.random.default_rng(14)
    world = cloud_of(around(9000, 15), np.exp(rng.uniform(-4, -2, (9000, 3))))
    nodes = [(prepare(world), None)]
    first, second = (
        rasterize_prepared(nodes, camera("fisheye", True), threads=threads) for threads in (1, 2)
    )
    np.testing.assert_array_equal(first.rgb, second.rgb)
    np.testing.assert_array_equal(first.depth, second.depth)


def test_where_a_lens_sees_nothing_it_is_black_and_opaque():
    world = cloud_of(around(50, 16), (0.5, 0.5, 0.5))
    seen = camera("turning")
    out = rasterize(world, seen, (1.0, 1.0, 1.0))
    assert not seen.visible.all()
    assert not out.rgb[~seen.visible].any()
    assert (out.alpha[~seen.visible] == 1).all()
    assert not out.depth[~seen.visible].any()
    assert (out.rgb[seen.visible] > 0).any()


def test_columns_exposed_backwards_are_those_of_the_definition():
    share = shares(WIDTH, HEIGHT, "columns", backwards=True)
    step = float(share[0, 1] - share[0, 0])
    plain = camera("ftheta", True)
    rolling = Rolling(
        plain.rolling.T_camera_world_start,
        {},
        (step, 0.0, float(share[0, 0]) - 0.5 - 0.5 * step),
        10.0,
    )
    seen = LensCamera(plain.spec, plain.T_camera_world, rolling)
    check([(cloud_of(around(100, 17), (0.3, 0.1, 0.2)), None)], seen)


def test_cameras_keep_the_rays_of_their_lenses():
    """A fit whose photographs have a lens each would make them again in each update."""
    plain = spec("fisheye")
    turns = [np.diag([1 + 1e-3 * k, 1.0, 1.0]) for k in range(10)]
    cameras = [LensCamera(replace(plain, K=turn @ plain.K), np.eye(4)) for turn in turns]
    tables = [tile_rays(seen) for seen in cameras]
    assert all(tile_rays(seen) is table for seen, table in zip(cameras, tables, strict=True))


def test_other_backends_refuse_a_lens():
    world = cloud_of([[0, 0, 5]], (0.1, 0.1, 0.1))
    with pytest.raises(InputError, match="use the backend cpu"):
        rasterize(world, camera("fisheye"), backend="reference")
