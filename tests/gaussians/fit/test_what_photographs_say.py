"""What photographs say before a fit, on a street whose truth is known: tracks, poses, depth, sky,
exposure.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import intrinsics
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit import dense, drive
from alpasim_plugin.gaussians.fit.dense import STRIDE, between_points, depth_maps, sky_masks
from alpasim_plugin.gaussians.fit.lens import balances, gain_near
from alpasim_plugin.gaussians.fit.photographs import resized
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import cloud_from_points, matches
from alpasim_plugin.gaussians.fit.tracks import Placed, Tracks, corrected, follow, place
from alpasim_plugin.gaussians.fit.views import PosedView, halved
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky
from tests.drives.street import STEP_M, K
from tests.gaussians.fit.street_views import STREET, brightened, street_views, true_depth, turned


@pytest.fixture(scope="module")
def views():
    return street_views()


@pytest.fixture(scope="module")
def tracks(views):
    return follow(views)


@pytest.fixture(scope="module")
def placed(views, tracks):
    return place(tracks, [view.camera for view in views])


def test_points_followed_through_the_street_lie_on_its_surfaces(tracks, placed):
    good = np.ones(tracks.count, dtype=bool)
    np.logical_and.at(good, tracks.point, placed.error_px < 0.5)
    good &= placed.angle_rad > 0.05
    xyz = placed.xyz[good]
    slack = 0.03 * np.linalg.norm(xyz, axis=1)  # a small angle leaves the distance uncertain
    on_wall = np.abs(np.abs(xyz[:, 1]) - 5.0) < slack
    on_road = np.abs(xyz[:, 2]) < slack
    on_box = (np.abs(xyz[:, 1] - 2.9) < 1.0 + slack) & (np.abs(xyz[:, 0] - 16.0) < 2.2 + slack)
    assert good.sum() > 200
    assert (on_wall | on_road | on_box).mean() > 0.95


def test_masked_pixels_start_no_track(views):
    mask = np.ones(views[0].rgb.shape[:2], dtype=bool)
    mask[64:] = False
    found = follow([replace(view, mask=mask) for view in views[:3]])
    assert found.count > 20
    assert found.pixel[found.view == 0][:, 1].max() < 65


def test_poses_that_are_off_come_back_to_the_truth(views):
    rng = np.random.default_rng(3)
    wrong = [turned(view, rng.normal(0, 0.003, 3), rng.normal(0, 0.02, 3)) for view in views]
    found = corrected(wrong)
    assert found.before_px > 3 * found.after_px
    assert found.after_px < 0.3

    def errors(cameras):
        """Return turns between neighbours against the truth, degrees: what all have in common does
        not count.
        """
        out = []
        for a, b, c, d in zip(cameras, cameras[1:], views, views[1:], strict=False):
            mine = b.T_camera_world @ np.linalg.inv(a.T_camera_world)
            true = d.camera.T_camera_world @ np.linalg.inv(c.camera.T_camera_world)
            out.append(
                np.degrees(
                    np.arccos(np.clip((np.trace(mine[:3, :3] @ true[:3, :3].T) - 1) / 2, -1, 1))
                )
            )
        return np.array(out)

    assert np.median(errors(list(found.cameras))) < 0.25 * np.median(
        errors([view.camera for view in wrong])
    )


def test_depth_by_flow_is_the_street_s(views, tracks, placed):
    maps = depth_maps(views, tracks, placed)
    middle = 4
    depth = maps[middle]
    truth = true_depth(views[middle])
    known = (depth > 0) & np.isfinite(truth)
    error = np.abs(depth[known] / truth[known] - 1)
    assert STRIDE**2 * known.mean() > 0.3
    assert np.median(error) < 0.02
    assert np.mean(error > 0.15) < 0.08  # the box hides some of the wall
    assert (depth > 0)[~np.isfinite(truth)].mean() < 0.05, (
        "the sky has no depth, but for its border"
    )


def test_nothing_is_measured_where_tracks_place_too_few_points(views):
    none = Tracks(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 2)), 0)
    empty = place(none, [view.camera for view in views])
    assert between_points(views[0].camera, none, empty, 0) is None
    assert not any(depth.any() for depth in depth_maps(views[:3], none, empty))


def test_inverse_depth_between_points_of_a_plane_is_the_plane_s_at_the_middle_of_every_pixel():
    """On a plane it is linear in the image, so interpolating it errs by rounding alone."""
    width = 101
    height = 62
    camera = PinholeCamera(width, height, intrinsics(80.0, 80.0, 50.0, 30.0), np.eye(4))
    x, y = np.meshgrid(np.linspace(0, width, 9), np.linspace(0, height, 7))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)

    def inverse_depth(pixel):
        return 0.1 + 0.0005 * pixel[..., 0] + 0.0007 * pixel[..., 1]

    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.K).T
    points = np.arange(len(pixels))
    tracks = Tracks(np.zeros_like(points), points, pixels, len(points))
    xyz = rays / inverse_depth(pixels)[:, None]
    known = Placed(xyz, np.zeros(len(points)), np.ones(len(points)))
    measured = between_points(camera, tracks, known, 0)
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    true = inverse_depth(np.stack([columns, rows], axis=-1))
    inner = slice(4, -4), slice(4, -4)
    np.testing.assert_allclose(measured[inner], true[inner], rtol=2e-5)


def test_sky_is_found_where_the_street_has_none_of_its_own(views):
    for view, mask in zip(views, sky_masks(views), strict=True):
        truth = ~np.isfinite(true_depth(view))
        assert mask[truth].mean() > 0.7
        assert not mask[~truth].mean() > 0.005


def test_a_smooth_wall_with_depth_is_no_sky(views):
    walled = [
        replace(view, depth=np.where(np.isfinite(true_depth(view)), 0, 8).astype(np.float32))
        for view in views
    ]
    thinned = []
    for view in walled:
        depth = np.zeros_like(view.depth)
        depth[::STRIDE, ::STRIDE] = view.depth[::STRIDE, ::STRIDE]
        thinned.append(replace(view, depth=depth))
    assert not any(mask.any() for mask in sky_masks(thinned))


def test_exposure_and_white_balance_are_found_to_a_percent(views, tracks):
    rng = np.random.default_rng(5)
    true = rng.uniform(0.85, 1.15, (len(views), 3))
    true /= np.exp(np.log(true).mean(axis=0))
    found = balances(
        [brightened(view, tuple(gain)) for view, gain in zip(views, true, strict=True)], tracks
    )
    assert np.abs(found / true - 1).max() < 0.03
    assert np.abs(np.log(found).mean(axis=0)).max() < 1e-9


def test_a_gain_between_photographs_is_that_of_the_nearest_two_of_the_own_camera():
    cameras = ["front", "front", "front", "left"]
    centres = np.array([[0.0, 0, 0], [1, 0, 0], [9, 0, 0], [0.5, 0, 0]])
    gains = np.array([[1.0] * 3, [1.2] * 3, [5.0] * 3, [0.5] * 3])

    def gain_at(camera, x_m, count=4):
        place = np.array([x_m, 0.0, 0.0])
        return gain_near(camera, place, cameras[:count], centres[:count], gains[:count])

    assert np.allclose(gain_at("front", 0.5), 1.1, atol=1e-3)
    assert np.allclose(gain_at("front", 0.0), 1.0, atol=2e-3)
    assert np.allclose(gain_at("left", 8.0), 0.5)
    assert np.allclose(gain_at("roof", 9.0, 3), 5.0, atol=2e-3)
    assert np.allclose(gain_at("front", 0.0, 0), 1.0)


def test_a_held_out_photograph_has_the_gain_of_its_own_camera_s_neighbours(monkeypatch):
    """The left camera stands beside the front one, and meters half as bright."""
    gains = {"front": (1.0,) * 3, "left": (0.5,) * 3}
    rng = np.random.default_rng(0)
    cameras = {}
    views = []
    for camera, left_m in (("front", 0.0), ("left", 0.1)):
        for i in range(4):
            T = STREET.pose(STEP_M * i, -left_m)
            name = f"{camera}-{i:06d}"
            cameras[name] = PinholeCamera.from_pose(32, 16, K, T)
            rgb = rng.integers(0, 255, (16, 32, 3), dtype=np.uint8)
            views.append(PosedView(cameras[name], rgb, name))

    def fitted(views, start, recipe, **rest):
        empty = Sky(np.zeros((HEIGHT, WIDTH, 3), dtype=np.float32))
        model_gains = tuple(gains[view.camera_name] for view in views)
        return Reconstruction(start.background, {}, empty, model_gains)

    monkeypatch.setattr(drive, "fit", fitted)
    kept = {name: cameras[name] for name in ("front-000001", "left-000002")}
    train = [view for view in views if view.name not in kept]
    points = cloud_from_points(np.zeros((5, 3)), np.full((5, 3), 0.5))
    exposures = drive.fit_drive(train, points, kept=kept).exposures
    assert exposures["front-000001"] == pytest.approx(gains["front"])
    assert exposures["left-000002"] == pytest.approx(gains["left"])


def test_photographs_that_measure_nothing_do_not_start_from_no_points(views):
    blank = [replace(view, rgb=np.zeros_like(view.rgb)) for view in views[:2]]
    none = cloud_from_points(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(InputError, match="nothing whose distance they measure"):
        drive.fit_drive(blank, none, recipe=replace(SplatRecipe.street(), steps=1))


def test_a_view_of_another_size_keeps_what_is_not_of_single_pixels(views):
    sky = np.zeros(views[0].rgb.shape[:2], dtype=bool)
    view = replace(views[0], actors={"car": np.eye(4)}, gain=(1.1, 1.0, 0.9), t_us=7, sky=sky)
    small = resized(view, 100)
    assert (small.actors, small.gain, small.t_us) == (view.actors, view.gain, 7)
    assert (small.name, small.sky, small.rgb.shape[1]) == (view.name, None, 100)


def test_a_halved_view_sees_the_same_with_a_quarter_of_the_pixels(views):
    flags = np.arange(views[0].rgb[..., 0].size).reshape(views[0].rgb.shape[:2]) > 100
    small = halved(replace(views[0], sky=flags, gain=(1.1, 1.0, 0.9)))
    point = views[0].camera.centre_world + np.array([8.0, 1.0, 0.5])
    whole, half = (
        c.K @ (c.T_camera_world[:3, :3] @ point + c.T_camera_world[:3, 3])
        for c in (views[0].camera, small.camera)
    )
    middle = 0.5  # of the first pixel, in both
    assert np.allclose(whole[:2] / whole[2] - middle, 2 * (half[:2] / half[2] - middle))
    assert [bool(flag) for flag in small.sky[:2, 50]] == [False, True]
    assert small.gain == (1.1, 1.0, 0.9)


def test_colours_and_depth_of_a_halved_view_are_those_of_a_slope_at_the_middle_of_its_pixels():
    """Both follow the rays' slope downwards, as those of a road do."""

    def slopes(camera):
        return np.repeat((np.arange(camera.height) + 0.5 - camera.cy) / camera.fy, camera.width)

    camera = PinholeCamera(80, 60, intrinsics(100.0, 100.0, 41.0, 5.0), np.eye(4))
    depth = (1 / (0.1 + 0.2 * slopes(camera))).astype(np.float32).reshape(60, 80)
    levels = np.rint(100 + 200 * slopes(camera)).astype(np.uint8).reshape(60, 80, 1)
    small = halved(PosedView(camera, np.repeat(levels, 3, axis=2), depth=depth))
    assert small.rgb.shape == (30, 40, 3)
    true = 1 / (0.1 + 0.2 * slopes(small.camera))
    np.testing.assert_allclose(small.depth.ravel(), true, rtol=1e-6)
    inner = slice(1, None)  # above the first row there is nothing to take the mean of
    shade = (100 + 200 * slopes(small.camera)).reshape(30, 40)
    assert np.abs(small.rgb[inner, :, 0] - shade[inner]).max() < 1.0


