"""Off the road: the paper's rule on hand-made roads, and the array evaluation against the
step-by-step twin.
"""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.types import Lane
from evaluators import PRESETS, rollout_values, score
from evaluators.metrics.footprint import ego_footprints, origin_of
from evaluators.metrics.offroad import containment
from evaluators.metrics.road import road_of
from tests.evaluators.eval_build import (
    TWO_LANES,
    by_name,
    lane,
    road_map,
    rollout,
    scene,
    scored,
    track,
    values_of,
)
from tests.evaluators.reference import convex_contains
from tests.evaluators.reference_rules import ego_corners, road_by_step
from tests.examples import examples

PAPER = PRESETS["paper"]
HALF_W = 0.94


def offroad_of(log, lane_map):
    return scored(log, lane_map, "paper")["offroad"]


def held(log, lane_map, preset=PAPER):
    where = scene(lane_map, log)
    origin = origin_of(where.ego_log, PAPER)
    road = road_of(lane_map, origin, preset)
    centres = log.ego.xyz - origin
    below_m = log.ego_box.height_m / 2
    return containment(road, ego_footprints(log, preset, origin), centres, below_m)


def edge_line(y, x0=-50.0, z=0.0):
    return np.array([[x0, y, z], [200.0, y, z]])


def test_ego_inside_one_lane_is_on_road():
    log = rollout(track([0.0, 1.0], 0.5))
    assert held(log, TWO_LANES).in_one.tolist() == [True, True]
    assert offroad_of(log, TWO_LANES).value.tolist() == [0.0, 0.0]


def test_ego_straddling_two_lanes_is_on_road():
    log = rollout(track(0.0, [1.75, 1.2]))
    assert held(log, TWO_LANES).in_one.tolist() == [False, False]
    assert held(log, TWO_LANES).in_union.tolist() == [True, True]
    assert offroad_of(log, TWO_LANES).value.tolist() == [0.0, 0.0]


def test_ego_across_three_lanes_is_on_road():
    lanes = road_map(
        lane("a", -2.0, 1.0),
        lane("b", 0.0, 1.0),
        lane("c", 2.0, 1.0),
        edges=[edge_line(3.0), edge_line(-3.0)],
    )
    log = rollout(track(0.0, 0.0, yaw=np.pi / 2))  # 4.855 m across 6 m of lanes
    assert held(log, lanes).in_union.tolist() == [True]
    assert offroad_of(log, lanes).value.tolist() == [0.0]


def test_leaving_the_lanes_onto_the_edge_is_off_road():
    log = rollout(track(0.0, [0.0, -0.8, -0.82]))
    # The right edge lies at -1.75: the ego's side reaches it from y = -0.81 on.
    assert offroad_of(log, TWO_LANES).value.tolist() == [0.0, 0.0, 1.0]


def test_touching_the_lane_border_from_inside_is_on_road():
    log = rollout(track(0.0, -1.75 + HALF_W))
    origin = origin_of(scene(TWO_LANES, log).ego_log, PAPER)
    ring = np.array([[-50, -1.75], [200, -1.75], [200, 1.75], [-50, 1.75]]) - origin[:2]
    assert held(log, TWO_LANES).in_one.tolist() == [
        convex_contains(ring, ego_corners(log, PAPER, 0, origin))
    ]
    # Inside, the road edge half a millimetre away does not matter; outside it does.
    assert offroad_of(rollout(track(0.0, -1.75 + HALF_W + 1e-6)), TWO_LANES).value.tolist() == [0.0]
    assert offroad_of(rollout(track(0.0, -1.75 + HALF_W - 1e-6)), TWO_LANES).value.tolist() == [1.0]


@pytest.mark.parametrize(("gap_m", "off"), [(0.0, 1.0), (0.0009, 1.0), (0.0011, 0.0), (0.5, 0.0)])
def test_outside_the_lanes_the_road_edge_decides_at_one_millimetre(gap_m, off):
    # The lane is too narrow to hold the ego; the edge runs beside it.
    narrow = road_map(lane("a", 0.0, 0.5), edges=[edge_line(-HALF_W - gap_m)])
    assert offroad_of(rollout(track(0.0, 0.0)), narrow).value.tolist() == [off]


