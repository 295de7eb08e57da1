import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from alpasim_plugin.core.geometry import arc_lengths, centre_line, densify
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import Lane, LaneMap
from alpasim_plugin.world.route import LaneIndex
from tests.examples import examples
from tests.world.small_maps import FAR, arc, make, straight

GRID = make(
    *(straight(f"{i}{j}", 20.0 * i, 20.0 * i + 20, 3.5 * j) for i in range(4) for j in range(4)),
    arc("turn", 15.0, 90.0),
)


def slow_containing(lane_map, point):
    return tuple(
        k
        for k, lane in lane_map.lanes.items()
        if lane_polygon(lane).intersects(shapely.Point(point[:2]))
    )


@given(st.lists(st.tuples(st.floats(-5, 85), st.floats(-5, 20)), min_size=1, max_size=30))
@settings(deadline=None, max_examples=examples(60))
def test_index_finds_the_same_lanes_as_a_loop_over_all_polygons(points):
    found = LaneIndex(GRID).containing_many(np.array(points))
    assert found == [slow_containing(GRID, p) for p in points]


def test_point_on_a_shared_edge_is_in_both_lanes():
    assert LaneIndex(GRID).containing(np.array([10.0, 1.75])) == ("00", "01", "turn")
    assert LaneIndex(GRID).containing(np.array([30.0, 5.25])) == ("11", "12")


def test_answers_do_not_depend_on_where_the_map_lies():
    rng = np.random.default_rng(3)
    points = rng.uniform((-5, -5), (85, 20), (200, 2))
    far = LaneIndex(make(*GRID.lanes.values(), shift=FAR))
    near = LaneIndex(GRID)
    assert far.containing_many(points + FAR[:2]) == near.containing_many(points)
    for p in points[:40]:
        assert far.within(np.append(p, 0.0) + FAR, 6.0) == near.within(np.append(p, 0.0), 6.0)
        assert far.heading_rad("turn", p + FAR[:2]) == pytest.approx(
            near.heading_rad("turn", p), abs=1e-7
        )


def test_lane_without_edges_is_its_centre_buffered_by_half_a_width():
    lane = Lane(
        "a", np.array([[0.0, 0, 0], [10.0, 0, 0]]), None, np.array([[0.0, -1, 0], [10.0, -1, 0]])
    )
    index = LaneIndex(LaneMap({"a": lane}))
    assert index.containing(np.array([5.0, 1.849])) == ("a",)
    assert index.containing(np.array([5.0, 1.851])) == ()
    assert index.containing(np.array([5.0, -1.5])) == ("a",)
    assert lane_polygon(lane, half_width_m=1.0).area == pytest.approx(20 + np.pi, rel=0.01)


def test_lane_of_one_centre_point_is_a_disc():
    assert lane_polygon(Lane("a", np.zeros((1, 3)), None, None)).area == pytest.approx(
        np.pi * 1.85**2, rel=0.01
    )


def test_edges_that_cross_keep_both_areal_parts():
    left = np.array([[0.0, 1, 0], [10.0, -1, 0]])
    right = np.array([[0.0, -1, 0], [10.0, 1, 0]])
    shape = lane_polygon(Lane("a", np.array([[0.0, 0, 0], [10.0, 0, 0]]), left, right))
    assert shape.is_valid
    assert shape.area == pytest.approx(10.0)
    assert shape.geom_type == "MultiPolygon"


def test_a_lane_that_turns_450_degrees_covers_where_it_passes_over_itself():
    angle = np.linspace(0.0, 2.5 * np.pi, 60)

    def at(radius_m):  # a spiral ramp, whose end crosses its beginning
        r = radius_m + 6.0 * np.maximum(angle - 2 * np.pi, 0.0) - 3.0 * (angle > 2 * np.pi)
        return np.stack([r * np.cos(angle), r * np.sin(angle), 2.0 * angle], axis=1)

    lane = Lane("ramp", at(20.0), at(18.25), at(21.75))
    shape = lane_polygon(lane)
    assert shape.is_valid
    assert shapely.contains_xy(shape, at(20.0)[1:-1, :2]).all()
    assert not shapely.contains_xy(shape, 0.0, 0.0)
    alpasim = lane_polygon(lane, even_odd=True)
    assert not shapely.contains_xy(alpasim, at(20.0)[1:-1, :2]).all()


def test_edges_on_top_of_each_other_contain_nothing():
    line = np.array([[0.0, 0, 0], [10.0, 0, 0]])
    shape = lane_polygon(Lane("a", line, line, line))
    assert shape.area == 0
    assert (
        LaneIndex(LaneMap({"a": Lane("a", line, line, line)})).containing(np.array([5.0, 1.0]))
        == ()
    )


