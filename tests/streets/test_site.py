"""The plan of a scene: what lies where."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from alpasim_plugin.streets.build_facades import place_houses
from alpasim_plugin.streets.site import CELL_M, make_site
from alpasim_plugin.world.ground import height_at
from tests.gaussians.scene_maps import straight


@pytest.fixture(scope="module")
def street():
    scenario = straight()
    return make_site(scenario, partial(height_at, scenario.ground))


def with_road(site, road):
    return replace(site, road=road, taken=np.zeros_like(road))


def round_and_square(site, half_m):
    """A ring road around round land and one around square land, each in the middle of a half."""
    h, w = site.road.shape
    road = np.zeros((h, w), dtype=np.uint8)
    half = round(half_m / CELL_M)
    width = round(7.0 / CELL_M)
    circle, square = (w // 4, h // 2), (3 * w // 4, h // 2)
    cv2.circle(road, circle, half + width, 1, -1)
    cv2.circle(road, circle, half, 0, -1)
    for size, value in ((half + width, 1), (half, 0)):
        low, high = (square[0] - size, square[1] - size), (square[0] + size, square[1] + size)
        cv2.rectangle(road, low, high, value, -1)
    return road.astype(bool), circle, square


def test_the_middle_of_a_roundabout_is_an_island_and_a_block_is_not(street):
    road, circle, square = round_and_square(street, 25.0)
    site = with_road(street, road)
    assert site.islands[circle[1], circle[0]]
    assert not site.islands[square[1], square[0]]
    assert not site.islands[0, 0]
    assert not site.islands[site.road].any()


def test_a_hexagonal_block_is_no_island(street):
    h, w = street.road.shape
    road = np.zeros((h, w), dtype=np.uint8)
    angle = np.arange(6) * np.pi / 3 + 0.3
    for size_m, value in ((32.0, 1), (25.0, 0)):
        corners = np.column_stack([np.cos(angle), np.sin(angle)]) * size_m / CELL_M
        cv2.fillPoly(road, [np.int32(corners + np.array([w // 2, h // 2]))], value)
    assert not with_road(street, road.astype(bool)).islands.any()


def test_houses_stand_in_a_block_and_not_on_an_island(street):
    road, circle, square = round_and_square(street, 25.0)
    environment = replace(street.scenario.environment, buildings=1.0)
    site = replace(
        with_road(street, road), scenario=replace(street.scenario, environment=environment)
    )
    middles = place_houses(site).front.mean(axis=1)
    for (column, row), has_houses in ((circle, False), (square, True)):
        middle = site.low + np.array([column, row]) * CELL_M
        away_m = np.linalg.norm(middles - middle, axis=1)
        assert (away_m < 25.0).any() == has_houses


def test_a_road_that_the_map_calls_a_motorway_has_no_pavements():
    scenario = straight()
    lanes = {
        key: replace(lane, is_motorway=True, is_intersection=True)
        for key, lane in scenario.lane_map.lanes.items()
    }
    built = replace(scenario, lane_map=replace(scenario.lane_map, lanes=lanes))
    assert not make_site(scenario, partial(height_at, scenario.ground)).highway
    assert make_site(built, partial(height_at, built.ground)).highway
