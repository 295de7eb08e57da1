import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.types import Lane, LaneMap, Marking
from alpasim_plugin.fixers.semantic_map.prepare import cut_dashes, prepare_map, triangulate
from alpasim_plugin.fixers.semantic_map.style import COLOURS, box_class
from alpasim_plugin.world.markings import marking_lines
from tests.examples import examples


def lane(key, y, left_mark_type="unknown", right_mark_type="unknown", reverse=False, **more):
    """A straight lane of 3.5 m width along x, driven backwards where asked."""
    x = np.arange(0.0, 61.0, 10.0)
    edges = [np.column_stack([x, np.full(7, y + side), np.zeros(7)]) for side in (1.75, 0.0, -1.75)]
    if reverse:
        edges = [e[::-1] for e in edges[::-1]]
    return Lane(
        key,
        edges[1],
        edges[0],
        edges[2],
        left_mark_type=left_mark_type,
        right_mark_type=right_mark_type,
        **more,
    )


def drawn(*lanes, **more):
    lane_map = LaneMap({k.lane_id: k for k in lanes}, **more)
    return [(float(xyz[0, 1]), paint) for xyz, paint in marking_lines(lane_map)]


def test_edge_shared_by_two_lanes_is_drawn_once_with_the_paint_that_is_known():
    found = drawn(
        lane("1", 0.0, "dashed_white", "solid_white"), lane("2", 3.5, "unknown", "unknown")
    )
    assert sorted(found) == [
        (-1.75, "solid_white"),
        (1.75, "dashed_white"),
    ]


def test_unknown_paint_is_drawn_as_nothing():
    assert drawn(lane("1", 0.0), lane("2", 3.5)) == []


def test_edge_shared_with_oncoming_traffic_is_drawn_once():
    found = drawn(
        lane("1", 0.0, "double_yellow", "none"),
        lane("2", 3.5, "double_yellow", "none", reverse=True),
    )
    assert found == [(1.75, "double_yellow")]


def test_edges_that_cross_are_both_drawn():
    one = lane("1", 0.0, "solid_white", "none")
    turned = lane("2", 0.0, "solid_white", "none")
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    two = Lane(
        "2",
        turned.centre @ quarter.T,
        turned.left @ quarter.T + [20.0, -30.0, 0.0],
        None,
        left_mark_type="solid_white",
    )
    assert len(drawn(one, two)) == 2


def test_unpainted_edges_and_virtual_ones_inside_intersections_are_not_drawn():
    assert drawn(lane("1", 0.0, "none", "none")) == []
    assert drawn(lane("1", 0.0, is_intersection=True)) == []
    assert len(drawn(lane("1", 0.0, "solid_white", "unknown", is_intersection=True))) == 1


def test_marking_lines_are_drawn_with_the_lane_edges_of_known_paint_beside_which_none_runs():
    line = np.array([[0.0, 0, 0], [9, 0, 0]])
    markings = (
        Marking(line, "dashed_yellow"),
        Marking(line + 1, "none"),
        Marking(line[:1], "unknown"),
    )
    found = drawn(lane("1", 0.0, "solid_white"), markings=markings)
    assert found == [(0.0, "dashed_yellow"), (1.75, "solid_white")]
    along = (Marking(np.array([[-40.0, 1.75, 0], [80, 1.75, 0]]), "dashed_yellow"),)
    assert drawn(lane("1", 0.0, "solid_white"), markings=along) == [(1.75, "dashed_yellow")]


@pytest.mark.parametrize(
    ("paint", "pieces", "colour"),
    [
        ("solid_white", 1, "line_white"),
        ("dashed_yellow", 5, "line_yellow"),
        ("double_yellow", 2, "line_yellow"),
    ],
)
def test_paint_decides_pieces_and_colour(paint, pieces, colour):
    line = np.array([[0.0, 0, 0], [60, 0, 0]])
    segments = prepare_map(LaneMap({}, markings=(Marking(line, paint),))).segments
    assert len(segments.ends) == pieces
    assert segments.style[:, 2:].tolist() == [list(COLOURS[colour])] * pieces
    if paint == "double_yellow":  # the left one first
        assert segments.ends[:, 0, 1].tolist() == pytest.approx([0.1, -0.1])


