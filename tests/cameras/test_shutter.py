"""A rolling shutter cut into bands: every pixel once, each at its time, and no more bands than the
motion needs.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.cameras.image_map import image_map
from alpasim_plugin.cameras.lens import exposed_bands
from alpasim_plugin.cameras.shutter import (
    MOST_BANDS,
    at_share,
    bands,
    bands_of,
    between,
    motion_px,
    rolling,
    rolling_exposure,
)
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import CameraSpec, Exposure, LensModel, RenderRequest
from tests.camera_builders import ahead

WIDTH = 64
HEIGHT = 32
FORWARD = ahead()
SPEC = CameraSpec(
    "front", WIDTH, HEIGHT, np.array([[400.0, 0, 32], [0, 400.0, 16], [0, 0, 1]]), FORWARD
)


def asked(
    start,
    end,
    actors=None,
    along="rows",
    back=False,
):
    """A request from rig poses at shutter start and end."""
    given = actors or {}
    exposure = Exposure(
        rolling(WIDTH, HEIGHT, along, back), {name: pair[0] for name, pair in given.items()}
    )
    T = np.stack([start @ FORWARD, end @ FORWARD])
    return RenderRequest(
        0, SPEC, T, {name: pair[1] for name, pair in given.items()}, exposure=exposure
    )


FAST = asked(se2(0, 0, 0), se2(0.6, 0, 0.05))


@pytest.mark.parametrize(
    ("along", "back"), [("rows", False), ("rows", True), ("columns", False), ("columns", True)]
)
@pytest.mark.parametrize("count", [1, 5, HEIGHT, 3 * WIDTH])
def test_bands_hold_every_pixel_once_and_time_runs_along_the_axis(along, back, count):
    request = asked(se2(0, 0, 0), se2(0.6, 0, 0.05), along=along, back=back)
    times = np.full((HEIGHT, WIDTH), np.nan)
    seen = np.zeros((HEIGHT, WIDTH), dtype=int)
    for band in bands_of(request, count):
        assert band.exposed is None
        seen[band.rows, band.columns] += 1
        times[band.rows, band.columns] = band.T_world_camera[0, 3] / 0.6
    assert (seen == 1).all()
    assert np.abs(times - request.exposure.share).max() <= 0.5 / count + 1e-6


def test_pixels_that_nobody_looks_at_are_in_no_band_and_a_curved_one_has_a_mask():
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    share = np.clip(v / HEIGHT + 0.2 * np.abs(u - 32) / 32, 0, 1).astype(np.float32)
    share[:, :5] = np.nan
    request = replace(FAST, exposure=Exposure(share, {}))
    whole = np.full((HEIGHT, WIDTH), -1.0)
    for i, band in enumerate(bands_of(request, 4)):
        height = band.rows.stop - band.rows.start
        width = band.columns.stop - band.columns.start
        band.put(whole, np.full((height, width), float(i)))
    expected = np.where(np.isnan(share), -1, np.minimum(share * 4, 3).astype(float) // 1)
    assert_array_equal(whole, expected)


def test_a_car_that_stands_on_an_empty_road_needs_one_band_and_a_turning_one_many():
    still = se2(3, 1, 0.4)
    assert len(bands(asked(still, still))) == 1
    slow, fast = (len(bands(asked(still, still @ se2(0.3, 0, turn)))) for turn in (0.0, 0.03))
    assert 1 < slow < fast <= MOST_BANDS
    assert len(bands(asked(still, still @ se2(0, 0, 1.5)))) <= MOST_BANDS  # as a request may say
    assert len(bands(replace(FAST, exposure=None))) == 1


def test_a_passing_car_needs_bands_and_one_behind_the_camera_none():
    still = se2(0, 0, 0)
    ahead, behind = ((se2(x, 2, 0, 0.8), se2(x + 0.6, 2, 0, 0.8)) for x in (8.0, -20.0))
    assert len(bands(asked(still, still, {"car": ahead}))) > 5
    assert len(bands(asked(still, still, {"car": behind}))) == 1


def test_motion_is_what_a_near_point_moves_by():
    request = asked(se2(0, 0, 0), se2(0, 0, 0.01))
    assert motion_px(request) == pytest.approx(400 * 0.01, rel=0.1)
    assert motion_px(asked(se2(0, 0, 0), se2(0, 0.3, 0))) == pytest.approx(400 * 0.3 / 8, rel=0.1)


def test_poses_in_between_are_linear_and_turn_evenly_also_by_half_a_turn():
    start = se2(2, 0, 0.2)
    end = se2(4, 8, 0.2 + 0.9 * np.pi)
    middle = between(np.stack([start]), np.stack([end]), 0.25)[0]
    assert_allclose(middle, se2(2.5, 2, 0.2 + 0.225 * np.pi), atol=1e-12)
    assert_array_equal(between(np.stack([start]), np.stack([end]), 1.0)[0], end)


def test_road_users_are_where_they_are_at_the_time_of_the_band():
    request = asked(
        se2(0, 0, 0),
        se2(1, 0, 0),
        {"a": (se2(5, 0, 0), se2(6, 0, 0)), "b": (se2(9, 1, 0), se2(9, 1, 0))},
    )
    T, actors = at_share(request, 0.5)
    assert (T[0, 3], actors["a"][0, 3], actors["b"][0, 3]) == pytest.approx((0.5, 5.5, 9.0))


def test_a_picture_of_one_row_is_exposed_at_the_end():
    assert rolling(4, 1, "rows", False).tolist() == [[1.0]]


def test_road_users_stand_at_the_shutters_start_where_they_were_then():
    camera = replace(SPEC, shutter_us=30_000)
    before = {"car": se2(2.0, 1.0, np.radians(170.0))}
    now = {"car": se2(12.0, -4.0, np.radians(-170.0)), "newcomer": se2(5.0, 5.0, 0.3)}
    exposure = rolling_exposure(camera, before, now, 100_000)
    # 30 ms before the end of 100 ms: seven tenths of the way
    expected = se2(9.0, -2.5, np.radians(-176.0))
    assert_allclose(exposure.actors_start["car"], expected, atol=1e-9)
    assert_allclose(exposure.actors_start["newcomer"], now["newcomer"], atol=1e-9)
    assert exposure.share[0, 0] < exposure.share[-1, 0]
    assert rolling_exposure(SPEC, before, now, 100_000) is None


def through_fisheye(max_angle_deg, focal_px, middle):
    K = np.array([[focal_px, 0, middle[0]], [0, focal_px, middle[1]], [0, 0, 1]])
    lens = LensModel("fisheye", max_angle_rad=np.deg2rad(max_angle_deg))
    return CameraSpec("wide", 160, 120, K, FORWARD, 30_000, lens)


def test_a_lens_sees_a_road_user_that_passes_behind_its_camera():
    behind = np.deg2rad(112)
    place = 10 * np.array([np.cos(behind), np.sin(behind)])
    start, end = se2(place[0], place[1], 0), se2(place[0] + 0.6, place[1], 0)
    request = asked(np.eye(4), np.eye(4), {"car": (start, end)})
    camera = through_fisheye(115, 40.0, (80, 60))
    exposure = replace(request.exposure, share=rolling(160, 120, "rows", False))
    request = replace(request, camera=replace(camera, T_rig_camera=FORWARD), exposure=exposure)
    assert len(exposed_bands(request)) > 1


def test_a_lens_with_a_narrow_circle_between_the_places_looked_at_is_cut_into_bands():
    request = asked(np.eye(4), se2(0.5, 0, 0.1))
    exposure = replace(request.exposure, share=rolling(160, 120, "rows", False))
    camera = through_fisheye(8, 47.0, (70, 52))
    assert len(exposed_bands(replace(request, camera=camera, exposure=exposure))) > 1


def test_the_form_of_a_lens_that_turns_back_near_its_edge_reaches_over_its_image():
    lens = LensModel("ftheta", (0.0, 52.0, 0.0, -6.3), max_angle_rad=np.deg2rad(94))
    K = np.array([[1.0, 0, 80], [0, 1, 60], [0, 0, 1]])
    camera = CameraSpec("wide", 160, 120, K, FORWARD, 0, lens)
    shown = image_map(camera)
    assert 2 * np.arctan(np.sqrt(shown.s_most)) >= shown.widest_rad
