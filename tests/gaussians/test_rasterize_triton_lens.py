"""Draw lenses with the kernels of cards, interpreted on the CPU, and compare them with the definition."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import LensModel
from alpasim_plugin.gaussians import PinholeCamera, prepare, rasterize, rasterize_prepared
from alpasim_plugin.gaussians.camera import Rolling
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster import lens_rays, rasterize_lens
from tests.gaussians.gaussian_scenes import LSB, assert_same_image
from tests.gaussians.lens_reference import LensReference
from tests.gaussians.lens_scenes import (
    BACK,
    FINE,
    HARD,
    LENSES,
    WORLD,
    around,
    camera,
    cloud_of,
    fine_camera,
    largest_small,
    pose,
    spec,
)

pytest.importorskip("triton", reason="Triton is not installed")

from alpasim_plugin.gaussians.raster.lens_on_device import lens_numbers
from alpasim_plugin.gaussians.raster.lens_records import INVERSE_O2
from alpasim_plugin.gaussians.raster.rasterize_triton import DrawnCloud, UploadedClouds

SIZE = (48, 32)  # the kernels are interpreted


def drawn(nodes, cameras, starts=()):
    """Return the images of cameras with one lens, drawn together."""
    clouds = UploadedClouds([cloud for cloud, _ in nodes], "cpu")
    starts = starts or [None] * len(nodes)
    placed = [
        DrawnCloud(number, T, False, start)
        for number, ((_, T), start) in enumerate(zip(nodes, starts, strict=True))
    ]
    outs = clouds.draw([(seen, placed) for seen in cameras], torch.zeros(3), 0.1)
    return [out.on_host() for out in outs]


def assert_within_levels(apart, most):
    levels = 255 * np.asarray(apart)
    assert levels.max() <= 3.0
    assert np.mean(levels <= most) >= 0.999


def check(nodes, seen, starts=(), depth_share=0.02):
    """Compare every third pixel with the definition: at most 3/255 apart, nearly all within 1/255.

    Where a splat's opacity is at the cut of 1/255, it is drawn or not, which the opacity shows whole.
    ``depth_share`` is by how much depths may be apart: an ellipse of the image has one depth, that of
    its middle.
    """
    (out,) = drawn(nodes, [seen], starts)
    reference = LensReference(nodes, seen, starts)
    pixels = np.argwhere(seen.visible)[::3]
    colours, alphas, depths = zip(*(reference.pixel(*pixel) for pixel in pixels), strict=True)
    rows, columns = pixels.T
    apart = np.abs(np.clip(colours, 0, 1) - out.rgb[rows, columns]).max(axis=1)
    assert_within_levels(apart, 1.0)
    assert_within_levels(np.abs(alphas - out.alpha[rows, columns]), 1.2)
    shown = np.array(alphas) >= 0.1
    np.testing.assert_allclose(
        out.depth[rows, columns][shown], np.array(depths)[shown], rtol=depth_share, atol=0.01
    )
    return out


def street(rolls):
    """Return Gaussians of the world and of a road user that turns, and where they were."""
    rng = np.random.default_rng(1)
    scales = np.exp(rng.uniform(-4, 0, (60, 3)))
    world = cloud_of(around(60, 2), scales, rng.uniform(0.05, 1, 60))
    scales = np.exp(rng.uniform(-4, 0, (30, 3)))
    user = cloud_of(around(30, 3, 0.2, 2), scales, 0.7, 4, 0.1, np.eye(4))
    T = WORLD @ pose([0, 0.3, 0], [0.5, 0.2, 5])
    starts = [None, WORLD @ pose([0.004, 0.31, 0], [0.3, 0.2, 5.2])] if rolls else ()
    return [(world, None), (user, T)], starts


FINE_CASES = [(name, rolls) for name in FINE for rolls in (False, True)]
UNEVEN = ("ftheta", True)


def slow_but(quick, cases):
    """Return the parameters of a test: of cases that take the same branches one is tried always."""
    return [
        pytest.param(*case, marks=[] if case in quick else [pytest.mark.slow]) for case in cases
    ]


@pytest.mark.parametrize(
    ("name", "rolls"),
    slow_but(
        {("fisheye", False)},
        [(name, rolls) for name in LENSES for rolls in (False, True)],
    ),
)
def test_pixels_are_those_of_the_definition(name, rolls):
    nodes, starts = street(rolls)
    out = check(nodes, camera(name, rolls, size=SIZE), starts)
    assert out.alpha.mean() > 0.05


@pytest.mark.parametrize(
    ("case", "name", "rolls"),
    slow_but(
        {
            ("enclosing", "fisheye", True),
            ("near", "fisheye", True),
            ("at 90 degrees and beyond", "fisheye", False),
            ("flat ones in the plane of a ray", "opencv", False),
        },
        [
            (case, name, rolls)
            for case in HARD
            for name in ("opencv", "fisheye", "turning")
            for rolls in (False, True)
        ],
    ),
)
def test_hard_cases_are_those_of_the_definition(case, name, rolls):
    places, scales = HARD[case]
    check([(cloud_of(places, scales, 0.6, 10), None)], camera(name, rolls, size=SIZE))


@pytest.mark.parametrize(
    ("name", "rolls"),
    [
        *slow_but({("fisheye", True)}, [case for case in FINE_CASES if case != UNEVEN]),
        pytest.param(
            *UNEVEN,
            marks=[
                pytest.mark.slow,
                pytest.mark.xfail(
                    strict=True,
                    reason="a splat at the first row of an image that moves several pixels a row is "
                    "not drawn, neither on a card nor on the CPU",
                ),
            ],
        ),
    ],
)
def test_ellipses_of_the_image_are_those_of_the_definition(name, rolls):
    seen = fine_camera(name, rolls, SIZE)
    user = largest_small(seen, 40, 21)
    T = pose([0.2, 0.1, 0.3], [0.3, 0.2, 0.1])
    starts = [None, pose([0.2, 0.104, 0.3], [0.1, 0.2, 0.2])] if rolls else ()
    nodes = [(largest_small(seen, 80, 20), None), (user.transformed(inverse(T)), T)]
    out = check(nodes, seen, starts, depth_share=0.03)
    assert out.alpha.mean() > 0.05


@pytest.mark.parametrize("antialias_px2", [0.0, 0.1])
def test_what_is_small_on_the_cpu_is_drawn_as_an_ellipse(antialias_px2):
    seen = fine_camera("fisheye", True, SIZE)
    small = largest_small(seen, 60, 22)
    sizes = np.where(np.arange(60) % 2, 0.5, 40.0)[:, None]
    cloud = replace(small, scales=sizes * small.scales, antialias_px2=antialias_px2)
    clouds = UploadedClouds([cloud], "cpu")
    views = [(seen, [DrawnCloud(0)])]
    splats, _ = clouds._projected_through_lens(views, clouds._spans(views), 0.2)
    records = splats.records[splats.counts > 0].numpy()
    on_host = rasterize_lens.drawn_splats([(prepare(cloud), None)], seen, near_m=0.2, threads=1)
    records_on_host = on_host.splats.records[: len(on_host.splats.ids) * on_host.splats.size]
    ellipses_on_host = records_on_host.reshape(-1, on_host.splats.size)[:, INVERSE_O2] < 0
    # Tiles begin half a pixel sooner on a card: a splat may be listed that the CPU leaves out.
    assert 0 <= (records[:, INVERSE_O2] < 0).sum() - ellipses_on_host.sum() <= 2
    assert ellipses_on_host.sum() > 10
    assert (records[:, INVERSE_O2] > 0).sum() >= (~ellipses_on_host).sum() > 10


@pytest.mark.slow
def test_two_views_through_one_lens_are_those_of_the_cpu():
    rng = np.random.default_rng(4)
    user = cloud_of(around(20, 3, 0.2, 2), np.exp(rng.uniform(-4, 0, (20, 3))), 0.7, 4)
    nodes = [(user, WORLD @ pose([0, 0.3, 0], [0.5, 0.2, 4]))]
    starts = [WORLD @ pose([0.004, 0.31, 0], [0.3, 0.2, 4.2])]
    cameras = [
        camera("ftheta", True, WORLD @ pose([0, turn, 0], [0, 0, 0]), SIZE) for turn in (0.0, 0.4)
    ]
    placed = [(prepare(cloud), T) for cloud, T in nodes]
    for out, seen in zip(drawn(nodes, cameras, starts), cameras, strict=True):
        assert_same_image(
            out, rasterize_prepared(placed, seen, threads=1, starts=starts), LSB, 1e-3
        )


def test_the_numbers_of_many_lenses_are_made_once_and_without_tables_of_the_cpu():
    cameras = []
    for i in range(12):
        wide = replace(spec("fisheye"), lens=LensModel("fisheye", (0.02 + 1e-3 * i,)))
        cameras.append(LensCamera(wide, inverse(WORLD)))
    tables = lens_rays._tile_rays.cache_info().misses
    views = [(seen, []) for seen in cameras]
    first = lens_numbers(views, 0.1).lenses
    made = lens_rays._lens_numbers.cache_info().misses
    np.testing.assert_array_equal(lens_numbers(views, 0.1).lenses, first)
    assert len(np.unique(first, axis=0)) == len(cameras)
    assert lens_rays._lens_numbers.cache_info().misses == made
    assert lens_rays._tile_rays.cache_info().misses == tables


def test_pinholes_of_a_rolling_shutter_are_those_of_the_cpu():
    nodes, _ = street(False)
    starts = [None, WORLD @ pose([0.02, 0.35, 0], [0.1, 0.2, 5.6])]
    plain = spec("pinhole")
    step = 1 / (SIZE[1] - 1)
    rolling = Rolling(inverse(WORLD @ BACK), {}, (0.0, step, -0.5 - 0.5 * step), 10.0)
    K = plain.K.copy()
    K[:2, 2] = SIZE[0] / 2, SIZE[1] / 2
    seen = PinholeCamera(*SIZE, K, inverse(WORLD), rolling=rolling)
    still = PinholeCamera(*SIZE, K, inverse(WORLD))
    placed = [(prepare(cloud), T) for cloud, T in nodes]
    on_host = rasterize_prepared(placed, seen, threads=1, starts=starts)
    (out,) = drawn(nodes, [seen], starts)
    assert_same_image(out, on_host, LSB)
    assert np.abs(out.rgb - rasterize_prepared(placed, still, threads=1).rgb).max() > 0.05


def test_where_a_lens_sees_nothing_it_is_black_and_opaque():
    seen = camera("turning", size=SIZE)
    clouds = UploadedClouds([cloud_of(around(30, 16), (0.5, 0.5, 0.5))], "cpu")
    out = clouds.draw([(seen, [DrawnCloud(0)])], torch.ones(3), 0.1)[0].on_host()
    assert not seen.visible.all()
    assert not out.rgb[~seen.visible].any()
    assert (out.alpha[~seen.visible] == 1).all()
    assert not out.depth[~seen.visible].any()
    assert (out.rgb[seen.visible] > 0).any()


@pytest.mark.gpu
def test_a_card_draws_what_the_cpu_does_through_lenses():
    rng = np.random.default_rng(3)
    cloud = cloud_of(around(4000, 18), np.exp(rng.uniform(-5, -1, (4000, 3))))
    for name in LENSES:
        for rolls in (False, True):
            seen = camera(name, rolls, size=(960, 720))
            assert_same_image(
                rasterize(cloud, seen, backend="triton"), rasterize(cloud, seen), 2 * LSB, 1e-3
            )
