"""What is said of the second before a failure, on drives made of a few numbers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import LoggedPlan, Trajectory
from alpasim_plugin.log.run_folder.records import Contact
from evaluators.statistics.alike import common_to_failures
from evaluators.statistics.approach import approach_of, neighbour_at, turn_around
from evaluators.statistics.evidence import Failure, failure_facts
from tests.evaluators.eval_build import DT_US, car, rollout, track

OFFROAD = frozenset({"offroad"})
TIMES = 0.1 * np.arange(60)
LANE = {"kind": "vehicle", "centre": [[-50.0, 0.0], [300.0, 0.0]], "limit_mps": 13.9}
NO_ROUTE = np.zeros((0, 2))


def plans_at(log, mps, route=NO_ROUTE):
    """Return a plan a step of the log, straight on with a speed at each step."""
    t_us = DT_US * np.arange(21)
    speeds_mps = np.broadcast_to(mps, len(log.ego))
    plans = []
    for now_us, xyz, speed_mps in zip(log.ego.t_us, log.ego.xyz, speeds_mps, strict=True):
        x = xyz[0] - float(log.T_rig_box[0, 3]) + speed_mps * 1e-6 * t_us
        poses = np.column_stack([x, np.full(len(x), xyz[1]), 0 * x])
        line = Trajectory(now_us + t_us, poses, quat_from_yaw(np.zeros(len(x))))
        plans.append(LoggedPlan(int(now_us), int(now_us), line, route=route))
    return replace(log, plans=tuple(plans))


def facts_of(log, outcomes=OFFROAD, contact=None, lanes=()):
    """Return what is said of a drive that fails at its last step."""
    content = {"lanes": list(lanes)}
    return failure_facts(Failure.of(log, int(log.ego.t_us[-1]), outcomes, contact, content))


def test_a_speed_is_compared_with_the_recording_at_the_same_place_and_with_the_posted_limit():
    recorded = track(8.0 * 0.1 * np.arange(200), 0.0)
    fast = rollout(track(16.0 * TIMES, 0.0), log=recorded)
    sentence = facts_of(fast, lanes=[LANE])[0]
    assert "it drives 16.0 m/s where the recording drives 8.0 m/s; 13.9 m/s are posted." in sentence
    assert not facts_of(rollout(track(8.0 * TIMES, 0.0), log=recorded))
    other_way = LANE | {"centre": [[300.0, 0.0], [-50.0, 0.0]]}
    assert "posted" not in facts_of(fast, lanes=[other_way])[0]


@pytest.mark.parametrize(("sign", "side"), [(1.0, "left"), (-1.0, "right")])
def test_an_offset_has_its_side_and_its_bend(sign, side):
    angle = 8.0 * TIMES / 40.0 * sign
    x, y = 40.0 * np.sin(angle) * sign, 40.0 * (1.0 - np.cos(angle)) * sign
    recorded = track(x, y, angle)
    out = 1.5 * np.clip(TIMES - 4.9, 0.0, 1.0)  # to the outside, in the last second
    ego = track(x + sign * out * np.sin(angle), y - sign * out * np.cos(angle), angle)
    other = {"left": "right", "right": "left"}[side]
    (sentence,) = facts_of(rollout(ego, log=recorded))
    assert sentence == (
        f"In the last second it moves from 0.0 to 1.5 m {other} of the recorded path, on the "
        f"outside of a {side}-hand bend."
    )


def test_a_drive_that_swings_farther_and_farther_is_said_to_swing():
    swing = 0.25 * TIMES * np.sin(2.2 * TIMES)
    straight = track(8.0 * TIMES, 0.0)
    sentence = facts_of(rollout(track(8.0 * TIMES, swing), log=straight))[0]
    assert sentence.startswith("Before the failure it swings from side to side")
    once = rollout(track(8.0 * TIMES, 0.3 * TIMES), log=straight)
    assert not any("swings" in text for text in facts_of(once))


def drive_into(accel_mps2, asked_mps2):
    """Return a drive at 10 m/s that brakes 3 s before it touches a standing car, and its contact;
    its plans ask for a braking from then on.
    """
    braking_s = np.maximum(TIMES - 2.95, 0.0)
    x = 10.0 * TIMES - accel_mps2 * braking_s**2 / 2
    front_m = x[-1] + 4.855 / 2
    log = rollout(track(x, 0.0), [car("stands", track(np.full(60, front_m + 2.25), 0.0))])
    v = 10.0 - accel_mps2 * braking_s
    log = plans_at(log, np.where(braking_s > 0.0, v - asked_mps2, v))
    return log, Contact("stands", 5.9, "front", 3.8, 0.0)


def test_the_last_second_of_braking_is_compared_with_what_would_have_been_enough():
    log, contact = drive_into(2.0, 2.0)
    sentence = facts_of(log, frozenset({"collision_any"}), contact)[0]
    assert sentence.startswith("In the last second it brakes from 6.1 to 4.2 m/s, with 1.9 m/s2")
    # 20.3 m are left 2.9 s before: 10 m/s end there with 2.46 m/s2
    assert "2.9 s before, 2.5 m/s2 would have been enough" in sentence
    assert "(`stands`)" in sentence


def test_plans_that_brake_no_more_are_told_from_those_that_never_did():
    log, contact = drive_into(0.0, 0.0)
    sentences = facts_of(log, frozenset({"collision_any"}), contact)
    assert sentences[0].startswith("In the last second no plan brakes, at 10.0 m/s, and leads into")
    assert sentences[1].startswith("No plan of the 5.9 s before the contact brakes; braking with")
    asked = np.where((TIMES > 2.0) & (TIMES < 2.25), 5.0, 10.0)
    sentences = facts_of(plans_at(log, asked), frozenset({"collision_any"}), contact)
    assert sentences[0].startswith("In the last second no plan brakes")
    assert (
        sentences[1]
        .replace("\u00a0", " ")
        .startswith("2 earlier plans braked, the last 3.7 s before the contact")
    )


def test_a_contact_says_that_the_ego_is_faster_than_a_recording_that_slows_down_ever_is():
    slowing = np.clip(9.0 - 1.5 * TIMES, 0.0, None)
    recorded = track(np.concatenate([[0.0], np.cumsum(0.1 * slowing)[:-1]]), 0.0)

    def sentences_at(accel_mps2):
        x = 9.0 * TIMES + accel_mps2 * TIMES**2 / 2
        stands = car("stands", track(np.full(60, x[-1] + 4.855 / 2 + 2.25), 0.0))
        log = plans_at(rollout(track(x, 0.0), [stands], log=recorded), 9.0 + accel_mps2 * TIMES)
        contact = Contact("stands", 5.9, "front", 3.8, 0.0)
        return facts_of(log, frozenset({"collision_any"}), contact, [LANE])

    assert sentences_at(1.0)[0] == (
        "At the failure it drives 14.8 m/s; up to there the recording drives at most 9.0 m/s; "
        "13.9 m/s are posted."
    )
    assert sentences_at(0.0)[0].startswith("In the last second no plan brakes")


def test_a_slow_drive_says_who_is_ahead_and_whether_in_the_way():
    recorded = track(10.0 * 0.1 * np.arange(200), 0.0)
    x = np.concatenate([TIMES[:30] * 10.0, np.full(30, 29.0) + 0.5 * TIMES[:30]])
    stalled = frozenset({"stalled"})

    def sentence(*actors):
        return facts_of(rollout(track(x, 0.0), actors, log=recorded), stalled)[0]

    assert sentence().endswith("where the recording drives 10.0 m/s; nobody is ahead of it.")
    oncoming = car("meets", track(np.linspace(90.0, 40.0, 60), 3.5, np.pi))
    assert "nobody is in its way: the nearest is the oncoming car (`meets`)" in sentence(oncoming)
    assert sentence(oncoming).endswith("and 3.5 m to the left.")
    assert "the car (`waits`) is" in sentence(car("waits", track(np.full(60, 40.0), 0.3)))


def test_one_plan_for_many_queries_counts_where_the_route_near_by_has_moved():
    log = rollout(track(8.0 * TIMES, 0.0))
    ahead_m = 4.0 * np.arange(20)
    held = plans_at(log, 8.0)
    still = plans_at(log, 8.0, np.column_stack([ahead_m, 0 * ahead_m]))
    moved = [
        replace(plan, route=np.column_stack([ahead_m, 0.01 * k * ahead_m]))
        for k, plan in enumerate(held.plans)
    ]
    assert not any("same plan" in text for text in facts_of(still))
    sentence = facts_of(replace(log, plans=tuple(moved)))[0].replace("\u00a0", " ")
    assert sentence == "Plans lead straight on in 60 queries in a row, where the route turns left."
    bent = [replace(plan, trajectory=bent_line(plan.trajectory)) for plan in moved]
    sentence = facts_of(replace(log, plans=tuple(bent)))[0].replace("\u00a0", " ")
    assert sentence.startswith("60 queries in a row get the same plan, seen from the ego")


def bent_line(line):
    """Return a plan's line that bends to the left."""
    x = line.xyz[:, 0] - line.xyz[0, 0]
    return replace(line, xyz=line.xyz + np.column_stack([0 * x, 0.02 * x**2, 0 * x]))


