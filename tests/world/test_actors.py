"""Actors in a rollout: replay inside the track's time, and drivers that react once the loop is
closed.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.geometry import interpolate, quat_from_yaw, se2
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
from alpasim_plugin.world.ground import flat

BOX = Box(4.6, 1.85, 1.5)
FAR_AWAY = EgoState(0, se2(0.0, 500.0, 0.0), 0.0)
T0 = 1_600_000_000_000_000  # epoch microseconds: too large for float arithmetic


def line_track(
    x0,
    speed,
    seconds=10.0,
    y=0.0,
    t0=0,
):
    t = t0 + np.arange(0, round(seconds * 1e6) + 1, 100_000, dtype=np.int64)
    x = x0 + speed * (t - t0) * 1e-6
    return Trajectory(
        t,
        np.column_stack([x, np.full(len(t), y), np.full(len(t), 0.75)]),
        quat_from_yaw(np.zeros(len(t))),
    )


def idm(actor_id, x0, speed, **params):
    behaviour = Behaviour("idm", {"desired_speed_mps": max(speed, 1.0), **params})
    return Actor(actor_id, "car", BOX, line_track(x0, speed), behaviour=behaviour)


def ego_at(x, speed=0.0):
    return EgoState(0, se2(x, 0.0, 0.0), speed)


def run(actors, ego, end_us, step_us=100_000):
    out = {}
    for t in range(0, end_us + 1, step_us):
        for name, pose in actors.step(t, ego).items():
            out.setdefault(name, []).append(float(pose[0, 3]))
    return out


def winding_track(seed, t0):
    rng = np.random.default_rng(seed)
    t = t0 + np.cumsum(rng.integers(1_000, 200_000, 60)).astype(np.int64)
    yaw = np.cumsum(rng.normal(0, 0.6, 60))  # passes 180 degrees many times
    return Trajectory(t, rng.normal(0, 30, (60, 3)) + 5e5, quat_from_yaw(yaw))


def test_batched_replay_agrees_with_interpolating_track_by_track():
    actors = [Actor(f"a{i}", "car", BOX, winding_track(i, T0 + 37_000 * i)) for i in range(12)]
    batch = Actors(actors, Vehicle(), T0)
    for t in range(T0 - 50_000, T0 + 7_000_000, 33_333):
        poses = batch.step(t, FAR_AWAY)
        present = {a.actor_id for a in actors if a.track.t_us[0] <= t <= a.track.t_us[-1]}
        assert set(poses) == present
        for actor in actors:
            if actor.actor_id in present:
                assert_allclose(poses[actor.actor_id], interpolate(actor.track, t), atol=1e-9)


def test_replay_is_present_exactly_from_its_first_to_its_last_pose():
    actors = Actors([Actor("a", "car", BOX, line_track(0, 5, 1.0, t0=100_000))], Vehicle(), 0)
    present = [t for t in (99_999, 100_000, 1_100_000, 1_100_001) if actors.step(t, FAR_AWAY)]
    assert present == [100_000, 1_100_000]


def test_reactive_driver_follows_its_track_while_the_log_is_forced():
    actors = Actors([idm("a", 0, 8)], Vehicle(), 2_000_000, ground=flat())
    x = run(actors, ego_at(40.0), 2_000_000)[
        "a"
    ]  # the ego stands in its way, but the loop is not closed yet
    assert_allclose(x, 8.0 * np.arange(21) * 0.1, atol=1e-9)


def test_reactive_driver_stops_behind_a_standing_ego_without_contact():
    ego = ego_at(60.0)
    actors = Actors([idm("a", 0, 10)], Vehicle(), 500_000, ground=flat())
    x = run(actors, ego, 10_000_000)["a"]
    rear_of_ego = 60.0 + 1.4 - 4.855 / 2
    gaps = rear_of_ego - (np.array(x) + BOX.length_m / 2)
    assert gaps.min() > 1.0
    assert abs(x[-1] - x[-11]) < 1.0, "slower than 1 m/s by then"


def test_reactive_driver_follows_a_replayed_leader_that_stops():
    t = np.array([0, 3_000_000, 10_000_000])
    stop = Trajectory(
        t, np.array([[30.0, 0, 0.75], [45, 0, 0.75], [45, 0, 0.75]]), quat_from_yaw(np.zeros(3))
    )
    actors = Actors(
        [idm("a", 0, 10), Actor("leader", "car", BOX, stop)], Vehicle(), 500_000, ground=flat()
    )
    x = run(actors, FAR_AWAY, 10_000_000)["a"]
    assert x[-1] + BOX.length_m / 2 < 45 - BOX.length_m / 2 - 0.5


def test_reactive_driver_stops_behind_a_parked_car_only_while_it_is_there():
    def parked(last_us):
        t = np.array([0, last_us])
        track = Trajectory(t, np.array([[50.0, 0.5, 0.75]] * 2), quat_from_yaw(np.zeros(2)))
        return Actor("parked", "car", BOX, track, is_static=True)

    stays = run(
        Actors([idm("a", 0, 10), parked(20_000_000)], Vehicle(), 500_000, ground=flat()),
        FAR_AWAY,
        9_000_000,
    )["a"]
    assert stays[-1] + BOX.length_m / 2 < 50 - BOX.length_m / 2 - 0.5
    leaves = run(
        Actors([idm("a", 0, 10), parked(1_000_000)], Vehicle(), 500_000, ground=flat()),
        FAR_AWAY,
        9_000_000,
    )["a"]
    assert leaves[-1] > 60


def test_a_column_of_reactive_drivers_stays_in_order():
    column = [idm(f"c{i}", -12.0 * i, 9, desired_speed_mps=6.0 + 2 * i) for i in range(4)]
    x = run(Actors(column, Vehicle(), 0, ground=flat()), FAR_AWAY, 9_000_000)
    for i in range(3):
        gap = np.array(x[f"c{i}"]) - np.array(x[f"c{i + 1}"]) - BOX.length_m
        assert gap.min() > 1.0


def test_reactive_driver_goes_on_along_the_lanes_where_its_track_ends():
    bend = np.column_stack(
        [
            15 + 20 * np.sin(np.linspace(0, 1.5, 40)),
            20 - 20 * np.cos(np.linspace(0, 1.5, 40)),
            np.zeros(40),
        ]
    )
    lanes = {
        "a": Lane("a", np.array([[-5.0, 0, 0], [15, 0, 0]]), None, None, successors=("b",)),
        "b": Lane("b", bend, None, None),
    }
    short = Actor(
        "a",
        "car",
        BOX,
        line_track(0, 10, 1.0, y=0.4),
        behaviour=Behaviour("idm", {"desired_speed_mps": 10}),
    )
    actors = Actors([short], Vehicle(), 500_000, LaneMap(lanes), flat())
    poses = [actors.step(t, FAR_AWAY) for t in range(0, 6_000_001, 100_000)]
    at = np.array([p["a"][:2, 3] for p in poses if "a" in p])
    assert at[10:, 1].max() > 12.0
    # The offset from the lane's middle at the end of the track is kept at first and then fades out.
    radius = np.hypot(at[30:, 0] - 15, at[30:, 1] - 20)
    assert_allclose(radius, 20.0, atol=0.3)
    assert "a" not in poses[-1], "it leaves the scene at the end of the map"


def test_a_track_that_ends_with_the_last_lane_of_the_map_is_driven_to_its_end():
    lane = Lane("a", np.array([[-5.0, 0, 0], [10.00005, 0, 0]]), None, None)
    behaviour = Behaviour("idm", {"desired_speed_mps": 10})
    short = Actor("a", "car", BOX, line_track(0, 10, 1.0), behaviour=behaviour)
    actors = Actors([short], Vehicle(), 500_000, LaneMap({"a": lane}), flat())
    x = run(actors, FAR_AWAY, 3_000_000)["a"]
    assert 9.0 <= x[-1] <= 10.0


def test_reactive_driver_with_a_track_that_goes_nowhere_stays_on_it():
    parked = Actor("a", "car", BOX, line_track(5, 0.0), behaviour=Behaviour("idm"))
    actors = Actors([parked], Vehicle(), 0, ground=flat())
    assert run(actors, FAR_AWAY, 5_000_000)["a"] == pytest.approx([5.0] * 51)


def test_a_track_that_begins_late_reacts_from_then_on():
    late = Actor(
        "a",
        "car",
        BOX,
        line_track(0, 8, 10.0, t0=2_000_000),
        behaviour=Behaviour("idm", {"desired_speed_mps": 8}),
    )
    actors = Actors([late], Vehicle(), 500_000, ground=flat())
    seen = {t: actors.step(t, ego_at(30.0)) for t in range(0, 10_000_001, 100_000)}
    assert not any(seen[t] for t in range(0, 2_000_000, 100_000))
    assert float(seen[2_000_000]["a"][0, 3]) == pytest.approx(0.0, abs=0.9)
    assert float(seen[10_000_000]["a"][0, 3]) + 2.3 < 30 + 1.4 - 4.855 / 2


def test_an_outlook_stays_as_it_is_while_the_actors_move_on():
    replayed = Actor("replayed", "car", BOX, line_track(40.0, 7.0, y=3.5))
    actors = Actors([replayed, idm("driver", 0.0, 10.0)], Vehicle(), 0, None, flat())
    for t in (0, 100_000):
        actors.step(t, FAR_AWAY)
    forecast = actors.forecast()
    expected = {t: forecast.at(t) for t in (100_000, 500_000, 1_000_000)}
    for t in range(200_000, 1_500_000, 100_000):
        moved = actors.step(t, FAR_AWAY)
        if t == 1_000_000:
            assert_array_equal(moved["replayed"], expected[t]["replayed"])
            # Foreseen at the speed of 0.1 s; free of a leader the driver keeps close to it.
            assert abs(moved["driver"][0, 3] - expected[t]["driver"][0, 3]) < 0.5
    for t, poses in expected.items():
        for name, pose in poses.items():
            assert_array_equal(forecast.at(t)[name], pose)
    assert expected[1_000_000]["driver"][0, 3] - expected[500_000]["driver"][0, 3] == pytest.approx(
        5.0, abs=0.1
    )


def test_an_outlook_ends_with_the_track_and_with_the_drivers_way():
    replayed = Actor("replayed", "car", BOX, line_track(40.0, 7.0, seconds=1.0, y=3.5))
    short = Actor(
        "driver",
        "car",
        BOX,
        line_track(0.0, 10.0, seconds=1.0),
        behaviour=Behaviour("idm", {"desired_speed_mps": 10.0}),
    )
    actors = Actors([replayed, short], Vehicle(), 0)
    for t in (0, 100_000):
        actors.step(t, FAR_AWAY)
    assert set(actors.forecast().at(900_000)) == {"replayed", "driver"}
    assert set(actors.forecast().at(1_100_000)) == set()


def test_one_pose_track_is_there_at_its_instant():
    one = Trajectory(
        np.array([200_000]), np.array([[1.0, 2.0, 0.75]]), quat_from_yaw(np.array([0.3]))
    )
    actors = Actors([Actor("a", "car", BOX, one)], Vehicle(), 0)
    assert actors.step(100_000, FAR_AWAY) == {}
    assert_allclose(actors.step(200_000, FAR_AWAY)["a"][:3, 3], [1.0, 2.0, 0.75])


def test_reset_gives_the_same_drive_again():
    actors = Actors([idm("a", 0, 10), idm("b", -15, 12)], Vehicle(), 500_000, ground=flat())
    first = run(actors, ego_at(70.0), 6_000_000)
    actors.reset()
    assert run(actors, ego_at(70.0), 6_000_000) == first
