from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.geometry import (
    arc_lengths,
    project,
    quat_from_yaw,
    se2,
    se3,
    yaw_from_quat,
)
from alpasim_plugin.core.types import Route, Trajectory
from alpasim_plugin.world.route import (
    LaneIndex,
    _change_cost,
    _local_costs,
    from_offset,
    match_lanes,
    route_from_log,
    route_in_rig,
)
from tests.world.small_maps import FAR, arc, make, straight


def drive(x, y=None, z=0.0):
    """A log through points, 0.1 s apart, heading along them."""
    xyz = np.column_stack([x, np.zeros_like(x) if y is None else y, np.full_like(x, z)])
    d = np.gradient(xyz[:, :2], axis=0) if len(x) > 1 else np.array([[1.0, 0.0]])
    return Trajectory(np.arange(len(x)) * 100_000, xyz, quat_from_yaw(np.arctan2(d[:, 1], d[:, 0])))


ROAD = make(
    straight("a", 0, 40, successors=("b",), left_neighbour="a2"),
    straight("b", 40, 80, successors=("turn", "c", "off the map")),
    straight("c", 80, 300),
    arc("turn", 12.0, 90.0, start=(80, 0)),
    straight("a2", 0, 80, y=3.5, right_neighbour="a"),
)


def test_route_is_the_recorded_path_and_goes_on_straight_behind_it():
    x = np.arange(5.0, 60.0, 0.5)
    log = drive(x, 0.3 * np.sin(x / 10))
    route = route_from_log(ROAD, log)
    assert route.lane_ids == ("a", "b", "c")
    for point in log.xyz:
        assert abs(project(route.xyz, point)[1]) < 1e-9
    assert arc_lengths(route.xyz)[-1] == pytest.approx(arc_lengths(log.xyz)[-1] + 120.0, abs=0.1)
    assert_allclose(route.xyz[-5:, 1], 0.0, atol=1e-9)  # back on the centre


def test_lateral_lane_change_is_named_in_order():
    x = np.arange(2.0, 70.0, 0.5)
    y = 3.5 / (1 + np.exp((x - 25) / 3))
    assert route_from_log(ROAD, drive(x, y), extension_m=0).lane_ids == ("a2", "a", "b")


def test_overlapping_lanes_of_an_intersection_are_told_apart_by_the_whole_drive():
    turn = ROAD.lanes["turn"].centre
    log = drive(
        np.concatenate([np.arange(45.0, 80), turn[:, 0]]),
        np.concatenate([np.zeros(35), turn[:, 1]]),
    )
    assert route_from_log(ROAD, log).lane_ids == ("b", "turn")
    straight_on = drive(np.arange(45.0, 100.0))
    assert route_from_log(ROAD, straight_on).lane_ids == ("b", "c")


def test_matching_agrees_with_trying_every_assignment():
    """The shortest path over samples is the best of all assignments of lanes to samples, here tried
    one by one.
    """
    index = LaneIndex(ROAD)
    path = np.column_stack([np.linspace(77, 84, 8), np.linspace(0, 0.4, 8), np.zeros(8)])
    heading = np.arctan2(0.4, 7)
    costs = [_local_costs(index, p, heading, index.containing(p)) for p in path]
    best = min(
        product(*costs),
        key=lambda names: (
            sum(c[n] for c, n in zip(costs, names, strict=True))
            + sum(_change_cost(index, a, b) for a, b in pairwise(names))
        ),
    )
    assert match_lanes(index, path, heading) == tuple(dict.fromkeys(best))


def test_drive_outside_every_lane_is_its_own_route():
    log = drive(np.arange(0.0, 30.0), np.full(30, 60.0))
    route = route_from_log(ROAD, log)
    assert route.lane_ids == ()
    assert_array_equal(route.xyz, log.xyz)