def test_far_beyond_the_edge_nothing_is_touched_and_the_step_counts_as_on_road():
    assert offroad_of(rollout(track(0.0, [-1.5, -30.0])), TWO_LANES).value.tolist() == [1.0, 0.0]


def test_after_the_edge_was_crossed_the_later_steps_do_not_count():
    log = rollout(track(0.0, [0.0, -1.5, -30.0, -60.0]), log=track([0.0, 1.0, 2.0, 3.0], 0.0))
    values = values_of(log, preset="paper")
    assert values["offroad"].value == 1.0
    assert values["dist_to_gt_trajectory"].value == pytest.approx(1.5)


def test_a_lane_without_an_edge_is_its_centre_with_a_half_width_of_185_cm():
    bare = road_map(lane("a", 0.0, left=None), edges=[edge_line(-1.85), edge_line(1.85)])
    for y, off in ((0.9, 0.0), (0.92, 1.0), (-0.9, 0.0), (-0.92, 1.0)):  # 0.94 + 0.91 = 1.85
        assert offroad_of(rollout(track(0.0, y)), bare).value.tolist() == [off]


def test_a_lane_whose_centre_is_farther_than_six_metres_is_not_looked_at():
    wide = road_map(lane("a", 0.0, 20.0), edges=[edge_line(-30.0), edge_line(6.2)])
    log = rollout(track(0.0, [5.9, 6.1]))
    assert held(log, wide).near.tolist() == [[True], [False]]
    assert offroad_of(log, wide).value.tolist() == [0.0, 1.0]


def test_the_radius_counts_in_height_too_and_between_vertices():
    one = road_map(lane("a", 0.0), edges=[edge_line(9.0)])  # vertices at x = -50 and 200 only
    log = rollout(track(60.0, 0.0, z=[0.8, 5.9, 6.1]))
    assert held(log, one).near[:, 0].tolist() == [True, True, False]
    vertices = replace(PAPER, lane_query="vertices")
    assert held(log, one, vertices).near[:, 0].tolist() == [False, False, False]


def test_a_road_edge_of_a_bridge_overhead_does_not_count():
    narrow = road_map(lane("a", 0.0, 0.5), edges=[edge_line(0.0, z=5.0), edge_line(40.0)])
    assert offroad_of(rollout(track(0.0, 0.0, z=0.8)), narrow).value.tolist() == [0.0]
    assert offroad_of(rollout(track(0.0, 0.0, z=4.5)), narrow).value.tolist() == [1.0]


def test_without_lanes_every_road_metric_is_invalid_and_never_zero():
    log = rollout(track([0.0, 1.0], 0.0))
    found = scored(log, road_map(edges=[edge_line(0.0)]), "paper")
    for name in ("offroad", "wrong_lane", "min_distance_to_lane_boundary_m"):
        assert not found[name].valid.any()
        assert np.isnan(found[name].value).all()
        assert found[name].reason == "the map has no lanes"
    value = rollout_values(list(found.values()))["offroad"]
    assert value.value is None
    assert not value.valid


def test_a_road_edge_that_is_needed_but_missing_makes_the_step_invalid():
    no_edges = road_map(lane("a", 0.0))
    log = rollout(track(0.0, [0.0, 3.0, 0.0]))
    found = offroad_of(log, no_edges)
    assert found.valid.tolist() == [True, False, True]
    assert found.reason == "no lane contains the footprint and the map has no road edges to decide"
    value = values_of(log, no_edges, "paper")["offroad"]
    assert (value.value, value.valid) == (None, False)
    inside = rollout(track(0.0, [0.0, 0.1]))
    assert values_of(inside, no_edges, "paper")["offroad"].value == 0.0


