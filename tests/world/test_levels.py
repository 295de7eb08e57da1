"""Roads above one another: the ground, who is followed, and where reactive drivers stand."""

import numpy as np
import pytest

from alpasim_plugin.core.geometry import quat_from_yaw, se2
from alpasim_plugin.core.types import (
    Actor,
    Behaviour,
    Box,
    EgoState,
    Lane,
    LaneMap,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.world.actors import Actors
from alpasim_plugin.world.ground import flat, from_points, ground_pose, height_at
from alpasim_plugin.world.idm import bodies_from, find_leader
from alpasim_plugin.world.path import Lines, polyline_path
from alpasim_plugin.world.route import LaneIndex, match_lanes
from tests.world.small_maps import make, straight
from tests.world.stacked_roads import STACKED, raised

CAR = Box(4.6, 1.85, 1.5)
HIGH_M = 7.0


def edges(z_m, along_x, width_m=7.0):
    """The two edges of a straight road of 200 m."""
    s = np.arange(-100.0, 101.0)
    sides = [np.column_stack([s, 0 * s + d, 0 * s]) for d in (-width_m / 2, width_m / 2)]
    edge_points = np.concatenate(sides)
    out = edge_points if along_x else edge_points[:, [1, 0, 2]]
    return out + np.array([0.0, 0.0, 1.0]) * np.broadcast_to(z_m, len(s)).repeat(2)[:, None]


def drive(z_m, along_x):
    s = np.arange(-80.0, 81.0)
    zero = 0 * s
    return np.column_stack([s, zero, zero + z_m] if along_x else [zero, s, zero + z_m])


CROSSING = np.concatenate([edges(0.0, True), edges(HIGH_M, False)])


@pytest.mark.parametrize("base_m", [0.0, 640.0])
@pytest.mark.parametrize(("z_m", "along_x"), [(0.0, True), (HIGH_M, False)])
def test_the_ground_under_a_drive_is_that_of_its_road(z_m, along_x, base_m):
    up = np.array([0.0, 0.0, base_m])
    line = drive(z_m, along_x) + up
    field = from_points(CROSSING + up, drive=line)
    assert height_at(field, line) == pytest.approx(np.full(len(line), z_m + base_m), abs=1e-6)
    middle = ground_pose(field, 0.0, 0.0, 0.0)
    assert middle[:3, 2] == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)  # no pitch and no roll
    for x, y in ((1.75, 0.0), (0.0, 1.75)):  # the grid's cells reach over the edge of the road
        assert ground_pose(field, x, y, 0.0)[2, 2] > np.cos(np.radians(1.5))


@pytest.mark.parametrize("deck", range(3))
def test_each_deck_of_a_car_park_has_a_ground_of_its_own(deck):
    decks = np.concatenate([edges(3.0 * number, True) for number in range(3)])
    line = drive(3.0 * deck, True)
    field = from_points(decks, drive=line)
    assert height_at(field, line) == pytest.approx(line[:, 2], abs=1e-6)


def test_hills_and_banks_beside_a_drive_stay_as_they_are():
    rng = np.random.default_rng(4)
    xy = rng.uniform(-60.0, 60.0, (4000, 2))
    hill = np.column_stack([xy, 0.12 * xy[:, 0] + 4.0 * np.sin(xy[:, 1] / 15.0)])
    line = drive(0.0, True)[20:-20]
    line[:, 2] = 0.12 * line[:, 0]
    with_drive = from_points(hill, drive=line)
    alone = from_points(hill)
    assert np.array_equal(with_drive.z, alone.z)


STRAIGHT = np.column_stack([np.linspace(0, 200, 201), np.zeros((201, 2))])


@pytest.mark.parametrize("base_m", [0.0, 640.0])
@pytest.mark.parametrize(
    ("above_m", "is_followed"), [(0.0, True), (0.75, True), (3.75, False), (-3.25, False)]
)
def test_who_is_on_a_bridge_or_below_the_line_is_not_followed(above_m, is_followed, base_m):
    line = Lines([polyline_path(STRAIGHT + np.array([0.0, 0.0, base_m]))])
    z = np.array([base_m + above_m])
    ahead = bodies_from(np.array([60.0, 0.0]), np.zeros(1), [CAR], np.zeros(2), z)
    leader = find_leader(line, 10.0, 0.95, ahead)
    assert (leader.index == 0) == is_followed
    unknown = bodies_from(np.array([60.0, 0.0]), np.zeros(1), [CAR], np.zeros(2))
    assert find_leader(line, 10.0, 0.95, unknown).index == 0