def test_car_at_rest_gets_the_lane_ahead():
    jitter = np.column_stack(
        [5.0 + 0.01 * np.random.default_rng(1).normal(size=50), np.zeros((50, 2))]
    )
    route = route_from_log(
        ROAD, Trajectory(np.arange(50) * 100_000, jitter, quat_from_yaw(np.zeros(50)))
    )
    assert route.lane_ids == ("a", "b", "c")
    assert arc_lengths(route.xyz)[-1] == pytest.approx(120.0, abs=0.2)
    assert (np.diff(route.xyz[:, 0]) > 0).all()


def test_way_points_start_at_the_projection_and_are_evenly_spaced():
    route = Route(np.array([[0.0, 0, 0], [200.0, 0, 0]]))
    seen = route_in_rig(route, se2(10.0, 2.0, 0.0))
    assert seen.shape == (20, 3)
    assert_allclose(seen[:, 0], np.arange(20) * 80 / 19, atol=1e-9)
    assert_allclose(seen[:, 1], -2.0, atol=1e-12)


def test_a_route_from_an_offset_on_begins_with_the_first_point_that_is_so_far_along_it():
    """Ten points 42.1 to 80 m ahead and ten rows of NaN, as AlpaSim's own test of its offset of 40 m
    has it (`src/runtime/tests/test_route_generator.py`, branch e2e_challenge).
    """
    whole = route_in_rig(
        Route(np.column_stack([np.arange(200.0), np.zeros((200, 2))])), se2(0, 0, 0)
    )
    cut = from_offset(whole, 40.0)
    assert_allclose(cut[:10], whole[10:])
    assert cut[0, 0] == pytest.approx(10 * 80 / 19)
    assert np.isnan(cut[10:]).all()
    assert_array_equal(from_offset(whole, 0.0), whole)


def test_a_route_that_ends_before_the_offset_has_no_points_left():
    short = route_in_rig(Route(np.column_stack([np.arange(30.0), np.zeros((30, 2))])), se2(0, 0, 0))
    assert np.isfinite(short).any()
    assert np.isnan(from_offset(short, 40.0)).all()
    assert np.isnan(from_offset(np.full((20, 3), np.nan), 40.0)).all()


def test_route_over_itself_is_followed_in_the_ego_s_direction():
    eight = np.array([[-50.0, 0, 0], [50.0, 0, 0], [50.0, 50, 0], [0.0, 50, 0], [0.0, -50, 0]])
    ahead = route_in_rig(Route(eight), se2(0.0, 0.2, 0.0))
    down = route_in_rig(Route(eight), se2(0.2, 0.0, -np.pi / 2))
    assert ahead[5, 0] == pytest.approx(5 * 80 / 19)
    assert down[5, 0] == pytest.approx(5 * 80 / 19)


def test_skidding_ego_is_not_sent_to_a_far_stretch_that_runs_its_way():
    corner = np.array([[0.0, 0, 0], [500.0, 0, 0], [500.0, 500, 0]])
    seen = route_in_rig(Route(corner), se2(100.0, 1.0, np.pi / 2))
    assert_allclose(seen[0], [-1.0, 0.0, 0.0], atol=1e-9)


def test_ego_against_the_route_sees_the_route_run_backwards():
    seen = route_in_rig(Route(np.array([[0.0, 0, 0], [200.0, 0, 0]])), se2(100.0, 0.0, np.pi))
    assert seen[3, 0] == pytest.approx(-3 * 80 / 19)


def test_extension_leaves_the_log_without_a_kink():
    x = np.arange(5.0, 60.0, 0.5)
    route = route_from_log(ROAD, drive(x, np.full_like(x, 0.9)))
    heading = np.arctan2(*np.diff(route.xyz[:, :2], axis=0).T[::-1])
    assert np.abs(np.diff(heading)).max() < 0.03
    assert np.abs(heading).max() < 0.08


def test_oncoming_lanes_are_never_the_route():
    assert route_from_log(ROAD, drive(np.arange(60.0, 5.0, -0.5))).lane_ids == ()


def test_route_ends_where_the_map_ends():
    route = route_from_log(make(straight("a", 0, 40)), drive(np.arange(5.0, 30.0)))
    assert route.xyz[-1, 0] == pytest.approx(40.0)


