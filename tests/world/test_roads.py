"""Procedural roads: valid lanes, no seams, shared edges, and a main road that runs through."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.world.road_strip import Curve, Intersection, LaneTaper, Profile
from alpasim_plugin.world.roads import build_road, polyline
from tests.examples import examples

TOWN = [
    Curve(60),
    Curve(30, 0, 0.02),
    Curve(40, 0.02, 0.02),
    Curve(30, 0.02, 0),
    LaneTaper("merge", 50),
    Curve(20),
    Intersection("left"),
    Curve(50),
    LaneTaper("split", 40),
    Curve(40),
    Intersection("right", ("right", "straight"), cross_lanes=2),
    Curve(40),
]
PROFILES = {
    "street": Profile(1, 1),
    "wide": Profile(3, 2, median_m=4.0, shoulder_m=2.0),
    "one-way": Profile(2, 0, parking_m=2.2),
    "parking": Profile(2, 1, parking_m=2.2),
}


def polygon(lane):  # type: ignore[no-untyped-def]
    return shapely.Polygon(np.concatenate([lane.left, lane.right[::-1]])[:, :2])


def assert_sound(lane_map):
    for lane in lane_map.lanes.values():
        assert polygon(lane).is_valid, lane.lane_id
        assert polygon(lane).area > 1.0
        middle = lane.centre[len(lane.centre) // 2, :2]
        assert polygon(lane).covers(shapely.Point(middle)), lane.lane_id
        for successor in lane.successors:
            after = lane_map.lanes[successor]
            for name in ("centre", "left", "right"):
                assert (getattr(lane, name)[-1] == getattr(after, name)[0]).all(), (
                    lane.lane_id,
                    successor,
                    name,
                )
        for mine, theirs, neighbour in (
            ("left", "right", lane.left_neighbour),
            ("right", "left", lane.right_neighbour),
        ):
            if neighbour is not None:
                assert getattr(lane, mine) is getattr(lane_map.lanes[neighbour], theirs), (
                    lane.lane_id,
                    neighbour,
                )
    for area in lane_map.drivable_areas:
        assert shapely.Polygon(area[:, :2]).is_valid


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("turn", ["left", "straight", "right"])
def test_lanes_are_valid_and_meet_exactly_for_every_profile_and_turn(name, turn):
    elements = [
        Curve(40),
        Curve(20, 0, 0.015),
        Curve(30, 0.015, 0.0),
        Intersection(turn, cross_lanes=2),
        Curve(40),
    ]
    road = build_road(elements, PROFILES[name])
    assert_sound(road.lane_map)
    chain = road.forward_chain(PROFILES[name].forward - 1 if turn == "right" else 0)
    assert len(chain) == len(elements)


def test_a_town_with_merge_split_and_two_junctions_is_sound():
    road = build_road(TOWN, Profile(2, 1, shoulder_m=0.5))
    assert_sound(road.lane_map)
    assert len(road.forward_chain(0)) == 10, (
        "lane 0 goes straight on at the second junction, the road turns right"
    )
    assert [lane for lane, _ in road.forward_chain(1)][4:6] == ["s4_merge", "s5_f0"]
    assert len(road.backward_chain(0)) == len(TOWN)


def test_no_seam_between_consecutive_stretches():
    road = build_road(
        [Curve(30), Curve(25, 0, 0.03), Curve(25, 0.03, -0.03), Curve(30, -0.03, 0)], Profile(2, 2)
    )
    whole = shapely.union_all([polygon(lane) for lane in road.lane_map.lanes.values()])
    assert whole.geom_type == "Polygon"
    assert len(whole.interiors) == 0
    along = polyline(road.lane_map, [i for i, _ in road.forward_chain(0)])
    steps = np.linalg.norm(np.diff(along[:, :2], axis=0), axis=1)
    assert steps.max() < 1.2
    assert steps.min() > 0.5


def test_road_edges_never_cross_the_main_roads_lanes():
    road = build_road(TOWN, Profile(2, 1, shoulder_m=0.5))
    middle = shapely.LineString(
        polyline(road.lane_map, [i for i, _ in road.forward_chain(1)])[:, :2]
    )
    for edge in road.lane_map.road_edges:
        assert not middle.crosses(shapely.LineString(edge[:, :2]))


def test_left_turn_leads_from_inner_to_inner_lane_and_right_turn_from_outer_to_outer():
    road = build_road(
        [Curve(40), Intersection("straight", cross_lanes=2), Curve(40)], Profile(2, 2)
    )
    ids = set(road.lane_map.lanes)
    assert {
        "s1_entry0_left0",
        "s1_entry1_right1",
        "s1_entry0_straight0",
        "s1_entry1_straight1",
    } <= ids
    assert "s1_entry1_left1" not in ids
    assert set(road.lane_map.lanes["s0_f0"].successors) == {
        "s1_entry0_left0",
        "s1_entry0_straight0",
    }


def test_stop_lines_and_crosswalks_lie_across_their_arms():
    lane_map = build_road(
        [Curve(60), Intersection("straight"), Curve(60)], Profile(1, 1, shoulder_m=0.5)
    ).lane_map
    assert len(lane_map.crosswalks) == 4
    assert len(lane_map.stop_lines) == 4
    first = min(lane_map.stop_lines, key=lambda line: float(np.hypot(*line[0, :2])))
    assert first[:, 0] == pytest.approx(
        [55.0, 55.0]
    )  # 1 m behind the crosswalk, which begins 1 m from the border at 60 m
    assert sorted(first[:, 1]) == pytest.approx([-3.5, 0.0])  # across the arriving lane only
    ring = lane_map.crosswalks[0]
    assert (ring[0] == ring[-1]).all()
    assert shapely.Polygon(ring[:, :2]).area == pytest.approx(3.0 * 8.0)


@pytest.mark.parametrize(
    ("elements", "profile", "text"),
    [
        ([], Profile(), "not a straight, arc or clothoid"),
        ([Intersection()], Profile(), "not a straight, arc or clothoid"),
        ([Curve(30), Intersection()], Profile(), "an intersection ends the road"),
        ([Curve(30), Intersection(), Intersection(), Curve(9)], Profile(), "two intersections"),
        ([Curve(30), LaneTaper("merge", 30)], Profile(1, 1), "a merge needs two forward lanes"),
        ([Curve(30, 0.14, 0.14)], Profile(2, 2), "its inner edge would fold"),
        (
            [Curve(30), Intersection("left", ("right",)), Curve(9)],
            Profile(),
            "turn: left, but the arms are right",
        ),
    ],
)
def test_impossible_roads_are_refused(elements, profile, text):  # type: ignore[type-arg]
    with pytest.raises(InputError) as e:
        build_road(elements, profile)
    assert text in str(e.value)


@settings(deadline=None, max_examples=examples(25))
@given(
    st.lists(st.tuples(st.floats(5, 60), st.floats(-0.04, 0.04)), min_size=1, max_size=6),
    st.integers(1, 4),
    st.integers(0, 3),
    st.floats(0, 3),
    st.floats(-3.0, 3.0),
)
def test_any_winding_road_is_sound(bends, forward, backward, shoulder, heading):
    elements = []
    before = 0.0
    for length, curvature in bends:
        elements.append(Curve(length, before, curvature))
        before = curvature
    profile = Profile(forward, backward, shoulder_m=shoulder)
    if 0.04 * max(profile.left_extent_m(), profile.right_extent_m()) > 0.85:
        profile = Profile(1, 1, shoulder_m=shoulder)
    road = build_road(elements, profile, (100.0, -50.0, heading))
    for lane in road.lane_map.lanes.values():
        for successor in lane.successors:
            assert (lane.centre[-1] == road.lane_map.lanes[successor].centre[0]).all()
        assert (
            polygon(lane).is_valid or not polygon(lane).is_simple
        )  # a lane may cross itself after a full turn


def test_oncoming_lane_runs_the_other_way_on_the_left():
    lane_map = build_road([Curve(30)], Profile(1, 1, lane_width_m=3.0)).lane_map
    assert_allclose(lane_map.lanes["s0_f0"].centre[[0, -1], :2], [[0, -1.5], [30, -1.5]])
    assert_allclose(lane_map.lanes["s0_b0"].centre[[0, -1], :2], [[30, 1.5], [0, 1.5]])


def test_t_junction_closes_the_missing_side():
    road = build_road(
        [Curve(40), Intersection("left", ("left", "right")), Curve(40)], Profile(1, 1)
    )
    assert not any("straight" in i for i in road.lane_map.lanes)
    assert_sound(road.lane_map)
    borders = shapely.union_all([shapely.LineString(e[:, :2]) for e in road.lane_map.road_edges])
    beyond = shapely.LineString([(45.0, 0.0), (80.0, 0.0)])  # straight on at the T
    assert borders.intersects(beyond)


def test_merging_lane_ends_exactly_on_its_neighbour():
    road = build_road([Curve(30), LaneTaper("merge", 60), Curve(30)], Profile(3, 0))
    slant = road.lane_map.lanes["s1_merge"]
    after = road.lane_map.lanes["s2_f1"]
    assert slant.successors == ("s2_f1",)
    assert road.lane_map.lanes["s1_f1"].successors == ("s2_f1",)
    assert slant.right is not None
    assert after.right is not None
    assert (slant.right[-1] == after.right[0]).all()