@pytest.mark.parametrize("along", ["rows", "columns"])
def test_depth_on_a_steep_slope_is_confirmed_by_the_nearest_pixel_of_a_neighbour(along):
    """Depth falls by 5 % from pixel to pixel; the second view is shifted by 1.4 of them."""
    views = []
    maps = []
    for shift_px in (0.0, 1.4):
        depth = np.repeat((10.0 * 0.95 ** (np.arange(40) - shift_px))[:, None], 40, axis=1)
        K = intrinsics(50.0, 50.0, 20.0, 20.0 + shift_px)
        if along == "columns":
            depth = depth.T
            K = intrinsics(50.0, 50.0, 20.0 + shift_px, 20.0)
        camera = PinholeCamera(40, 40, K, np.eye(4))
        views.append(PosedView(camera, np.zeros((40, 40, 3), dtype=np.uint8)))
        measured = np.zeros((40, 40), dtype=np.float32)
        measured[::STRIDE, ::STRIDE] = depth[::STRIDE, ::STRIDE]
        maps.append(measured)
    np.testing.assert_array_equal(dense._agreed(views, maps, 0), maps[0])


def test_matched_points_lie_where_the_photographs_show_them():
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[0:160, 0:160] + 0.5
    middles = np.array([[20 + 40 * (i % 4), 20 + 40 * (i // 4)] for i in range(16)])
    middles = middles + rng.uniform(0, 1, (16, 2))
    grey = np.full((160, 160), 60.0)
    for i, (x, y) in enumerate(middles):
        shape = np.hypot(columns - x, (1 + 0.02 * i) * (rows - y)) / (2 + 0.1 * i)
        grey += 150 * np.exp(-0.5 * shape**2)
    rgb = np.repeat(np.rint(grey)[..., None], 3, axis=2).astype(np.uint8)
    camera = PinholeCamera(160, 160, intrinsics(100.0, 100.0, 80.0, 80.0), np.eye(4))
    pairs = matches([PosedView(camera, rgb), PosedView(camera, rgb)])
    errors = []
    for match in pairs:
        away = match.at_first - middles
        nearest = away[np.argmin(np.hypot(*away.T))]
        if np.hypot(*nearest) < 1.0:
            errors.append(nearest)
    assert len(errors) > 10
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05
