"""Preset ``strict``: the drivable surface as one shape, and the signed margin of the footprint to
its border.
"""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.geometry import rectangle_corners
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import Lane, LaneMap
from evaluators import PRESETS
from evaluators.metrics import surface
from evaluators.metrics.surface import MARGIN_M, Region, Surface, closed_union
from tests.evaluators.eval_build import (
    TWO_LANES,
    lane,
    road_map,
    rollout,
    scored,
    track,
    values_of,
)
from tests.evaluators.reference_strict import depth_by_points
from tests.examples import examples

STRICT = PRESETS["strict"]
HALF_L = 4.855 / 2
HALF_W = 1.88 / 2


def margins(log, lane_map=TWO_LANES):
    return scored(log, lane_map)["offroad_margin_m"].value


def box(x, y, yaw=0.0, size=(4.855, 1.88)):
    return rectangle_corners(np.array([[x, y]]), np.array([yaw]), np.array([size]))[0]


def test_inside_the_margin_is_the_gap_to_the_border_of_all_lanes_together():
    # Both lanes together reach from -1.75 to 5.25; the line between them is no border.
    assert margins(rollout(track(0.0, [0.0, 1.75, 4.0]))) == pytest.approx(
        [1.75 - HALF_W, 3.5 - HALF_W, 5.25 - 4.0 - HALF_W], abs=MARGIN_M
    )


def test_outside_it_is_minus_how_far_the_outermost_point_is_from_the_road_however_far_that_is():
    log = rollout(track(0.0, [-1.75, -10.0, -3_000.0]))
    found = scored(log)
    assert found["offroad_margin_m"].value == pytest.approx(
        [-HALF_W, -(10 - 1.75 + HALF_W), -(3_000 - 1.75 + HALF_W)], abs=MARGIN_M
    )
    assert found["offroad"].value.tolist() == [1, 1, 1]
    # The paper's rule asks for a touched road edge and calls the last two on the road.
    assert scored(log, preset="paper")["offroad"].value.tolist() == [1, 0, 0]


def test_beyond_the_end_of_the_map():
    assert margins(rollout(track(220.0, 0.0))) == pytest.approx([-(20.0 + HALF_L)], abs=MARGIN_M)


def test_the_margin_goes_through_zero_without_a_jump():
    y = -1.75 + HALF_W + np.array([0.2, 1e-3, 1e-5, 0.0, -1e-5, -1e-3, -0.2])
    assert margins(rollout(track(0.0, y))) == pytest.approx(y + 1.75 - HALF_W, abs=MARGIN_M)
    flags = scored(rollout(track(0.0, y)))["offroad"].value
    assert flags.tolist() == [0, 0, 0, 0, 1, 1, 1]


def test_ego_straddling_three_lanes_is_on_the_road():
    lanes = road_map(*(lane(f"l{k}", 0.6 * k, half_width=0.3) for k in range(-3, 4)))
    assert margins(rollout(track(0.0, 0.0)), lanes) == pytest.approx([2.1 - HALF_W], abs=MARGIN_M)


@pytest.mark.parametrize(
    ("gap_m", "closed"),
    [
        (1e-9, True),
        (1e-5, True),
        (0.002, True),
        (0.05, True),
        (0.1, True),
        (0.11, False),
        (0.5, False),
    ],
)
def test_seams_up_to_a_tenth_of_a_metre_are_closed_and_wider_ones_are_not(gap_m, closed):
    lanes = road_map(lane("right", 0.0), lane("left", 3.5 + gap_m))
    found = margins(rollout(track(0.0, 1.75 + gap_m / 2)), lanes)[0]
    # An open gap is left halfway to either side.
    assert found == pytest.approx(3.5 + gap_m / 2 - HALF_W if closed else -gap_m / 2, abs=MARGIN_M)


def test_closing_leaves_the_outer_border_where_the_map_has_it():
    bend = np.array([[20 * math.cos(a), 20 * math.sin(a), 0.0] for a in np.linspace(0, 2, 15)])
    grow = lambda r: np.column_stack([bend[:, :2] * r / 20, bend[:, 2]])  # noqa: E731
    areas = np.array(
        [
            lane_polygon(Lane(k, bend, grow(a), grow(b)))
            for k, a, b in (("in", 16, 19.98), ("out", 20.02, 24))
        ],
        dtype=object,
    )
    joined = closed_union(areas, 0.1)
    plain = shapely.union_all(areas)
    added = shapely.difference(joined, plain)
    assert shapely.area(added) == pytest.approx(0.04 * 20 * 2, rel=0.02)
    # Everything thicker than the grid's rounding that was added lies between the lanes.
    thick = shapely.get_coordinates(shapely.buffer(added, -1e-5))
    assert len(thick)
    assert np.all(np.abs(np.hypot(*thick.T) - 19.9) < 0.2)


def test_a_wide_gap_between_parallel_lanes_costs_half_its_width_under_the_car():
    lanes = road_map(lane("right", 0.0), lane("left", 4.5))
    assert margins(rollout(track(0.0, 2.25)), lanes) == pytest.approx([-0.5], abs=MARGIN_M)


