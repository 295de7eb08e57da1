"""Streets that a drive passes twice: which way on is meant is told by the place along the drive."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.geometry import heading_of, quat_from_yaw, se2
from alpasim_plugin.core.types import Actor, Behaviour, Box, EgoState, Route, Trajectory, Vehicle
from alpasim_plugin.runs.loop_state import LoopState
from alpasim_plugin.world.actors import Actors
from alpasim_plugin.world.route import RouteAhead, route_in_rig
from scenarios.load import load_scenario

CAR = Box(4.6, 1.85, 1.5)
# East along a street, around a block to the left, along the same street again, and then to the right.
CORNERS = np.array(
    [[0, 0], [60, 0], [60, 60], [-20, 60], [-20, 0], [60, 0], [60, -80]], dtype=np.float64
)


def dense(corners, step_m=0.5):
    """A line through corners, and arc lengths of its points."""
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    s_corner = np.concatenate([[0.0], np.cumsum(lengths)])
    s = np.arange(0.0, s_corner[-1], step_m)
    xy = np.column_stack([np.interp(s, s_corner, corners[:, axis]) for axis in (0, 1)])
    return np.column_stack([xy, np.zeros(len(s))]), s


LINE, ALONG = dense(CORNERS)
YAW = np.append(heading_of(np.diff(LINE, axis=0)), -np.pi / 2)
SECOND_S = 60.0 + 60.0 + 80.0 + 60.0 + 20.0  # where the street is met again
BEFORE_TURN_M = 20.0


def pose_at(s_m, left_m=0.0):
    k = int(np.searchsorted(ALONG, s_m))
    x, y, _ = LINE[k]
    return se2(x - left_m * np.sin(YAW[k]), y + left_m * np.cos(YAW[k]), YAW[k])


@pytest.mark.parametrize("left_m", [0.0, 0.8, -0.8])
def test_a_street_that_is_passed_twice_is_left_each_time_as_the_route_leaves_it(left_m):
    ahead = RouteAhead(Route(LINE))
    turns = {}
    for s_m in np.arange(0.0, ALONG[-1] - 90.0, 2.0):
        seen = ahead.in_rig(pose_at(s_m, left_m))
        turns[round(s_m)] = float(seen[-1, 1])
    first_m = round(60.0 - BEFORE_TURN_M)
    second_m = round(SECOND_S + 60.0 - BEFORE_TURN_M)
    assert turns[first_m] > 40.0  # to the left
    assert turns[second_m] < -40.0  # to the right


def test_without_a_place_the_first_pass_counts_and_about_a_place_that_one():
    pose = pose_at(40.0)
    assert route_in_rig(Route(LINE), pose)[-1, 1] > 40.0
    assert route_in_rig(Route(LINE), pose, about_m=40.0)[-1, 1] > 40.0
    assert route_in_rig(Route(LINE), pose, about_m=SECOND_S + 40.0)[-1, 1] < -40.0


def test_who_leaves_the_route_and_meets_it_again_is_on_it_there():
    ahead = RouteAhead(Route(LINE))
    for s_m in np.arange(0.0, 50.0, 2.0):
        ahead.follow(pose_at(s_m))
    for y in np.arange(0.0, 60.0, 2.0):  # across the block
        ahead.follow(se2(50.0, y, np.pi / 2))
    seen = ahead.in_rig(se2(50.0, 60.0, np.pi))
    assert np.abs(seen[:, 1]).max() < 70.0
    assert seen[3, 0] == pytest.approx(3 * 80 / 19, abs=0.3)  # ahead, to the west


def drive(speed_mps=8.0):
    t_us = np.round(ALONG / speed_mps * 1e6).astype(np.int64)
    up = np.array([0.0, 0.0, CAR.height_m / 2])
    return Trajectory(t_us, LINE + up, quat_from_yaw(YAW))


def test_a_rollout_that_begins_in_the_second_round_takes_the_second_turn():
    straight_road = load_scenario("smoke/straight")
    log = drive()
    start_us = int(np.interp(SECOND_S + 40.0, ALONG, log.t_us))
    again = replace(straight_road, ego_log=log, route=Route(LINE), start_us=start_us)
    state = LoopState.at_start(again, 10)
    assert state.observe({}).route_rig[-1, 1] < -40.0


@pytest.mark.parametrize("closed_s", [40.0, SECOND_S + 30.0])
def test_a_reactive_driver_goes_on_from_where_its_track_is(closed_s):
    track = drive()
    closed_us = int(np.interp(closed_s, ALONG, track.t_us))
    actor = Actor("a", "car", CAR, track, behaviour=Behaviour("idm", {"desired_speed_mps": 8.0}))
    actors = Actors([actor], Vehicle(), closed_us)
    away = EgoState(0, se2(0.0, 900.0, 0.0), 0.0)
    times_us = range(closed_us - 400_000, closed_us + 8_000_000, 100_000)
    places = [actors.step(t_us, away)["a"][:2, 3] for t_us in times_us]
    steps = np.hypot(*np.diff(places, axis=0).T)
    assert steps.max() < 1.0
    assert (places[-1][1] > 10.0) == (closed_s < SECOND_S)
