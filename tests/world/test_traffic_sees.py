"""Whom reactive drivers see, and how they come into the scene."""

import numpy as np
import pytest
import shapely

from alpasim_plugin.core.geometry import quat_from_yaw, rectangle_corners, se2, yaw_of
from alpasim_plugin.core.types import Actor, Behaviour, Box, EgoState, Trajectory, Vehicle
from alpasim_plugin.world.actors import Actors
from alpasim_plugin.world.idm import bodies_from, find_leader, find_leaders, spans
from alpasim_plugin.world.path import Lines, polyline_path, smooth_path

CAR = Box(4.6, 1.85, 1.5)
BUS = Box(12.0, 2.5, 3.0)
AWAY = EgoState(0, se2(0.0, 500.0, 0.0), 0.0)
STEP_US = 100_000


def driver(name, x, y=None, yaw=None, box=CAR, first_us=0, speed_mps=10.0):
    """A reactive driver whose track has poses at places ``x``, every 0.1 s from a time on."""
    x = np.asarray(x, dtype=np.float64)
    y = np.zeros(len(x)) if y is None else np.asarray(y, dtype=np.float64)
    yaw = np.zeros(len(x)) if yaw is None else np.asarray(yaw, dtype=np.float64)
    t_us = first_us + STEP_US * np.arange(len(x), dtype=np.int64)
    track = Trajectory(t_us, np.column_stack([x, y, 0 * x + box.height_m / 2]), quat_from_yaw(yaw))
    return Actor(
        name, "car", box, track, behaviour=Behaviour("idm", {"desired_speed_mps": speed_mps})
    )


def driven(actors, until_us, ego=AWAY, closed_us=0, step_us=STEP_US):
    """Return the poses ``(T, 4, 4)`` of each actor at each step."""
    world = Actors(actors, Vehicle(), closed_us)
    out = {}
    for t_us in range(0, until_us + 1, step_us):
        for name, pose in world.step(t_us, ego).items():
            out.setdefault(name, []).append(pose)
    return {name: np.array(poses) for name, poses in out.items()}


@pytest.mark.parametrize("moved_m", [0.0, 0.4, 0.9])
def test_who_has_hardly_moved_on_its_track_is_seen(moved_m):
    queue = driver("queue", np.linspace(80.0, 80.0 + moved_m, 201))
    poses = driven([driver("car", np.arange(0.0, 150.0)), queue], 15_000_000)
    gap_m = poses["queue"][-1, 0, 3] - poses["car"][-1, 0, 3] - CAR.length_m
    assert 1.0 < gap_m < 4.0


@pytest.mark.parametrize("nose_m", [6.7, 2.0])
def test_a_bus_that_merges_from_beside_is_let_in(nose_m):
    """Its rear is behind the bumper of the car in the lane, at the same speed."""
    s = np.arange(0.0, 200.0)
    begin = 40.0 + CAR.length_m / 2 + nose_m - BUS.length_m / 2
    y = 3.4 * (1.0 - np.clip((s - 5.0) / 60.0, 0.0, 1.0))
    bus = driver("bus", begin + s, y, np.arctan2(np.gradient(y), 1.0), BUS)
    car = driver("car", 40.0 + s)
    poses = driven([bus, car], 12_000_000)
    assert poses["bus"][0, 0, 3] - BUS.length_m / 2 < poses["car"][0, 0, 3]
    corners = {}
    for name, box in (("bus", BUS), ("car", CAR)):
        size = np.tile([box.length_m, box.width_m], (len(poses[name]), 1))
        yaw = np.array([yaw_of(pose) for pose in poses[name]])
        corners[name] = rectangle_corners(poses[name][:, :2, 3], yaw, size)
    together = shapely.distance(shapely.polygons(corners["bus"]), shapely.polygons(corners["car"]))
    assert together.min() > 0.3
    assert poses["car"][-1, 0, 3] > 100.0  # it lets in and drives on


@pytest.mark.parametrize(
    ("y", "yaw", "left_mps", "counts"),
    [
        (2.6, 0.0, 0.0, False),  # drives beside
        (2.6, 0.0, -0.8, True),  # comes in
        (2.6, 0.0, 0.8, False),  # goes away
        (2.6, np.pi, -0.8, False),  # comes towards
        (-2.6, 0.0, 0.8, True),  # from the right
    ],
)
def test_who_is_beside_counts_where_it_comes_into_the_way(y, yaw, left_mps, counts):
    road = Lines([polyline_path(np.column_stack([np.linspace(0, 200, 201), np.zeros((201, 2))]))])
    along = np.array([10.0 * np.cos(yaw), 10.0 * np.sin(yaw) + left_mps])
    bus = bodies_from(np.array([51.0, y]), np.array([yaw]), [BUS], along)
    zero = np.zeros(1, dtype=np.int64)
    looks = (np.array([50.0]), np.array([0.95]), bus, np.array([60.0]), np.array([-1]))
    (leader,) = find_leaders(road, zero, *looks, lets_merge=True)
    assert (leader.index == 0) == counts
    if counts:
        assert leader.gap_m == pytest.approx(7.0)  # to its nose
    assert find_leader(road, 50.0, 0.95, bus).index == -1


