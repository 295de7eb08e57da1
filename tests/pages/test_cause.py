"""Which plans the page of a failure shows."""

import re
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import LoggedPlan, Trajectory
from alpasim_plugin.log.run_folder.records import Contact, DriveEvent
from alpasim_plugin.runs.scoring import tabulate
from evaluators import score
from evaluators.metrics.outcomes import first_failure
from evaluators.pages.cause import AFTER_US, BEFORE_US, MOST_QUERIES, commands, shown_plans
from evaluators.statistics.evidence import (
    Failure,
    asked_mps,
    contact_of_failure,
    failure_facts,
    words_of,
)
from tests.evaluators.eval_build import TWO_LANES, car, rollout, scene, track

STEP_US = 50_000


def log_of(count, poses=4):
    def plan(now_us):
        t_us = now_us + STEP_US * np.arange(poses)
        quat = quat_from_yaw(np.full(poses, 3.1))
        return LoggedPlan(now_us, now_us + STEP_US, Trajectory(t_us, np.zeros((poses, 3)), quat))

    return SimpleNamespace(plans=[plan(STEP_US * i) for i in range(count)])


@pytest.mark.parametrize("count", [1, MOST_QUERIES, MOST_QUERIES + 1, 100, 200, 1001])
def test_plans_are_thinned_evenly_and_the_last_one_stays(count):
    log = log_of(count)
    times = [plan.now_us for plan in shown_plans(log, None)]
    assert times[-1] == log.plans[-1].now_us
    assert MOST_QUERIES / 2 < len(times) <= MOST_QUERIES or len(times) == count
    assert len(set(np.diff(times))) <= 1


def test_plans_around_a_failure_are_shown_to_the_last_that_it_can_have_come_of():
    failed_us = BEFORE_US + 40 * STEP_US
    log = log_of(failed_us // STEP_US + AFTER_US // STEP_US + 30)
    times = [plan.now_us for plan in shown_plans(log, failed_us)]
    assert times[-1] == failed_us + AFTER_US // STEP_US * STEP_US
    assert times[0] >= failed_us - BEFORE_US
    assert not shown_plans(log_of(5, poses=1), None)


@pytest.mark.parametrize("poses", [2, 3, 10, 20, 41, 101])
def test_a_plan_of_constant_speed_asks_for_that_speed_however_long_it_is(poses):
    t_us = STEP_US * np.arange(poses)
    xyz = np.column_stack([8e-6 * t_us, np.zeros(poses), np.zeros(poses)])
    plan = LoggedPlan(0, 0, Trajectory(t_us, xyz, quat_from_yaw(np.zeros(poses))))
    assert asked_mps(plan) == pytest.approx(8.0)


def test_a_fork_without_a_parting_begins_before_the_failure_and_quotes_its_renderer():
    rollout = SimpleNamespace(
        ok=True, cell=("clean", "mine", "curve", 0), renderer="clean", path="rollout.asl"
    )
    parting = SimpleNamespace(at_s=2.0, kind="renderer", name="fault(brightness=0.5)")
    run = SimpleNamespace(folder=Path("runs/a"))
    cause = SimpleNamespace(rollout=rollout, partings=[], failed_s=5.0)
    assert "--at 2.0 --renderer 3dgs" in commands(run, cause)[0][2]
    cause.partings = [parting]
    assert shlex.split(commands(run, cause)[0][2])[-1] == parting.name


def straight_plans(log):
    """Return a plan each half second: straight on at 8 m/s, in the rig's place."""
    t_us = 100_000 * np.arange(31)
    rear_m = float(log.T_rig_box[0, 3])
    plans = []
    for now_us in range(0, int(log.ego.t_us[-1]), 500_000):
        x = 8e-6 * (now_us + t_us) - rear_m
        xyz = np.column_stack([x, 0 * x, 0 * x])
        poses = Trajectory(now_us + t_us, xyz, quat_from_yaw(np.zeros(len(t_us))))
        route = np.column_stack([np.arange(0.0, 60.0), np.zeros(60)])
        plans.append(LoggedPlan(now_us, now_us, poses, route=route))
    return tuple(plans)


def drive_into(x_m, warmup_us=0, **more):
    """Return a drive at 8 m/s along x into what stands with its middle at ``x_m``, its first
    failure, and its contacts.
    """
    log = rollout(
        track(8.0 * 0.1 * np.arange(80), 0.0),
        [car("stands", track(np.full(80, x_m), 0.0)), *more.values()],
        warmup_us=warmup_us,
    )
    log = replace(log, plans=straight_plans(log))
    _, scores = tabulate(log, score(log, scene(TWO_LANES, log), "strict"), "strict")
    return log, first_failure(scores.events), scores.contacts


def test_a_contact_after_the_failure_is_not_what_it_failed_with():
    log, failure, contacts = drive_into(40.0)
    assert contact_of_failure(log, failure, contacts).actor_id == "stands"
    offroad = DriveEvent("offroad", 3_000_000, 3.0, 24.0, 0.0)
    assert contacts[0].t_s > offroad.t_s
    assert contact_of_failure(log, offroad, contacts) is None
    sentences = failure_facts(Failure.of(log, offroad.t_us, frozenset({"offroad"}), None, {}))
    assert not any("leads into" in text or "brakes" in text for text in sentences)


def test_a_contact_of_the_warm_up_is_not_what_it_failed_with():
    behind = car("pushes", track(np.full(80, -4.0), 0.0))
    log, failure, contacts = drive_into(40.0, warmup_us=1_000_000, behind=behind)
    assert [contact.actor_id for contact in contacts] == ["pushes", "stands"]
    assert contact_of_failure(log, failure, contacts).actor_id == "stands"
    early = replace(failure, t_us=1_000_000)
    assert contact_of_failure(log, early, contacts) is None


def test_evidence_about_a_contact_says_who_is_where_and_counts_from_the_contact_itself():
    log, failure, contacts = drive_into(40.0)
    contact = contact_of_failure(log, failure, contacts)
    facts = failure_facts(Failure.of(log, failure.t_us, frozenset({"collision_any"}), contact, {}))
    assert facts[0].startswith("In the last second no plan brakes, at 8.0 m/s")
    assert facts[0].endswith("leads into the car ahead (`stands`).")
    # 16 m before it: 8 m/s end with 2 m/s2 after 16 m
    assert facts[1].startswith("No plan of the 4.4 s before the contact brakes")
    assert re.search(r"braking with 2\.[01] m/s2 from 2.0 s before on would", facts[1])
    # touched at 4.42 s; the plan of 1.5 s is the first that reaches so far
    assert facts[2].startswith("Every plan of the last 2.9 s")
    assert facts[2].endswith("before the failure leads into the car ahead (`stands`).")


def test_who_was_touched_is_named_by_kind_and_place():
    actor = car("a", track([0.0], 0.0))
    contact = Contact("a", 1.0, "lateral", 1.0, 0.9)
    assert words_of(actor, contact) == "the car on the left (`a`)"
    assert words_of(actor, replace(contact, y_m=-0.9)) == "the car on the right (`a`)"
    assert words_of(replace(actor, label="pedestrian"), replace(contact, side="front")) == (
        "the pedestrian ahead (`a`)"
    )
    other = replace(actor, label="other")
    assert words_of(other, replace(contact, side="rear")) == "the road user behind (`a`)"
    standing = replace(other, actor_id="obstacle-001-within-0.3m")
    assert words_of(standing, replace(contact, side="front")).startswith("the standing obstacle")