def test_far_maps_give_the_same_route():
    x = np.arange(5.0, 60.0, 0.5)
    log = drive(x, 0.3 * np.sin(x / 10))
    moved = Trajectory(log.t_us, log.xyz + FAR, log.quat)
    near = route_from_log(ROAD, log)
    far = route_from_log(make(*ROAD.lanes.values(), shift=FAR), moved)
    assert near.lane_ids == far.lane_ids
    assert_allclose(far.xyz - FAR, near.xyz, atol=1e-6)


def test_rows_behind_the_end_are_nan_and_only_those():
    seen = route_in_rig(
        Route(np.array([[0.0, 0, 0], [30.0, 0, 0]])), se2(10.0, 0.0, 0.0), n=10, spacing_m=4.0
    )
    assert np.isfinite(seen[:6]).all()
    assert np.isnan(seen[6:]).all()


def test_way_points_lie_level_in_a_pitched_rig():
    pitch = np.array([np.cos(0.05), 0.0, -np.sin(0.05), 0.0])
    seen = route_in_rig(
        Route(np.array([[0.0, 0, 0], [200.0, 0, 20.0]])), se3([10.0, 0.0, 1.0], pitch)
    )
    assert (seen[:, 2] == 0).all()


# Headings on both sides of 180 degrees, and one elsewhere.
TURNS = np.radians([175.0, 179.0, 184.0, 90.0])


def turned_points(points, angle):
    """Points ``(N, 3)`` turned about the vertical axis through the origin."""
    return points @ se2(0.0, 0.0, angle)[:3, :3].T


def turned_map(lane_map, angle):
    lanes = [
        replace(
            lane,
            centre=turned_points(lane.centre, angle),
            left=turned_points(lane.left, angle),
            right=turned_points(lane.right, angle),
        )
        for lane in lane_map.lanes.values()
    ]
    return make(*lanes)


@pytest.mark.parametrize("angle", [*TURNS, np.radians(179.8)])
@pytest.mark.parametrize("path", ["weaving", "slanting"])
def test_a_turned_world_has_the_same_route(angle, path):
    x = np.arange(5.0, 60.0, 0.5)
    log = drive(x, 0.3 * np.sin(x / 10) if path == "weaving" else 0.01 * (x - 30.0))
    yaw = yaw_from_quat(log.quat) + angle
    turned = Trajectory(log.t_us, turned_points(log.xyz, angle), quat_from_yaw(yaw))
    expected = route_from_log(ROAD, log)
    route = route_from_log(turned_map(ROAD, angle), turned)
    assert route.lane_ids == expected.lane_ids == ("a", "b", "c")
    assert_allclose(route.xyz, turned_points(expected.xyz, angle), atol=1e-6)


@pytest.mark.parametrize("angle", TURNS)
def test_a_bend_of_ten_degrees_is_straighter_than_a_turn_at_every_heading(angle):
    fork = make(
        straight("b", 40, 80, successors=("turn", "bend")),
        arc("bend", 100.0, 10.0, start=(80, 0)),
        arc("turn", 12.0, 90.0, start=(80, 0)),
    )
    assert LaneIndex(turned_map(fork, angle)).straightest_successor("b") == "bend"


@pytest.mark.parametrize("angle", TURNS)
def test_a_turned_route_over_itself_is_followed_in_the_ego_s_direction(angle):
    eight = np.array([[-50.0, 0, 0], [50.0, 0, 0], [50.0, 50, 0], [0.0, 50, 0], [0.0, -50, 0]])
    T_turned = se2(0.0, 0.0, angle)
    for pose in (se2(0.0, 0.2, np.radians(8.0)), se2(0.2, 0.0, np.radians(-82.0))):
        seen = route_in_rig(Route(turned_points(eight, angle)), T_turned @ pose)
        assert_allclose(seen, route_in_rig(Route(eight), pose), atol=1e-6)
        assert seen[5, 0] > 0.9 * 5 * 80 / 19