def follower(z_m):
    """A car that has driven east at 10 m/s for 10 s, at a height."""
    t_us = np.arange(0, 10_000_001, 100_000, dtype=np.int64)
    xyz = np.column_stack([t_us * 1e-5, 0.0 * t_us, 0.0 * t_us + z_m + CAR.height_m / 2])
    track = Trajectory(t_us, xyz, quat_from_yaw(np.zeros(len(t_us))))
    return Actor("car", "car", CAR, track, behaviour=Behaviour("idm", {"desired_speed_mps": 10.0}))


def test_a_reactive_driver_on_a_bridge_stays_up_there_and_does_not_wait_for_the_ego_below():
    last = {}
    for z_m in (0.0, HIGH_M):
        actors = Actors([follower(z_m)], Vehicle(), 1_000_000, ground=flat(0.0))
        for t_us in range(0, 8_000_001, 100_000):
            poses = actors.step(t_us, EgoState(0, se2(40.0, 0.0, 0.0), 0.0))
        last[z_m] = poses["car"]
    assert last[0.0][0, 3] < 40.0
    assert last[HIGH_M][0, 3] > 60.0
    assert last[HIGH_M][2, 3] == pytest.approx(HIGH_M + CAR.height_m / 2)


DECKS = make(*(straight(f"deck {number}", 0, 100, z=3.0 * number) for number in range(3)))
BRIDGE = make(straight("road", 0, 100), raised("ramp", [0.0, 4.0, 4.0]))


@pytest.mark.parametrize("base_m", [0.0, 640.0])
def test_a_place_is_in_the_lanes_at_its_height(base_m):
    up = np.array([0.0, 0.0, base_m])

    def lanes_at(lane_map, *points):
        raised_map = make(*lane_map.lanes.values(), shift=up)
        return LaneIndex(raised_map).containing_many(np.array(points) + up)

    for number in range(3):  # decks of a car park, 3 m apart
        place = (50.0, 1.0, 3.0 * number + 0.3)
        assert lanes_at(DECKS, place) == [(f"deck {number}",)]
    low, high = (80.0, 0.0, 0.0), (80.0, 0.0, 4.0)
    assert lanes_at(BRIDGE, low, high) == [("road",), ("ramp",)]  # two roads 4 m apart
    # Where a ramp begins it is at the height of the road.
    assert lanes_at(BRIDGE, (5.0, 0.0, 0.2)) == [("road", "ramp")]
    assert lanes_at(make(straight("bridge", 0, 100, z=7.0)), low) == [()]
    assert LaneIndex(DECKS).containing(np.array([50.0, 1.0])) == tuple(DECKS.lanes)
    assert LaneIndex(DECKS).within(np.array([50.0, 1.0, 3.2]), 6.0) == ("deck 1",)


def test_a_lane_that_winds_above_itself_is_at_each_of_its_heights():
    turn = np.linspace(0.0, 4 * np.pi, 200)
    lines = [
        np.column_stack([r * np.cos(turn), r * np.sin(turn), 3.0 * turn / (2 * np.pi)])
        for r in (10.0, 8.25, 11.75)
    ]
    index = LaneIndex(LaneMap({"helix": Lane("helix", *lines)}))
    for z, inside in ((0.75, True), (3.75, True), (9.0, False)):
        assert bool(index.containing(np.array([0.0, 10.0, z]))) == inside


def test_a_recorded_drive_under_a_bridge_is_named_by_the_lanes_below():
    lane_map = make(straight("bridge", 0, 100, z=4.0), straight("road", 0, 100))
    s = np.linspace(5.0, 60.0, 56)
    for name, z in (("road", 0.0), ("bridge", 4.0)):
        path = np.column_stack([s, 0 * s, 0 * s + z])
        assert match_lanes(LaneIndex(lane_map), path, 0.0) == (name,)


@pytest.mark.parametrize(("z_m", "goes_straight"), [(0.0, True), (3.0, False)])
@pytest.mark.parametrize("box", [CAR, Box(12.0, 2.55, 3.8)])
def test_a_reactive_driver_goes_on_along_the_road_that_it_is_on(z_m, goes_straight, box):
    t_us = np.arange(0, 6_000_001, 100_000, dtype=np.int64)
    xyz = np.column_stack([30.0 + t_us * 1e-5, 0.0 * t_us, 0.0 * t_us + z_m + box.height_m / 2])
    track = Trajectory(t_us, xyz, quat_from_yaw(np.zeros(len(t_us))))
    behaviour = Behaviour("idm", {"desired_speed_mps": 10.0})
    actor = Actor("car", "car", box, track, behaviour=behaviour)
    actors = Actors([actor], Vehicle(), 1_000_000, STACKED)
    far_away = EgoState(0, se2(0.0, 500.0, 0.0), 0.0)
    for t_us in range(0, 9_000_001, 100_000):
        pose = actors.step(t_us, far_away)["car"]
    assert (pose[1, 3] < 1.0) == goes_straight
    assert pose[2, 3] == pytest.approx(z_m + box.height_m / 2, abs=1e-6)
