"""Outcomes without contact: standstill, braking without a cause and leaving the route, on hand-made
drives along a straight road.
"""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from alpasim_plugin.core.geometry import inverse, offset_trajectory, quat_from_yaw
from alpasim_plugin.core.types import (
    Actor,
    Box,
    LaneMap,
    RolloutLog,
    Scene,
    Signal,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.log.run_folder.rows import Rollout, rollouts_of_table
from alpasim_plugin.log.run_folder.writer import rollout_table
from alpasim_plugin.runs.scoring import tabulate
from evaluators import reduce_rollout, score
from evaluators.metrics.footprint import origin_of
from evaluators.metrics.outcomes import (
    OUTCOMES,
    actor_ahead,
    evaluate_outcomes,
    first_failure,
    in_words,
    outcome_events,
    outcomes_of,
)
from evaluators.metrics.presets import PRESETS
from evaluators.metrics.table import METRICS
from evaluators.statistics.outcomes import outcome_table, times_of
from tests import run_records

DT_S = 0.1
V = 8.0
T = np.arange(0.0, 12.0, DT_S)


def track(x, y=0.0):
    x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
    xyz = np.stack([x, y, np.zeros(len(x))], axis=1)
    return Trajectory(
        (np.arange(len(x)) * round(DT_S * 1e6)).astype(np.int64),
        xyz,
        quat_from_yaw(np.zeros(len(x))),
    )


def travelled(v):
    """Return how far speeds ``(T,)`` lead."""
    return np.concatenate([[0.0], np.cumsum(np.asarray(v, dtype=float)[:-1] * DT_S)])


def drive(ego, recorded=None, actors=None):
    vehicle = Vehicle()
    T_rig_box = np.eye(4)
    T_rig_box[:3, 3] = [vehicle.rear_axle_to_centre_m, 0.0, vehicle.box.height_m / 2]
    path = offset_trajectory(track(V * T) if recorded is None else recorded, inverse(T_rig_box))
    others = {
        name: Actor(name, "car", Box(4.5, 1.8, 1.5), one) for name, one in (actors or {}).items()
    }
    log = RolloutLog(
        "road",
        "road",
        vehicle.box,
        T_rig_box,
        ego,
        others,
        (),
        (),
        path,
        0,
        0,
        0,
        round(DT_S * 1e6),
    )
    return log, Scene("road", LaneMap({}, ()), path, vehicle)


def fired(*of):
    return {
        one.name
        for one in evaluate_outcomes(*drive(*of), PRESETS["paper"])
        if bool(np.any(one.value > 0))
    }


def slowing(to=0.4):
    return np.where(T < 3.0, V, np.maximum(V - 3.0 * (T - 3.0), to))


def test_a_drive_like_the_recording_has_no_outcome():
    assert fired(track(V * T)) == set()


def test_braking_to_a_crawl_on_an_empty_road_is_braking_without_a_cause():
    assert fired(track(travelled(slowing()))) == {"braked_without_cause"}


def test_standing_on_an_empty_road_is_a_stall_and_says_more_than_the_braking():
    had = fired(track(travelled(slowing(0.0))))
    assert had == {"stalled", "braked_without_cause"}
    assert in_words(had) == "stalled"


def test_a_leader_that_stands_is_a_cause():
    x = travelled(slowing(0.0))
    leader = {"leader": track(np.full(len(T), x[-1] + 9.0))}
    assert fired(track(x), None, leader) == set()
    beside = {"parked": track(np.full(len(T), x[-1] + 9.0), 6.0)}
    assert "stalled" in fired(track(x), None, beside)


@pytest.mark.parametrize(
    ("colour", "ahead_m", "had"),
    [
        ("red", 6.0, set()),
        ("yellow", 6.0, set()),
        ("green", 6.0, {"stalled", "braked_without_cause"}),
        ("red", 60.0, {"stalled", "braked_without_cause"}),
        ("red", -6.0, {"stalled", "braked_without_cause"}),
    ],
)
def test_a_light_ahead_that_is_not_green_is_a_cause(colour, ahead_m, had):
    """The recording met it at green."""
    x = travelled(slowing(0.0))
    log, scene = drive(track(x))
    line_m = x[-1] + ahead_m
    stop = np.array([[line_m, -2.0, 0.0], [line_m, 2.0, 0.0]])
    light = Signal(stop, 0.0, ((colour, 60_000_000),))
    scene = replace(scene, lane_map=LaneMap({}, (), signals=(light,)))
    series = evaluate_outcomes(log, scene, PRESETS["strict"])
    assert {metric.name for metric in series if bool(np.any(metric.value > 0))} == had


def test_a_road_user_that_is_about_to_cross_is_a_cause():
    v = np.where((T > 3) & (T < 6), 2.0, V)
    x = travelled(v)
    crossing = {"crossing": track(np.full(len(T), x[60] + 6.0), 12.0 - 2.5 * T)}
    assert fired(track(x)) == {"braked_without_cause"}
    assert fired(track(x), None, crossing) == set()


def test_a_long_body_across_the_road_is_a_cause_although_no_corner_is_on_the_path():
    x = travelled(slowing(0.0))
    log, scene = drive(track(x), None, {"bus": track(np.full(len(T), x[-1] + 9.0))})
    bus = log.actors["bus"]
    across = Trajectory(bus.track.t_us, bus.track.xyz, quat_from_yaw(np.full(len(T), np.pi / 2)))
    log.actors["bus"] = Actor("bus", "bus", Box(12.0, 2.5, 3.0), across)  # type: ignore[index]
    assert not any(
        bool(np.any(one.value > 0)) for one in evaluate_outcomes(log, scene, PRESETS["paper"])
    )


def seen_ahead(log, line, s, reach_m):
    """Say step by step, with each road user by itself, what `actor_ahead` says of all at once."""
    way = shapely.LineString(line)
    half = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [4.5 / 2, 1.8 / 2]
    out = []
    for step, (t_us, place, reach) in enumerate(zip(log.ego.t_us, s, reach_m, strict=True)):
        seen = False
        for actor in log.actors.values():
            for soon_us in (0, 1_000_000, 2_000_000):
                row = np.flatnonzero(actor.track.t_us == t_us + soon_us)
                if len(row):
                    middle = actor.track.xyz[row[0], :2]
                    away_m = np.hypot(*(middle - log.ego.xyz[step, :2]))
                    box = shapely.Polygon(middle + half)
                    corners = shapely.get_coordinates(box)[:4]
                    gap_m = max(way.project(shapely.Point(corner)) for corner in corners) - place
                    beside = box.distance(way) <= log.ego_box.width_m / 2 + 1.0
                    is_near = away_m < reach + np.hypot(4.5, 1.8) / 2
                    seen |= bool(is_near and beside and 0.0 < gap_m < reach + 4.5)
        out.append(seen)
    return np.array(out)


def test_road_users_ahead_are_those_that_are_found_one_by_one():
    rng = np.random.default_rng(5)
    actors = {
        f"car-{n}": track(
            rng.uniform(0, 80) + rng.uniform(-9, 9) * T, rng.uniform(-6, 6) + rng.uniform(-1, 1) * T
        )
        for n in range(6)
    }
    log, _ = drive(track(V * T), actors=actors)
    line = np.column_stack([np.arange(0.0, 97.0), 0.5 * np.sin(np.arange(0.0, 97.0) / 15.0)])
    s = V * T
    reach_m = np.linspace(15.0, 5.0, len(T))
    expected = seen_ahead(log, line, s, reach_m)
    assert 10 < expected.sum() < len(T) - 10
    preset = PRESETS["strict"]
    from_origin = line - origin_of(log.ego_log, preset)[:2]
    found = actor_ahead(log, preset, from_origin, s, reach_m, np.arange(len(T)))
    assert found.tolist() == expected.tolist()


def test_a_stop_of_the_recording_excuses_a_stop_there_but_not_a_longer_one():
    recorded = np.where((T > 3) & (T < 5), 0.0, V)
    assert fired(track(travelled(recorded)), track(travelled(recorded))) == set()
    forever = np.where(T > 3, 0.0, V)
    assert "stalled" in fired(track(travelled(forever)), track(travelled(recorded)))


def test_standing_at_the_end_of_the_path_is_no_stall():
    x = np.minimum(V * T, V * T[-1] / 2)
    assert fired(track(x), track(x)) == set()


def test_a_slow_ego_behind_the_end_of_the_recording_is_no_event_and_has_a_value():
    """The road goes on there; a policy that came farther than the recording is still compared."""
    half = len(T) // 2
    recorded = track((V * T)[:half])
    past_the_end = np.where(T[half] + 1.0 > T, V, np.maximum(V - 3.0 * (T - T[half] - 1.0), 0.0))
    log, scene = drive(track(travelled(past_the_end)), recorded)
    road = np.array([[V * T[half] + s, 0.0, 0.0] for s in np.arange(1.0, 80.0)])
    series = evaluate_outcomes(log, replace(scene, path_beyond=road), PRESETS["strict"])
    values = {one.name: one for one in series}
    for name in ("stalled", "braked_without_cause"):
        assert values[name].valid.all()
        assert not values[name].value.any()


@pytest.mark.parametrize(("aside_m", "left"), [(3.9, False), (4.1, True)])
def test_the_route_is_left_at_four_metres(aside_m, left):
    assert ("left_route" in fired(track(V * T, aside_m))) == left


def test_a_drive_far_from_the_origin_is_judged_alike():
    far = np.array([4.5e5, 5.4e6, 0.0])
    log, scene = drive(track(travelled(slowing(0.0))))
    moved = lambda one: Trajectory(one.t_us, one.xyz + far, one.quat)  # noqa: E731
    log = replace(log, ego=moved(log.ego), ego_log=moved(log.ego_log))
    scene = replace(scene, ego_log=moved(scene.ego_log))
    assert {
        one.name for one in evaluate_outcomes(log, scene, PRESETS["paper"]) if np.any(one.value > 0)
    } == {
        "stalled",
        "braked_without_cause",
    }


def test_a_recording_without_a_length_gives_no_value():
    for one in evaluate_outcomes(*drive(track(V * T), track(np.zeros(len(T)))), PRESETS["paper"]):
        if one.name != "ended_in_danger":
            assert not one.valid.any()
            assert "has no direction" in one.reason


def test_every_outcome_is_a_metric_or_a_failure_and_has_a_time_in_the_manifest():
    assert all(name in METRICS for name in OUTCOMES if name != "policy")
    log, scene = drive(track(travelled(slowing())))
    reduction = reduce_rollout(score(log, scene, "paper"), "paper")
    assert [event["metric"] for event in reduction.events] == ["braked_without_cause"]
    assert reduction.values["braked_without_cause"].value == 1.0


def test_outcomes_are_counted_by_arm_with_place_and_time():
    def manifest(policy, scene, **flags):
        metrics = {
            name: {"value": value, "valid": True, "reason": ""}
            for name, value in ({"progress": 1.0} | flags).items()
        }
        events = [{"metric": name, "t_s": 3.1} for name in flags]
        return {
            "renderer": "clean",
            "policy": policy,
            "scene": scene,
            "seed": 0,
            "status": "ok",
            "path": f"rollouts/clean/{policy}/{scene}/0",
            "wall_s": 1.0,
            "metrics": metrics,
            "events": events,
        }

    broken = manifest("b", "two") | {
        "status": "failed",
        "metrics": {},
        "error": {"failure_class": "policy", "message": "ValueError"},
    }
    lost = manifest("b", "three") | {
        "status": "failed",
        "metrics": {},
        "error": {"failure_class": "renderer", "message": "no"},
    }
    rollouts = [manifest("a", "one"), manifest("b", "one", offroad=1.0), broken, lost]
    manifests = [run_records.manifest(members) for members in rollouts]
    table = outcome_table(rollouts_of_table(rollout_table(manifests)), times_of(manifests))
    assert table["clean/a"].endings == {"reached the end": 1}
    assert table["clean/b"].endings == {"off-road": 1, "policy fault": 1, "not run": 1}
    (cell,) = table["clean/b"].outcomes["offroad"].cells
    assert (cell.scene, cell.t_s) == ("one", 3.1)
    assert (
        table["clean/b"].n_rollouts,
        table["clean/b"].n_ended,
        table["clean/b"].n_failed,
    ) == (3, 2, 2)


def test_two_logs_of_one_cell_have_times_of_their_own():
    offroad = {"offroad": {"value": 1.0, "valid": True, "reason": ""}}
    manifests = [
        run_records.manifest(
            {
                "path": f"rollouts/clean/p/s/{name}",
                "rollout": name,
                "metrics": offroad,
                "events": [{"metric": "offroad", "t_s": t_s}],
            }
        )
        for name, t_s in (("log 1", 2.0), ("log 2", 5.0))
    ]
    rollouts = rollouts_of_table(rollout_table(manifests))
    assert [rollout.key[-1] for rollout in rollouts] == ["log 1", "log 2"]
    (endings,) = outcome_table(rollouts, times_of(manifests)).values()
    assert [cell.t_s for cell in endings.outcomes["offroad"].cells] == [2.0, 5.0]


def test_where_a_preset_drives_on_the_fault_has_the_time_of_its_own_contact():
    """Who follows runs into the ego at 2 s; the ego runs into what stands at 5 s."""
    follower = track(np.concatenate([-12.6 + 12.0 * np.arange(21) * DT_S, np.full(99, 11.4)]))
    log, scene = drive(
        track(V * T), actors={"follows": follower, "stands": track(np.full(len(T), 44.6))}
    )
    _, scores = tabulate(log, score(log, scene, "nuplan"), "nuplan")
    began = outcome_events(scores.events)
    assert began["collision_any"].metric == "collision_rear"
    assert (began["collision_any"].t_s, began["collision_at_fault"].t_s) == (2.0, 5.0)
    assert first_failure(scores.events) == began["collision_at_fault"]


def test_presets_that_reproduce_alpasim_get_no_metric_that_it_does_not_have():
    assert evaluate_outcomes(*drive(track(travelled(slowing()))), PRESETS["alpasim"]) == []


def test_a_rollout_that_something_else_broke_has_no_outcome():
    assert (
        outcomes_of(Rollout("r", "p", "s", 0, "failed", "renderer", metrics={"offroad": 1.0}))
        == frozenset()
    )
