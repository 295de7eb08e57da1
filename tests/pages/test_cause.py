"""Which plans the page of a failure shows."""

import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import LoggedPlan, Trajectory
from evaluators.pages.cause import AFTER_US, BEFORE_US, MOST_QUERIES, commands, shown_plans
from evaluators.pages.evidence import asked_mps

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