def test_a_track_that_turns_back_on_itself_is_driven_to_where_it_does():
    """Into a parking place in two strokes: nobody jumps, and the car stands there."""
    forward = np.arange(0.0, 40.0, 0.8)
    back = np.arange(39.2, 34.0, -0.4)
    x = np.concatenate([forward, back])
    parking = driver("parking", x, np.concatenate([0 * forward, -0.3 * np.arange(len(back))]))
    poses = driven([parking], 20_000_000, closed_us=1_000_000)["parking"]
    steps = np.hypot(*np.diff(poses[:, :2, 3], axis=0).T)
    assert steps.max() < 1.2  # 12 m/s
    turned = [abs(yaw_of(pose)) for pose in poses]
    assert max(turned) < 0.5
    assert steps[-10:].max() < 0.01
    assert 35.0 < poses[-1, 0, 3] < 40.5


def test_a_track_that_begins_backwards_is_followed_as_it_is():
    out = -0.5 * np.arange(20.0)
    ahead = -9.5 + 0.8 * np.arange(1, 40.0)
    x = np.concatenate([out, ahead])
    poses = driven([driver("leaving", x)], STEP_US * (len(x) - 1))["leaving"]
    np.testing.assert_allclose(poses[:, 0, 3], x, atol=1e-9)


@pytest.mark.parametrize("first_us", [2_000_000, 2_010_000, 2_050_000, 2_099_000])
def test_who_comes_into_the_scene_is_where_its_track_is(first_us):
    """Whatever part of a step is left; at 20 m/s a step is two metres."""
    car = driver("car", np.arange(0.0, 200.0, 2.0), first_us=first_us, speed_mps=20.0)
    poses = driven([car], 2_400_000)["car"]
    t_us = np.arange(2_000_000, 2_400_001, STEP_US)
    expected_m = 20.0 * (t_us - first_us)[-len(poses) :] * 1e-6
    np.testing.assert_allclose(poses[:, 0, 3], expected_m, atol=0.02)


def walker(begin_m, speed_mps, x_m):
    """Somebody who walks across the road to the left at a place."""
    t_us = STEP_US * np.arange(201, dtype=np.int64)
    y = begin_m + speed_mps * t_us * 1e-6
    track = Trajectory(
        t_us,
        np.column_stack([np.full(len(t_us), x_m), y, np.full(len(t_us), 0.9)]),
        quat_from_yaw(np.full(len(t_us), np.pi / 2)),
    )
    return Actor("walker", "pedestrian", Box(0.6, 0.6, 1.75), track)


@pytest.mark.parametrize("begin_m", [-4.0, -4.5, -5.5])
def test_a_driver_waits_for_somebody_who_steps_into_its_way(begin_m):
    """It begins to brake before the step, and drives on behind."""
    car = driver("car", np.arange(0.0, 150.0))
    poses = driven([car, walker(begin_m, 1.3, 30.0)], 15_000_000)
    x = poses["car"][:, 0, 3]
    y = poses["walker"][:, 1, 3]
    in_the_way = np.abs(y) < 1.3
    assert (x[in_the_way] + CAR.length_m / 2 < 29.4).all()
    speed_mps = np.diff(x) / 0.1
    assert np.diff(speed_mps).min() / 0.1 > -8.0
    assert x[-1] > 60.0  # it goes on


@pytest.mark.parametrize(("begin_m", "speed_mps"), [(-5.0, 0.0), (-9.5, 1.3), (2.0, 1.3)])
def test_a_driver_does_not_wait_for_people_beside_the_road(begin_m, speed_mps):
    """They stand, come when it has passed, or walk away."""
    alone = driven([driver("car", np.arange(0.0, 150.0))], 8_000_000)["car"][:, 0, 3]
    car = driver("car", np.arange(0.0, 150.0))
    x = driven([car, walker(begin_m, speed_mps, 30.0)], 8_000_000)["car"][:, 0, 3]
    assert x == pytest.approx(alone, abs=0.2)


def test_nobody_far_from_a_bend_is_in_its_corridor():
    """A far place may be equally near to both ends of the piece of a line that is looked at."""
    s_m = np.arange(0.0, 240.0, 2.0)  # a straight, a bend of 60 m radius, a straight
    yaw = 2.0 * np.cumsum(np.where((s_m > 60.0) & (s_m < 180.0), 1 / 60.0, 0.0))
    xy = np.cumsum(2.0 * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
    line = Lines([smooth_path(np.column_stack([xy, 0.0 * s_m]))])
    n = 6000
    rng = np.random.default_rng(2)
    places = rng.uniform(-350.0, 350.0, (n, 2))
    turns = rng.uniform(-3.0, 3.0, n)
    bodies = bodies_from(places, turns, [CAR] * n, np.zeros((n, 2)))
    row = np.arange(n)
    low, high = line.stations(0 * row, np.full(n, 10.0), np.full(n, 105.0))
    span = spans(line, 0 * row, bodies, row, low, high)
    inside = (span.low < 1.2) & (span.high > -1.2) & (span.rear > 10.0) & (span.rear < 105.0)
    size = np.tile([CAR.length_m, CAR.width_m], (n, 1))
    boxes = shapely.polygons(rectangle_corners(places, turns, size))
    away_m = shapely.distance(boxes, shapely.linestrings(xy))
    assert inside.any()
    assert away_m[inside].max() < 1.5