def test_driving_against_the_lane_is_wrong_and_a_shared_junction_is_not():
    log = rollout(track([0.0, -1.0], 0.0, yaw=np.pi))
    found = scored(log, preset="paper")["wrong_lane"]
    assert found.value.tolist() == [1.0, 1.0]
    back = Lane("back", np.array([[200.0, 0.0, 0.0], [-50.0, 0.0, 0.0]]), None, None)
    shared = road_map(lane("there", 0.0), back)
    assert scored(log, shared, "paper")["wrong_lane"].value.tolist() == [
        0.0,
        0.0,
    ]
    opposing = replace(PAPER, wrong_lane_rule="any_opposes")
    assert scored(log, shared, opposing)["wrong_lane"].value.tolist() == [
        1.0,
        1.0,
    ]


@pytest.mark.parametrize("yaw", [np.pi, -np.pi, np.pi - 1e-9, -np.pi + 1e-9])
def test_driving_along_minus_x_in_a_lane_along_minus_x_is_right(yaw):
    west = Lane("west", np.array([[100.0, 0.0, 0.0], [-100.0, -1e-9, 0.0]]), None, None)
    log = rollout(track(0.0, 0.0, yaw=yaw))
    assert scored(log, road_map(west), "paper")["wrong_lane"].value.tolist() == [0.0]


def test_reversed_right_edge_is_repaired_to_its_two_triangles():
    crossed = lane("a", 0.0, right=np.array([[200.0, -1.75, 0.0], [-50.0, -1.75, 0.0]]))
    # The ring crosses itself at x = 75, y = 0: on the left of it two triangles meet the left edge
    # only near the ends.
    log = rollout(track([-40.0, 75.0], [0.0, 0.0]))
    where = scene(road_map(crossed), log)
    area = road_of(where.lane_map, origin_of(where.ego_log, PAPER), PAPER).areas(np.array([0]))[0]
    assert shapely.is_valid(area)
    assert area.area == pytest.approx(250 * 3.5 / 2)
    assert held(log, where.lane_map).in_one.tolist() == [False, False]


def test_lane_rings_in_either_turning_direction_hold_the_ego():
    swapped = lane("a", 0.0, left=edge_line(-1.75), right=edge_line(1.75))
    assert held(rollout(track(0.0, 0.0)), road_map(swapped)).in_one.tolist() == [True]


def test_a_lane_without_area_holds_nothing_and_harms_nothing():
    needle = lane("needle", 0.0, left=edge_line(0.0), right=edge_line(0.0))
    point = Lane("point", np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)))
    lanes = road_map(needle, point, lane("b", 0.0), edges=[edge_line(9.0)])
    assert held(rollout(track(0.0, 0.0)), lanes).in_union.tolist() == [True]


def test_utm_sized_coordinates_give_the_same_flags():
    shift = np.array([691_000.0, 5_334_000.0, 500.0])
    far = road_map(
        *(
            replace(one, centre=one.centre + shift, left=one.left + shift, right=one.right + shift)
            for one in TWO_LANES.lanes.values()
        ),
        edges=[edge + shift for edge in TWO_LANES.road_edges],
    )
    ys = np.array([0.0, 0.8, 1.75, -0.8, -0.82, 4.3, 4.4])
    near_log = rollout(track(0.0, ys))
    far_log = rollout(track(shift[0], ys + shift[1], z=shift[2]))
    assert offroad_of(far_log, far).value.tolist() == offroad_of(near_log, TWO_LANES).value.tolist()


half_metre = st.integers(-8, 8).map(lambda k: k / 2)


