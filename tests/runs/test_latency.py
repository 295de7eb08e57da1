"""Which plan is in force when."""

import numpy as np

from alpasim_plugin.core.types import Latency, Trajectory
from alpasim_plugin.runs.loop_state import PlanQueue


def plan(t_us):
    return Trajectory(np.array([t_us]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]))


def test_fixed_latency_holds_the_older_plan_until_the_newer_is_due():
    queue = PlanQueue(Latency("fixed", 150_000))
    first = plan(0)
    second = plan(100_000)
    queue.submit(first, 0, 0)
    assert queue.active(100_000) is None
    queue.submit(second, 100_000, 0)
    assert queue.active(200_000) is first
    assert queue.active(250_000) is second


def test_a_slow_answer_never_replaces_a_newer_fast_one():
    queue = PlanQueue(Latency("measured"))
    slow = plan(0)
    fast = plan(100_000)
    queue.submit(slow, 0, wall_us=500_000)
    queue.submit(fast, 100_000, wall_us=10_000)
    assert queue.active(110_000) is fast
    assert queue.active(500_000) is fast


def test_a_query_waits_until_the_fixer_is_done_with_its_frames():
    queue = PlanQueue(Latency("measured", fixer=True))
    queue.frames(0, {"fix": 20.0, "map": 10.0})  # ms
    now = plan(0)
    queue.submit(now, 0, wall_us=5_000)
    assert queue.active(34_999) is None
    assert queue.active(35_000) is now


def test_a_fixer_slower_than_the_camera_falls_behind():
    queue = PlanQueue(Latency("measured", fixer=True))
    for t_us in (0, 100_000, 200_000):
        queue.frames(t_us, {"fix": 150.0})
    late = plan(200_000)
    queue.submit(late, 200_000, wall_us=0)
    assert queue.active(449_999) is None
    assert queue.active(450_000) is late


def test_the_fixer_counts_only_where_asked_for():
    queue = PlanQueue(Latency("measured"))
    queue.frames(0, {"fix": 150.0})
    now = plan(0)
    queue.submit(now, 0, wall_us=5_000)
    assert queue.active(5_000) is now


def test_a_copy_of_the_queue_goes_its_own_way():
    queue = PlanQueue(Latency("fixed", 50_000))
    now = plan(0)
    queue.submit(now, 0, 0)
    ahead = queue.copy()
    assert ahead.active(60_000) is now
    ahead.submit(plan(60_000), 60_000, 0)
    assert queue.active(40_000) is None
    assert queue.active(500_000) is now