@pytest.mark.parametrize("x", [24.5, 25.003, 25.093, 25.9])
def test_a_nose_across_a_wide_gap_is_settled_in_a_few_pieces(monkeypatch, x):
    """Halfway between two parallel borders the distance is the same along a whole line, which no
    corner of a piece need meet.
    """
    region = Region(
        shapely.MultiPolygon([shapely.box(0, -1.75, 24, 1.75), shapely.box(26, -1.75, 60, 1.75)])
    )
    quartered = []
    cut = surface._quartered
    monkeypatch.setattr(
        surface,
        "_quartered",
        lambda owner, pieces: quartered.append(len(owner)) or cut(owner, pieces),
    )
    assert region.margin_m(np.array([shapely.box(x - 4.8, -1.05, x, 1.05)])) == pytest.approx(
        [-min(x - 24.0, 1.0)], abs=MARGIN_M
    )
    assert sum(quartered) < 20


def test_a_hole_under_the_car_counts_although_all_corners_are_on_the_road():
    hole = shapely.Polygon(
        [(-20, -20), (20, -20), (20, 20), (-20, 20)],
        [[(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]],
    )
    region = Region(hole)
    assert region.margin_m(np.array([shapely.Polygon(box(0.1, 0.0))])) == pytest.approx(
        [-0.5], abs=MARGIN_M
    )


def test_a_bridge_above_does_not_carry_the_ego():
    below = lane("below", 0.0)
    height = 6.0
    cross = np.array([[0.0, -50.0, height], [0.0, 50.0, height]])
    above = Lane(
        "above", cross, cross - np.array([2.0, 0.0, 0.0]), cross + np.array([2.0, 0.0, 0.0])
    )
    lanes = road_map(below, above)
    # Under the bridge, off the lower road.
    assert margins(rollout(track(0.0, 5.0, z=0.8)), lanes) == pytest.approx(
        [-(5.0 - 1.75 + HALF_W)], abs=MARGIN_M
    )
    # On the bridge.
    assert margins(
        rollout(track(0.0, 10.0, yaw=math.pi / 2, z=height + 0.8)), lanes
    ) == pytest.approx([2.0 - HALF_W], abs=MARGIN_M)


def test_above_every_road_the_ego_is_off_the_road_by_no_number():
    found = scored(rollout(track(0.0, 0.0, z=40.0)))
    assert found["offroad"].value.tolist() == [1]
    assert not found["offroad_margin_m"].valid.any()
    assert found["offroad_margin_m"].reason == "nothing drivable is on the ego's level"


def test_a_road_that_climbs_is_one_road():
    n = 60
    climb = np.array([[5.0 * k, 0.0, 0.6 * k] for k in range(n)])
    lanes = LaneMap(
        {
            "hill": Lane(
                "hill", climb, climb + np.array([0, 1.75, 0]), climb - np.array([0, 1.75, 0])
            )
        }
    )
    log = rollout(track(climb[5:-5, 0], 0.0, z=climb[5:-5, 2] + 0.8))
    assert margins(log, lanes) == pytest.approx(np.full(n - 10, 1.75 - HALF_W), abs=MARGIN_M)


def test_drivable_areas_count_beside_lanes():
    ring = np.array(
        [[-10.0, -8.0, 0.0], [10.0, -8.0, 0.0], [10.0, -1.75, 0.0], [-10.0, -1.75, 0.0]]
    )
    lanes = LaneMap(TWO_LANES.lanes, TWO_LANES.road_edges, (ring,))
    assert margins(rollout(track(0.0, -5.0)), lanes) == pytest.approx([3.0 - HALF_W], abs=MARGIN_M)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (691_608.25, 5_334_760.75)])
def test_self_crossing_reversed_needle_and_empty_rings(offset):
    shift = np.array([*offset, 0.0])
    line = lambda *points: np.array([[*p, 0.0] for p in points]) + shift  # noqa: E731
    centre = line((-20, 0), (20, 0))
    good = Lane("good", centre, line((-20, 2), (20, 2)), line((-20, -2), (20, -2)))
    lanes = {
        "good": good,
        "reversed": Lane(
            "reversed", centre, good.left, good.right[::-1]
        ),  # crosses itself: a bow tie
        "swapped": Lane("swapped", centre, good.right, good.left),
        "needle": Lane("needle", centre, line((-20, 2), (20, 2)), line((-20, 2), (20, 2))),
        "spike": Lane("spike", centre, line((-20, 2), (0, 2), (0, 9), (0, 2), (20, 2)), good.right),
    }
    log = rollout(track(offset[0] + np.array([0.0, 0.0]), offset[1] + np.array([0.5, 5.0])))
    # None of the odd rings adds area outside the good one; the spike is a line without area.
    assert margins(log, LaneMap(lanes)) == pytest.approx(
        [2 - 0.5 - HALF_W, -(5 + HALF_W - 2)], abs=MARGIN_M
    )
    with pytest.raises(EvaluatorError, match="no lane of the map has an area"):
        margins(log, LaneMap({"needle": lanes["needle"]}))


