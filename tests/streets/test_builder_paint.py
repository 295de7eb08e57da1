from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.types import LaneMap, Marking
from alpasim_plugin.streets.markings import (
    GAP_M,
    LINE_M,
    WHITE,
    YELLOW,
    marking_strokes,
)
from alpasim_plugin.streets.site import make_site
from alpasim_plugin.world.markings import with_default_markings
from tests.gaussians.scene_maps import LANE_M, line, make_scenario, road_lanes

PATH = line((0, -1.8), (60, -1.8))


def strokes_of(scenario):
    """Return strokes and the world positions of their middles."""
    site = make_site(scenario, lambda xy: np.zeros(len(xy)))
    strokes = marking_strokes(site)
    return strokes, site.frame.to_world((strokes.start + strokes.end) / 2)


def at(middle, y_m, tolerance_m=0.06):
    return np.abs(middle[:, 1] - y_m) < tolerance_m


def length(strokes, chosen):
    return float(np.linalg.norm(strokes.end - strokes.start, axis=1)[chosen].sum())


@pytest.fixture(scope="module")
def two_by_two():
    return strokes_of(
        make_scenario(
            with_default_markings(LaneMap(road_lanes(line((-60, 0), (180, 0)), "r"))), PATH
        )
    )


def test_unknown_edge_between_lanes_of_one_direction_is_dashed_white(
    two_by_two,
):
    strokes, middle = two_by_two
    chosen = at(middle, -LANE_M)
    assert set(strokes.colour[chosen]) == {WHITE}
    assert length(strokes, chosen) == pytest.approx(220 * LINE_M / (LINE_M + GAP_M), rel=0.2)


def test_dashes_are_three_metres_with_nine_between(two_by_two):
    strokes, middle = two_by_two
    chosen = at(middle, -LANE_M)
    x = np.sort(np.concatenate([strokes.start[chosen, 0], strokes.end[chosen, 0]]))
    gaps = np.diff(x)
    assert gaps.max() == pytest.approx(GAP_M, abs=0.05)
    dash_starts = np.concatenate([[x[0]], x[1:][gaps > 1.0]])
    np.testing.assert_allclose(np.diff(dash_starts), LINE_M + GAP_M, atol=0.05)


def test_unknown_edge_between_opposing_lanes_is_double_yellow(
    two_by_two,
):
    strokes, middle = two_by_two
    pair = at(middle, 0.0, 0.2)
    assert set(strokes.colour[pair]) == {YELLOW}
    assert at(middle, 0.16).any()
    assert at(middle, -0.16).any()
    assert not at(middle, 0.0).any()


def test_unknown_outer_edge_is_solid_white(two_by_two):
    strokes, middle = two_by_two
    for side in (-1, 1):
        chosen = at(middle, side * 2 * LANE_M)
        assert set(strokes.colour[chosen]) == {WHITE}
        assert length(strokes, chosen) > 210


def test_dashes_run_on_from_lane_to_lane():
    lanes = {}
    for i in range(4):
        lanes |= road_lanes(line((i * 17.0, 0), (i * 17.0 + 17.0, 0)), f"r{i}", 2)
    strokes, middle = strokes_of(make_scenario(with_default_markings(LaneMap(lanes)), PATH))
    chosen = at(middle, -LANE_M)
    x = np.sort(np.concatenate([strokes.start[chosen, 0], strokes.end[chosen, 0]]))
    assert np.diff(x).max() == pytest.approx(GAP_M, abs=0.1)


def test_known_paint_is_believed_and_shared_edges_are_painted_once():
    lanes = road_lanes(line((0, 0), (80, 0)), "r", 2)
    lanes["r-a0"] = replace(
        lanes["r-a0"], right_mark_type="solid_yellow"
    )  # the same place is r-a1's unknown left edge
    strokes, middle = strokes_of(make_scenario(with_default_markings(LaneMap(lanes)), PATH))
    chosen = at(middle, -LANE_M)
    assert set(strokes.colour[chosen]) == {YELLOW}
    assert length(strokes, chosen) == pytest.approx(80, rel=0.02)


def test_nothing_unknown_is_painted_inside_an_intersection():
    lanes = road_lanes(line((0, 0), (80, 0)), "r", 1, is_intersection=True)
    strokes, _ = strokes_of(make_scenario(with_default_markings(LaneMap(lanes)), PATH))
    assert len(strokes.start) == 0


def test_map_with_marking_lines_keeps_unknown_lane_edges_bare():
    lanes = road_lanes(line((0, 0), (80, 0)), "r", 2)
    marking = Marking(line((0, -LANE_M), (80, -LANE_M)), "solid_white")
    strokes, middle = strokes_of(
        make_scenario(with_default_markings(LaneMap(lanes, markings=(marking,))), PATH)
    )
    assert at(middle, -LANE_M).all()
    assert length(strokes, at(middle, -LANE_M)) == pytest.approx(80, rel=0.02)


def test_zebra_bars_lie_along_the_road_across_the_walk():
    walk = np.array([[30.0, -7.0, 0], [33.0, -7.0, 0], [33.0, 7.0, 0], [30.0, 7.0, 0]])
    strokes, middle = strokes_of(make_scenario(LaneMap({}, crosswalks=(walk,)), PATH))
    direction = (strokes.end - strokes.start) / np.linalg.norm(
        strokes.end - strokes.start, axis=1, keepdims=True
    )
    assert np.abs(direction[:, 1]).max() < 0.01
    assert len(strokes.start) >= 14
    np.testing.assert_allclose(np.diff(np.sort(middle[:, 1])), 0.9, atol=0.02)


def test_edge_known_to_be_bare_stays_bare():
    lanes = road_lanes(line((0, 0), (80, 0)), "r", 2)
    lanes["r-a1"] = replace(lanes["r-a1"], left_mark_type="none")
    _, middle = strokes_of(make_scenario(with_default_markings(LaneMap(lanes)), PATH))
    assert not at(middle, -LANE_M).any()
    assert at(middle, LANE_M).any()


def test_stop_line_is_wide_and_white():
    stop = np.array([[20.0, -3.0, 0], [20.0, 0.0, 0]])
    strokes, _ = strokes_of(make_scenario(LaneMap({}, stop_lines=(stop,)), PATH))
    assert strokes.width_m.tolist() == [0.4]
    assert strokes.colour.tolist() == [WHITE]
