"""Invented and lost paint on a road that is drawn: lines, their absence, and what is no line."""

import cv2
import numpy as np
import pytest

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.lab.bench.lane_paint import compare_paint, paint_of, road_of
from alpasim_plugin.world.ground import flat

WIDTH = 320
HEIGHT = 160
EYE_M = 1.5
PATH = np.column_stack([np.arange(0.0, 60.0), np.zeros(60), np.zeros(60)])
ROAD_LEVEL = 90
WHITE = (220, 220, 220)
YELLOW = (220, 190, 60)


@pytest.fixture(scope="module")
def camera():
    T = np.eye(4)
    T[:3, :3] = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    T[2, 3] = EYE_M
    return PinholeCamera.from_pose(
        WIDTH, HEIGHT, np.array([[180.0, 0, WIDTH / 2], [0, 180.0, 60], [0, 0, 1]]), T
    )


def drawn(camera, lines):
    """Draw lines along the road: (metres to the left, width, colour); the road is grey, the sky
    bright.
    """
    picture = np.full((HEIGHT, WIDTH, 3), ROAD_LEVEL, dtype=np.uint8)
    picture[:60] = 230
    for left, width, colour in lines:
        corners = [
            (x, left + side * width / 2) for x, side in ((3.0, -1), (50.0, -1), (50.0, 1), (3.0, 1))
        ]
        pixels = [
            (camera.cx - camera.fx * y / x, camera.cy + camera.fy * EYE_M / x) for x, y in corners
        ]
        cv2.fillPoly(
            picture, [np.rint(np.array(pixels) * 16).astype(np.int32)], colour, cv2.LINE_AA, 4
        )
    return picture


@pytest.fixture(scope="module")
def road(camera):
    return road_of(camera, flat(), PATH)


def test_the_road_is_seen_between_four_and_thirty_metres_and_four_beside_the_path(
    road,
):
    rows, columns = np.nonzero(road.mask)
    assert rows.min() == pytest.approx(60 + 180 * EYE_M / 30, abs=1.5)
    assert rows.max() == pytest.approx(60 + 180 * EYE_M / 4, abs=1.5)
    row = 60 + 27  # 10 m ahead
    across = columns[rows == row]
    assert across.min() == pytest.approx(WIDTH / 2 - 180 * 4 / 10, abs=2)
    assert across.max() == pytest.approx(WIDTH / 2 + 180 * 4 / 10, abs=2)


@pytest.mark.parametrize("colour", [WHITE, YELLOW])
def test_a_line_is_paint_and_found_where_it_is(camera, road, colour):
    picture = drawn(camera, [(1.8, 0.12, colour)])
    paint = paint_of(picture, road)
    truth = (np.abs(picture.astype(int) - ROAD_LEVEL).max(axis=2) > 60) & road.mask
    assert paint[truth].mean() > 0.8
    assert paint[~cv2.dilate(truth.astype(np.uint8), np.ones((3, 3))).astype(bool)].sum() == 0


@pytest.mark.parametrize("picture", ["plain", "bright half", "wide slab"])
def test_what_is_no_line_is_no_paint(camera, road, picture):
    lines = {"plain": [], "bright half": [(5.0, 8.0, WHITE)], "wide slab": [(0.0, 2.5, WHITE)]}[
        picture
    ]
    assert not paint_of(drawn(camera, lines), road).any()


def test_an_invented_double_line_costs_precision_and_not_recall(camera, road):
    truth = drawn(camera, [(1.8, 0.12, WHITE)])
    made = drawn(camera, [(1.8, 0.12, WHITE), (-0.5, 0.12, YELLOW), (-0.9, 0.12, YELLOW)])
    found = compare_paint(made, truth, road)
    assert 0.2 < found.precision < 0.5
    assert found.recall == pytest.approx(1.0)


def test_a_lost_line_costs_recall_and_nothing_made_has_no_precision(camera, road):
    found = compare_paint(drawn(camera, []), drawn(camera, [(1.8, 0.12, WHITE)]), road)
    assert found.precision is None
    assert found.recall == 0
    assert (
        compare_paint(drawn(camera, [(1.8, 0.12, WHITE)]), drawn(camera, []), road).recall is None
    )


def test_a_line_off_by_less_than_two_pixels_counts_as_the_same(camera, road):
    truth = drawn(camera, [(1.8, 0.12, WHITE)])
    assert compare_paint(np.roll(truth, 1, axis=1), truth, road).precision == pytest.approx(1.0)
    away = compare_paint(np.roll(truth, 8, axis=1), truth, road).precision
    assert away < 0.3