@settings(max_examples=examples(60), deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-5, 5)), min_size=2, max_size=8
    ),
    st.floats(0.3, 4),
    st.floats(0.1, 9),
)
def test_dashes_lie_on_their_line_and_are_as_long_as_they_should(points, on, off):
    line = np.array(points)
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    pieces = cut_dashes(line, on, off)
    lengths = [np.linalg.norm(np.diff(piece, axis=0), axis=1).sum() for piece in pieces]
    full, rest = divmod(length, on + off)
    assert sum(lengths) == pytest.approx(
        full * on + min(rest, on), abs=1e-6 * max(length, 1) + 1e-6 * len(pieces)
    )
    for piece in pieces:
        for p in piece:
            a = line[:-1]
            b = line[1:]
            d2 = np.maximum(np.sum((b - a) ** 2, axis=1), 1e-300)
            f = np.clip(np.sum((p - a) * (b - a), axis=1) / d2, 0, 1)
            assert np.linalg.norm(p - (a + f[:, None] * (b - a)), axis=1).min() < 1e-6


RINGS = {
    "square": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "clockwise": [(0, 0), (0, 1), (1, 1), (1, 0)],
    "arrow": [(0, 0), (4, 2), (0, 4), (1, 2)],
    "comb": [
        (0, 0),
        (7, 0),
        (7, 3),
        (6, 3),
        (6, 1),
        (4, 1),
        (4, 3),
        (3, 3),
        (3, 1),
        (1, 1),
        (1, 3),
        (0, 3),
    ],
    "straight corners": [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)],
    "touching itself": [(0, 0), (2, 0), (1, 1), (2, 2), (0, 2), (1, 1)],
}


def filled(ring):
    """Triangles of a ring ``(N, 2)`` at height ``x + 2 y``, which every corner must keep."""
    triangles = triangulate("area", np.column_stack([ring, ring @ [1.0, 2.0]]))
    assert triangles[..., 2] == pytest.approx(triangles[..., :2] @ [1.0, 2.0])
    return [shapely.Polygon(t) for t in triangles[..., :2]]


@pytest.mark.parametrize("name", RINGS)
def test_triangles_fill_the_ring_exactly(name):
    ring = np.array(RINGS[name], dtype=float)
    parts = filled(ring)
    assert len(parts) == len(ring) - 2 - 2 * (name == "touching itself")
    whole = shapely.make_valid(shapely.Polygon(ring))
    assert sum(p.area for p in parts) == pytest.approx(whole.area)
    assert (
        shapely.union_all([p for p in parts if p.area > 0]).symmetric_difference(whole).area < 1e-9
    )


@settings(max_examples=examples(60), deadline=None)
@given(st.lists(st.floats(0.3, 5.0), min_size=3, max_size=14))
def test_star_shaped_rings_are_filled(radii):
    angle = np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle)]) * np.array(radii)[:, None]
    area = sum(triangle.area for triangle in filled(ring))
    assert area == pytest.approx(shapely.Polygon(ring).area, rel=1e-9)


def test_labels_are_found_in_any_case():
    assert [box_class(k) for k in ("Car", "heavy_truck", "Person", "RIDER", "cone")] == [
        "car",
        "truck",
        "pedestrian",
        "cyclist",
        "other",
    ]


def test_each_lobe_of_a_ring_that_crosses_itself_is_filled():
    ring = np.array([(0, 0), (2, 2), (2, 0), (0, 2.0)])
    assert sum(triangle.area for triangle in filled(ring)) == pytest.approx(2.0)