def test_no_map_is_an_error_that_says_what_to_do():
    log = rollout(track([0.0, 1.0], 0.0))
    with pytest.raises(EvaluatorError, match="no lanes") as caught:
        scored(log, LaneMap({}))
    assert "preset" in caught.value.hint
    assert caught.value.exit_code == 5


def test_heading_at_180_degrees_is_not_a_wrong_lane():
    west = Lane(
        "west",
        np.array([[50.0, 0, 0], [-50, 0, 0]]),
        np.array([[50.0, -1.75, 0], [-50, -1.75, 0]]),
        np.array([[50.0, 1.75, 0], [-50, 1.75, 0]]),
    )
    for yaw in (math.pi, -math.pi, 3.1, -3.1):
        assert scored(rollout(track([10.0, 9.0], 0.0, yaw=yaw)), road_map(west))[
            "wrong_lane"
        ].value.tolist() == [0, 0]


def test_the_rollout_value_is_the_least_margin_of_the_scored_steps_and_off_road_ends_it():
    log = rollout(track(np.arange(4.0), [0.0, -0.5, -1.0, -2.0]))
    values = values_of(log, preset=STRICT)
    assert values["offroad_margin_m"].value == pytest.approx(1.75 - 1.0 - HALF_W, abs=MARGIN_M)
    assert values["offroad"].value == 1.0


# --- reference

COORDINATE = st.one_of(st.integers(-8, 8).map(float), st.floats(-8, 8))


@st.composite
def layouts(draw):
    """Overlapping, touching, gappy, reversed and self-crossing rings with a few corners."""
    rings = []
    for _ in range(draw(st.integers(1, 3))):
        points = [(draw(COORDINATE), draw(COORDINATE)) for _ in range(draw(st.integers(3, 5)))]
        rings.append(points)
    return rings


@settings(max_examples=examples(15), deadline=None, derandomize=True)
@given(layouts(), COORDINATE, COORDINATE, st.sampled_from([0.0, math.pi, math.pi / 2, 0.4, -2.0]))
def test_random_layouts_agree_with_distances_point_by_point(rings, x, y, yaw):
    areas = np.array([lane_polygon(_as_lane(ring)) for ring in rings], dtype=object)
    body = box(x, y, yaw)
    drivable = Surface(areas, [np.zeros((2, 3))] * len(rings), 0.0, 3.0)
    found = float(drivable.margin_m(np.array([shapely.Polygon(body)]), np.array([[x, y, 0.0]]))[0])
    kept = [
        list(map(tuple, shapely.get_coordinates(part)[:-1]))
        for area in areas
        for part in shapely.get_parts(area)
        if shapely.area(part) > 1e-6
    ]
    if not kept:
        assert found < -1.0 or math.isinf(found)
        return
    low, high = depth_by_points(body, kept, n=8)
    if found >= 0:
        assert low <= 2 * MARGIN_M  # no point of the footprint is outside every area
    else:
        assert low - 2 * MARGIN_M <= -found <= high + 2 * MARGIN_M


def _as_lane(ring):
    points = np.array([[*p, 0.0] for p in ring])
    return Lane(
        "l", points[:2], points[: len(points) // 2 + 1], points[len(points) // 2 + 1 :][::-1]
    )


@settings(max_examples=examples(25), deadline=None, derandomize=True)
@given(
    st.floats(-6, 6),
    st.floats(-6, 6),
    st.floats(-3.2, 3.2),
    st.sampled_from([(0.0, 0.0), (691_608.0, 5_334_760.0)]),
)
def test_moving_the_world_moves_no_margin_by_more_than_the_tolerance(x, y, yaw, offset):
    square = np.array([[-5.0, -4.0], [5.0, -4.0], [5.0, 4.0], [-5.0, 4.0]])
    here = Region(shapely.Polygon(square)).margin_m(np.array([shapely.Polygon(box(x, y, yaw))]))[0]
    # Closed form: over a convex shape the outermost corner decides; inside it is the least gap.
    out = np.maximum(np.abs(box(x, y, yaw)) - [5.0, 4.0], 0.0)
    depth = float(np.hypot(out[:, 0], out[:, 1]).max())
    want = -depth if depth > 0 else float((np.array([5.0, 4.0]) - np.abs(box(x, y, yaw))).min())
    assert here == pytest.approx(want, abs=MARGIN_M)
    lanes = {
        "l": Lane(
            "l",
            _far([[-5, 0], [5, 0]], offset),
            _far([[-5, 4], [5, 4]], offset),
            _far([[-5, -4], [5, -4]], offset),
        )
    }
    moved = margins(rollout(track(x + offset[0], y + offset[1], yaw=yaw)), LaneMap(lanes))[0]
    assert moved == pytest.approx(want, abs=MARGIN_M + 2e-9)


def _far(points, offset):
    return np.array([[px + offset[0], py + offset[1], 0.0] for px, py in points])