def test_the_nearest_ahead_and_the_turn_of_a_path():
    log = rollout(
        track([0.0, 1.0], 0.0),
        [car("far", track([30.0, 30.0], 0.0)), car("near", track([12.0, 12.0], 3.0))],
    )
    ahead = neighbour_at(log, 0)
    assert ahead is not None
    assert (ahead.actor.actor_id, ahead.is_in_way, ahead.towards) == ("near", False, False)
    assert neighbour_at(rollout(track([0.0, 1.0], 0.0)), 0) is None
    angle = np.linspace(0.0, 1.5, 200)
    circle = 50.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    assert turn_around(circle, np.array([37.5]))[0] == pytest.approx(0.56, abs=0.05)


def test_a_recording_that_stands_has_nothing_to_compare_with():
    log = rollout(track(8.0 * TIMES, 0.0), log=track(np.zeros(60), 0.0))
    assert approach_of(log, int(log.ego.t_us[-1]), {}) is None
    assert facts_of(log) == []


class Rollouts:
    """A run of which some scenes fail: by name, whether, and in what surroundings.

    All lie on one straight road, but for those whose name begins with "far".
    """

    def __init__(self, scenes):
        self.rollouts = [
            SimpleNamespace(
                renderer="clean",
                policy="mine",
                scene=name,
                ok=True,
                flag=lambda name, failed=failed: failed and name == "stalled",
            )
            for name, failed, _ in scenes
        ]
        self.info = SimpleNamespace(
            scenes={
                name: SimpleNamespace(environment={"time": "day"} | surroundings)
                for name, _, surroundings in scenes
            }
        )

    def scene_data(self, scene):
        bend = 0.01 if scene.startswith("far") else 0.0
        x = np.arange(100.0)
        return {"ego_log": {"x_m": x.tolist(), "y_m": (bend * x**2).tolist()}}

    def manifest(self, rollout):
        return None


def common(scenes):
    run = Rollouts(scenes)
    return common_to_failures(run, run.rollouts[0])


def test_failures_at_night_alone_are_decisive_on_the_same_road_or_with_three_on_each_side():
    night = {"time": "night"}
    (fact,) = common([("a", True, night), ("b", False, {})])
    assert fact.decisive
    assert fact.sentence == (
        "It fails at night alone: in 1 of 1 rollouts at night, in 0 of 1 by day, on the same road "
        "in b."
    )
    (fact,) = common([("a", True, night), ("far", False, {})])
    assert not fact.decisive
    three = [(f"{k}", True, night) for k in range(3)]
    (fact,) = common([*three, *((f"far-{k}", False, {}) for k in range(3))])
    assert fact.decisive
    assert not common([("a", True, night), ("b", False, night)])
    assert not common([("a", True, night), ("b", True, {}), ("c", False, {})])


def test_failures_in_rain_are_told_from_those_of_the_time_of_day():
    (fact,) = common([("a", True, {"rain": 8.0}), ("b", False, {})])
    assert fact.sentence.startswith("It fails in rain alone: in 1 of 1 rollouts in rain")