@st.composite
def roads(draw):
    lanes = []
    edges = []
    y = -4.0
    for k in range(draw(st.integers(1, 4))):
        width = draw(st.sampled_from([1.88, 2.0, 3.5]))
        seam = draw(st.sampled_from([0.0, 0.0, 0.002, -0.5]))
        bend = draw(st.sampled_from([0.0, 0.5, 3.0]))
        xs = np.array([-30.0, -5.0, 0.0, 12.0, 30.0])

        def line(at, bend=bend, xs=xs):
            return np.stack([xs, at + bend * np.sin(xs / 9), np.zeros(5)], axis=1)

        left = line(y + width)
        right = line(y)
        kind = draw(st.sampled_from(["both", "both", "none", "reversed"]))
        left, right = {
            "both": (left, right),
            "none": (None, right),
            "reversed": (left, right[::-1]),
        }[kind]
        lanes.append(Lane(f"l{k}", line(y + width / 2), left, right))
        if draw(st.booleans()):
            edges.append(line(y + draw(st.sampled_from([0.0, width]))))
        y += width + seam
    return road_map(*lanes, edges=edges)


@settings(max_examples=examples(120), deadline=None)
@given(
    roads(),
    st.lists(
        st.tuples(half_metre, half_metre, st.sampled_from([0.0, np.pi, -np.pi, 0.3, np.pi / 2])),
        min_size=1,
        max_size=4,
    ),
    st.sampled_from([0.0, 4_000_000.0]),
)
def test_array_evaluation_and_twin_agree_on_hard_roads(lane_map, poses, offset):
    x, y, yaw = (np.array(column) for column in zip(*poses, strict=True))
    shift = np.array([offset, -offset, 0.0])
    if offset:
        move = lambda points: None if points is None else points + shift  # noqa: E731
        lane_map = road_map(
            *(
                replace(one, centre=move(one.centre), left=move(one.left), right=move(one.right))
                for one in lane_map.lanes.values()
            ),
            edges=[edge + shift for edge in lane_map.road_edges],
        )
    log = rollout(track(x + offset, y - offset, yaw=yaw, z=0.8))
    where = scene(lane_map, log)
    slow = road_by_step(log, where, PAPER)
    fast = offroad_of(log, lane_map)
    assert [None if not ok else bool(v) for v, ok in zip(fast.value, fast.valid, strict=True)] == [
        one.offroad for one in slow
    ]
    gap = by_name(score(log, where, "paper"))["min_distance_to_lane_boundary_m"].value
    assert_allclose(gap, [one.boundary_gap_m for one in slow], atol=1e-9)
    assert (held(log, lane_map).in_one | held(log, lane_map).in_union).tolist() == [
        one.on_road for one in slow
    ]


@settings(max_examples=examples(80), deadline=None)
@given(st.floats(-1e-12, 1e-12), st.floats(0.0, 2 * np.pi))
def test_a_footprint_on_the_lane_border_flips_only_next_to_it(nudge, turn):
    """The road turned as a whole; the exact twin decides on the same rounded corners."""
    c = np.cos(turn)
    s = np.sin(turn)
    spin = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    one = lane("a", 0.0)
    turned = replace(
        one, centre=one.centre @ spin.T, left=one.left @ spin.T, right=one.right @ spin.T
    )
    at = spin @ np.array([3.0, 1.75 - HALF_W + nudge, 0.0])
    log = rollout(track(at[0], at[1], yaw=turn))
    origin = origin_of(scene(road_map(turned), log).ego_log, PAPER)
    ring = np.concatenate([turned.left[:, :2], turned.right[::-1, :2]]) - origin[:2]
    assert held(log, road_map(turned)).in_one.tolist() == [
        convex_contains(ring, ego_corners(log, PAPER, 0, origin))
    ]


def test_unions_are_kept_for_the_next_rollout_and_not_mixed_between_maps():
    log = rollout(track(np.linspace(0, 20, 30), 1.75))
    first = offroad_of(log, TWO_LANES).value
    other = road_map(
        lane("right", 0.0), lane("left", 9.0), edges=(*TWO_LANES.road_edges, edge_line(1.75))
    )
    assert offroad_of(log, other).value.tolist() == [1.0] * 30
    assert_array_equal(offroad_of(log, TWO_LANES).value, first)
