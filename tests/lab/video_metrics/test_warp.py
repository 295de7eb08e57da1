"""Warp L1 on videos whose motion is known (values of the checks: docs/lab/video-metrics.md)."""

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.fixers.semantic_map.style import BOX_COLOURS, COLOURS
from alpasim_plugin.lab.video_metrics.clip import clip_quality
from alpasim_plugin.lab.video_metrics.road import road_mask
from alpasim_plugin.lab.video_metrics.warp import backward_flow, late_window, warp_errors, warp_l1

RNG = stream("video", 0, "warp")


def texture(height, width):
    noise = cv2.GaussianBlur(RNG.standard_normal((height, width, 3)), (0, 0), 3.0)
    return np.clip(127 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)


def test_picture_that_moves_three_pixels_is_followed():
    wide = texture(120, 200)
    video = np.stack(
        [wide[:, 3 * i : 3 * i + 160] for i in range(3)]
    )  # what is seen moves left: it was 3 px to the right
    flow = backward_flow(*(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in (video[1], video[0])))
    inner = flow[20:-20, 20:-20].reshape(-1, 2)
    assert np.median(inner, axis=0) == pytest.approx([3.0, 0.0], abs=0.05)
    found = warp_l1(video)
    plain = np.abs(np.diff(video.astype(float), axis=0)).sum(-1).mean() / 765
    assert found.shape == (2,)
    assert np.all(found < 0.05 * plain)


def test_video_that_stands_still_has_no_error():
    still = np.repeat(texture(64, 96)[None], 3, axis=0)
    grey = cv2.cvtColor(still[0], cv2.COLOR_RGB2GRAY)
    assert np.abs(backward_flow(grey, grey))[8:-8, 8:-8].max() < 0.03  # Farneback wavers at the rim
    assert np.all(warp_l1(still) < 3e-4)


@pytest.mark.parametrize(
    ("pairs", "first"), [(197, 131), (899, 599), (90, 60), (89, 59), (30, 0), (5, 0)]
)
def test_late_window_is_the_last_third_but_at_least_thirty(pairs, first):
    assert len(range(pairs)[late_window(pairs)]) == pairs - first


def test_one_frame_has_no_motion_to_follow():
    with pytest.raises(EvaluatorError):
        warp_l1(texture(32, 32)[None])


def test_error_of_the_road_leaves_out_what_flickers_beside_it():
    video = np.repeat(texture(64, 96)[None], 40, axis=0)
    video[:, :20] = RNG.integers(0, 256, (40, 20, 96, 3))  # the sky flickers
    road = np.zeros(video.shape[:3], dtype=bool)
    road[:, 44:] = True
    errors = warp_errors(video, road)
    assert np.array_equal(errors.whole, warp_l1(video))
    assert errors.road.max() < 0.02 * errors.whole.min()
    everything = warp_errors(video, np.ones_like(road))
    assert np.array_equal(everything.road, everything.whole)


def test_late_road_error_is_over_the_pairs_that_show_a_road_and_absent_without_a_map():
    video = np.repeat(texture(32, 48)[None], 40, axis=0)
    video[25:] = video[25:] // 2 + RNG.integers(0, 99, (15, 32, 48, 3), dtype=np.uint8)
    road = np.ones(video.shape[:3], dtype=bool)
    road[25:] = False
    whole = clip_quality(video, None, {}).means
    assert "warp_l1_late_road" not in whole
    quiet = clip_quality(video, None, {}, road).means["warp_l1_late_road"]
    assert quiet == pytest.approx(warp_l1(video)[9:24].mean(), rel=1e-6)
    assert quiet < whole["warp_l1_late"]
    assert "warp_l1_late_road" not in clip_quality(video, None, {}, ~np.ones_like(road)).means
    with pytest.raises(EvaluatorError, match="road mask"):
        warp_errors(video, road[:3])


def test_road_lies_between_the_outermost_markings_however_faded():
    sdmap = np.zeros((1, 40, 128, 3), dtype=np.uint8)
    for row, fade in ((10, 0.1), (20, 0.5), (30, 1.0)):
        sdmap[0, row, 50 - row] = np.rint(np.array(COLOURS["road_boundary"]) * fade)
        sdmap[0, row, 60 + row] = np.rint(np.array(COLOURS["line_white"]) * fade)
    road = road_mask(sdmap)[0]
    assert [int(road[row].sum()) for row in (10, 15, 20, 30)] == [31, 0, 51, 71]
    assert not road_mask(np.zeros_like(sdmap)).any()


def test_the_road_goes_on_to_the_side_that_its_edge_has_left_through():
    sdmap = np.zeros((1, 40, 64, 3), dtype=np.uint8)
    rows = np.arange(5, 40)
    left = 30 - 2 * (rows - 5)  # leaves the image at row 20
    right = 34 + (rows - 5)  # leaves it at row 34
    for row, a, b in zip(rows, left, right, strict=True):
        for column in (a, b):
            if 0 <= column < 64:
                sdmap[0, row, column] = COLOURS["road_boundary"]
    road = road_mask(sdmap)[0]
    assert np.flatnonzero(road[15]).tolist() == list(range(10, 45))
    assert np.flatnonzero(road[25]).tolist() == list(range(55))  # from the side to the right edge
    assert road[36].all()  # neither edge is in sight, the camera stands on the road
    assert not road[4].any()


def test_an_edge_that_mixes_with_a_white_line_is_an_edge():
    sdmap = np.zeros((1, 12, 64, 3), dtype=np.uint8)
    sdmap[0, 4, :2] = (235, 119, 225)
    sdmap[0, 8, 20] = COLOURS["line_white"]
    sdmap[0, 8, 40] = COLOURS["road_boundary"]
    assert np.flatnonzero(road_mask(sdmap)[0, 8]).tolist() == list(range(41))


def test_a_light_blue_car_is_no_road_though_untyped_lines_look_like_it():
    sdmap = np.zeros((1, 30, 256, 3), dtype=np.uint8)
    sdmap[0, 20, 10:60:49] = COLOURS["line_untyped"]
    sdmap[0, 5:25, 100:150] = (101, 174, 231)  # between its front and its back colour
    road = road_mask(sdmap)[0]
    assert np.flatnonzero(road[20]).tolist() == list(range(10, 60))
    assert not road[10].any()


def test_another_edge_in_the_same_half_ends_the_road_again():
    sdmap = np.zeros((1, 20, 64, 3), dtype=np.uint8)
    sdmap[0, 5, 0:20] = COLOURS["road_boundary"]  # the far side of a side street
    sdmap[0, 10, 40] = COLOURS["road_boundary"]
    sdmap[0, 15, 16:41:24] = COLOURS["road_boundary"]
    road = road_mask(sdmap)[0]
    assert road[10, :41].all()
    assert np.flatnonzero(road[15]).tolist() == list(range(16, 41))


def test_a_road_user_is_no_road_and_its_grey_edges_are_no_paint():
    sdmap = np.zeros((1, 20, 128, 3), dtype=np.uint8)
    sdmap[0, 10, 10:60:49] = COLOURS["road_boundary"]
    sdmap[0, 5:15, 20:30] = BOX_COLOURS["car"][0]
    sdmap[0, 5:15, 90:100] = BOX_COLOURS["truck"][1]
    sdmap[0, 5:15, 100] = COLOURS["box_edge"]
    road = road_mask(sdmap)[0]
    assert not road[:, 60:].any()
    assert not road[10, 20:30].any()
    assert road[10, 10:20].all()
    assert road[10, 30:60].all()
