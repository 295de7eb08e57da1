"""Reactive drivers that change lanes (MOBIL)."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from alpasim_plugin.core.geometry import quat_from_yaw, rectangle_corners, se2, yaw_of
from alpasim_plugin.core.types import Actor, Behaviour, Box, EgoState, Signal, Trajectory, Vehicle
from alpasim_plugin.world.actors import Actors
from alpasim_plugin.world.idm import IdmParams, bodies_from, idm_acceleration
from alpasim_plugin.world.lane_change import LanesBeside, gain_mps2
from alpasim_plugin.world.path import polyline_path
from tests.world.small_maps import make, straight

CAR = Box(4.6, 1.85, 1.5)
TRUCK = Box(12.0, 2.5, 3.0)
AWAY = EgoState(0, se2(0.0, 500.0, 0.0), 0.0)
STEP_US = 100_000
LEFT_M = 3.5


def street(**more):
    """Two lanes of 600 m side by side; what is said of the left one replaces what it is."""
    right = straight("right", 0.0, 600.0, left_neighbour="left")
    left = straight("left", 0.0, 600.0, LEFT_M, right_neighbour="right")
    return make(right, replace(left, **more))


def driver(name, x_m, speed_mps, y_m=0.0, wanted_mps=None, gain_mps2=0.2):
    """A driver who has driven along a lane for 2 s."""
    t_us = STEP_US * np.arange(21, dtype=np.int64)
    x = x_m + speed_mps * t_us * 1e-6
    track = Trajectory(t_us, np.column_stack([x, 0 * x + y_m, 0 * x + 0.75]), quat_from_yaw(0 * x))
    params = {"desired_speed_mps": wanted_mps or speed_mps}
    if gain_mps2 is not None:
        params["change_gain_mps2"] = gain_mps2
    return Actor(name, "car", CAR, track, behaviour=Behaviour("idm", params))


def driven(actors, lane_map, until_us=30_000_000):
    world = Actors(actors, Vehicle(), 500_000, lane_map)
    out = {}
    for t_us in range(0, until_us + 1, STEP_US):
        for name, pose in world.step(t_us, AWAY).items():
            out.setdefault(name, []).append(pose)
    return {name: np.array(poses) for name, poses in out.items()}, world


def least_gap_m(first, second):
    n = min(len(first), len(second))
    boxes = [
        shapely.polygons(
            rectangle_corners(
                poses[:n, :2, 3],
                np.array([yaw_of(pose) for pose in poses[:n]]),
                np.tile([CAR.length_m, CAR.width_m], (n, 1)),
            )
        )
        for poses in (first, second)
    ]
    return shapely.distance(*boxes).min()


def test_a_driver_passes_a_slow_one_in_the_lane_beside():
    slow = driver("slow", 60.0, 4.0)
    fast = driver("fast", 20.0, 10.0, wanted_mps=12.0)
    poses, world = driven([slow, fast], street())
    y = poses["fast"][:, 1, 3]
    assert y.max() == pytest.approx(LEFT_M, abs=0.3)
    assert poses["fast"][-1, 0, 3] > poses["slow"][-1, 0, 3] + 30.0
    assert least_gap_m(poses["fast"], poses["slow"]) > 0.5
    speed_mps = np.hypot(*np.diff(poses["fast"][:, :2, 3], axis=0).T) / 0.1
    assert np.abs(np.diff(speed_mps)).max() / 0.1 < 8.0
    sideways_mps2 = np.abs(np.diff(y, 2)).max() / 0.01
    assert sideways_mps2 < 3.0
    world.reset()  # a second drive begins in the lane of the track
    for t_us in range(0, 600_001, STEP_US):
        again = world.step(t_us, AWAY)
    assert again["fast"][1, 3] == pytest.approx(0.0, abs=0.01)


def test_a_red_light_that_holds_both_lanes_is_no_reason_to_change():
    stop = np.array([[200.0, -2.0, 0.0], [200.0, 6.0, 0.0]])
    red = Signal(stop, 0.0, (("red", 60_000_000),))
    poses, _ = driven([driver("a", 100.0, 12.0)], replace(street(), signals=(red,)), 12_000_000)
    assert np.abs(poses["a"][:, 1, 3]).max() < 0.01
    assert poses["a"][-1, 0, 3] < 200.0


def test_two_do_not_change_into_one_place_from_both_sides():
    lane_map = make(
        straight("right", 0.0, 600.0, left_neighbour="middle"),
        straight("middle", 0.0, 600.0, LEFT_M, left_neighbour="left", right_neighbour="right"),
        straight("left", 0.0, 600.0, 2 * LEFT_M, right_neighbour="middle"),
    )
    slow = [driver("slow right", 60.0, 4.0), driver("slow left", 60.0, 4.0, 2 * LEFT_M)]
    right = driver("right", 20.0, 10.0, wanted_mps=14.0)
    left = driver("left", 23.0, 10.0, 2 * LEFT_M, wanted_mps=14.0)
    poses, _ = driven([*slow, right, left], lane_map, 15_000_000)
    assert least_gap_m(poses["right"], poses["left"]) > 0.5


@pytest.mark.parametrize(
    ("gain_mps2", "beside"),
    [
        (None, {}),  # one who stays in its lane
        (0.2, {"kind": "shoulder"}),
        (0.2, {"is_intersection": False, "lane_id": "other"}),  # no such neighbour
    ],
)
def test_others_stay_behind(gain_mps2, beside):
    slow = driver("slow", 60.0, 4.0)
    fast = driver("fast", 20.0, 10.0, wanted_mps=12.0, gain_mps2=gain_mps2)
    poses, _ = driven([slow, fast], street(**beside))
    assert np.abs(poses["fast"][:, 1, 3]).max() < 0.01
    assert poses["fast"][-1, 0, 3] < poses["slow"][-1, 0, 3]


def test_nobody_changes_into_oncoming_traffic_or_in_a_junction():
    slow = driver("slow", 60.0, 4.0)
    fast = driver("fast", 20.0, 10.0, wanted_mps=12.0)
    against = street()
    left = against.lanes["left"]
    turned = replace(left, centre=left.centre[::-1], left=left.right[::-1], right=left.left[::-1])
    against = replace(against, lanes={**against.lanes, "left": turned})
    inside = street()
    lanes = {key: replace(lane, is_intersection=True) for key, lane in inside.lanes.items()}
    for lane_map in (against, replace(inside, lanes=lanes)):
        poses, _ = driven([slow, fast], lane_map, 12_000_000)
        assert np.abs(poses["fast"][:, 1, 3]).max() < 0.01


def test_a_new_way_leads_as_far_as_the_old_one():
    """Its end is where the driver leaves the scene."""
    right = straight("right", 0.0, 2000.0, left_neighbour="left")
    left = straight("left", 0.0, 300.0, LEFT_M, right_neighbour="right", successors=("on",))
    on = straight("on", 300.0, 2000.0, LEFT_M)
    path = polyline_path(np.array([[0.0, 0.0, 0.75], [2000.0, 0.0, 0.75]]))
    (change,) = LanesBeside.of(make(right, left, on)).changes(path, 100.0, 10.0, 0.75)
    assert change.way.at(change.way.length_m)[0][0] >= 1997.0


def test_who_stops_where_its_track_turns_back_stays_in_its_lane():
    t_us = STEP_US * np.arange(111, dtype=np.int64)
    seconds = t_us * 1e-6
    x = 20.0 + np.where(seconds < 10.0, 10.0 * seconds, 100.0 - 5.0 * (seconds - 10.0))
    track = Trajectory(t_us, np.column_stack([x, 0 * x, 0 * x + 0.75]), quat_from_yaw(0 * x))
    parks = replace(driver("parks", 20.0, 10.0, wanted_mps=12.0), track=track)
    poses, _ = driven([driver("slow", 60.0, 4.0), parks], street())
    assert np.abs(poses["parks"][:, 1, 3]).max() < 0.01
    assert poses["parks"][-1, 0, 3] == pytest.approx(120.0, abs=1.0)


def gain(others, politeness=0.0, own_box=CAR):
    """The gain of a driver at 100 m and 10 m/s, who wants 14 m/s, of a change to the left."""
    path = polyline_path(
        np.column_stack([np.arange(0.0, 601.0), np.zeros(601), np.full(601, 0.75)])
    )
    places = np.array([(100.0, 0.0, 10.0), *others])
    velocity = np.column_stack([places[:, 2], 0 * places[:, 2]])
    heights = np.full(len(places), 0.75)
    boxes = [own_box, *[CAR] * len(others)]
    bodies = bodies_from(places[:, :2], 0 * places[:, 2], boxes, velocity, heights)
    params = IdmParams(14.0, politeness=politeness)
    (change,) = LanesBeside.of(street()).changes(path, 100.0, 10.0, 0.75)
    leader = next((x - CAR.length_m - 100.0, v) for x, y, v in others if y == 0.0 and x > 100.0)
    now = idm_acceleration(10.0, leader[0], 10.0 - leader[1], params)
    return gain_mps2(change, path, 100.0, 10.0, now, bodies, 0, params), now, params


def test_the_gain_is_that_of_the_model():
    """Kesting et al. (2007), equations 2 and 3."""
    ahead = (130.0, 0.0, 6.0)
    found, now, params = gain([ahead])
    assert found == pytest.approx(idm_acceleration(10.0, np.inf, 0.0, params) - now)
    behind = (70.0, LEFT_M, 12.0)  # 25.4 m free between the two
    polite, now, params = gain([ahead, behind], 0.5)
    follower = replace(params, desired_speed_mps=14.0)
    cost = idm_acceleration(12.0, 25.4, 2.0, follower) - idm_acceleration(
        12.0, np.inf, 12.0, follower
    )
    own = idm_acceleration(10.0, np.inf, 0.0, params) - now
    assert polite == pytest.approx(own + 0.5 * cost)


@pytest.mark.parametrize("behind_m", [3.0, -3.0, 8.0, 14.0])
def test_nobody_changes_where_the_new_follower_had_to_brake_hard(behind_m):
    ahead = (130.0, 0.0, 6.0)
    speed_mps = 18.0 if behind_m > 3.0 else 10.0
    found, _, params = gain([ahead, (100.0 - behind_m, LEFT_M, speed_mps)])
    assert found <= params.change_gain_mps2
    assert not found > 0.0


@pytest.mark.parametrize("ahead_m", [-6.0, -1.0, 0.0, 2.0, 3.5])
def test_a_truck_does_not_change_onto_a_car_abreast_of_it(ahead_m):
    found, _, _ = gain([(140.0, 0.0, 4.0), (100.0 + ahead_m, LEFT_M, 10.0)], own_box=TRUCK)
    assert found == -np.inf