def test_bridge_does_not_answer_for_the_road_below():
    index = LaneIndex(make(straight("road", 0, 50), straight("bridge", 0, 50, z=7.0)))
    assert index.within(np.array([20.0, 0.0, 0.2]), 6.0) == ("road",)
    assert index.within(np.array([20.0, 0.0]), 6.0) == ("road", "bridge")


def test_heading_follows_the_curve_at_the_point():
    index = LaneIndex(make(arc("turn", 30.0, 90.0)))
    at = np.array([30 * np.sin(np.pi / 4), 30 - 30 * np.cos(np.pi / 4)])
    assert index.heading_rad("turn", at) == pytest.approx(np.pi / 4, abs=0.03)


def test_path_goes_straight_on_at_a_fork_and_has_the_asked_length():
    fork = make(
        straight("in", 0, 20, successors=("right", "on", "left", "outside")),
        arc("left", 15.0, 80.0, start=(20, 0)),
        straight("on", 20, 60, successors=("end",)),
        arc("right", 15.0, 80.0, start=(20, 0), turn=-1.0),
        straight("end", 60, 200),
    )
    path = LaneIndex(fork).path_ahead("in", 75.0, start=np.array([5.0, 0.7]))
    assert path.lane_ids == ("in", "on", "end")
    assert arc_lengths(path.xyz)[-1] == pytest.approx(75.0)
    assert_allclose(path.xyz[[0, -1], 0], [5.0, 80.0])
    assert (np.diff(path.xyz[:, 0]) > 0).all()


def test_path_round_a_ring_road_comes_to_an_end():
    half = arc("two", 20.0, 180.0, successors=("one",))
    back = Lane(
        **{
            **vars(half),
            **{k: getattr(half, k) * (-1, -1, 1) + (0, 40, 0) for k in ("centre", "left", "right")},
        }
    )
    path = LaneIndex(make(arc("one", 20.0, 180.0, successors=("two",)), back)).path_ahead(
        "one", 300.0
    )
    assert_allclose(np.hypot(path.xyz[:, 0], path.xyz[:, 1] - 20), 20.0, atol=0.15)
    assert arc_lengths(path.xyz)[-1] == pytest.approx(300.0)
    assert path.lane_ids[:3] == ("one", "two", "one")


def test_lane_of_no_length_that_follows_itself_ends_the_path():
    point = np.zeros((2, 3))
    lane = Lane("a", point, None, None, successors=("a",))
    assert len(LaneIndex(LaneMap({"a": lane})).path_ahead("a", 10.0).xyz) == 1


@given(st.lists(st.floats(0.01, 30.0), min_size=1, max_size=8), st.floats(0.3, 5.0))
@settings(deadline=None)
def test_densified_line_keeps_its_vertices_and_its_shape(steps, limit):
    x = np.concatenate([[0.0], np.cumsum(steps)])
    line = np.column_stack([x, np.sin(x), np.cos(x)])
    dense = densify(line, limit)
    assert np.linalg.norm(np.diff(dense[:, :2], axis=0), axis=1).max() <= limit + 1e-6
    assert all((np.abs(dense - v).max(axis=1) < 1e-9).any() for v in line)
    assert arc_lengths(dense)[-1] == pytest.approx(arc_lengths(line)[-1])


def test_centre_lies_halfway_between_edges_with_different_numbers_of_points():
    left = np.array([[0.0, 2, 1], [50.0, 2, 1]])
    right = np.array([[0.0, -2, 0], [3.0, -2, 0], [11.0, -2, 0], [50.0, -2, 0]])
    centre = centre_line(left, right)
    assert_allclose(centre[:, 1], 0, atol=1e-12)
    assert_allclose(centre[:, 2], 0.5, atol=1e-12)
    assert_allclose(centre[[0, -1], 0], [0, 50])
    assert np.diff(centre[:, 0]).max() <= 2.0 + 1e-9


def test_long_segments_are_found_by_their_middle():
    assert LaneIndex(make(straight("a", 0, 400))).within(np.array([203.3, 3.0, 0.0]), 3.1) == ("a",)


def test_path_ends_with_the_map():
    path = LaneIndex(make(straight("a", 0, 20, successors=("gone",)))).path_ahead("a", 75.0)
    assert path.lane_ids == ("a",)
    assert arc_lengths(path.xyz)[-1] == pytest.approx(20.0)
