"""What a renderer or a policy returns against its contract is that part's failure."""

import json
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import PolicyError, RendererError
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.plan_check import clock_problem, plan_problem
from alpasim_plugin.core.types import Frame, Plan
from alpasim_plugin.log.debug import FULL
from alpasim_plugin.log.run_folder.schema import DEBUG_NAME
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.runs import recorder
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.guards import checked_frames
from alpasim_plugin.runs.rollout import run_rollout
from policies.simple import ConstantVelocity
from scenarios.load import load_scenario

SCENE = load_scenario("smoke/straight")
REQUEST = recorded_requests(SCENE, SCENE.start_us)[0]
SHAPE = (REQUEST.camera.height, REQUEST.camera.width)
GOOD = Frame(REQUEST.t_us, REQUEST.camera.name, np.full((*SHAPE, 3), 90, dtype=np.uint8))


class Returns(Renderer):
    def render(self, request):
        raise AssertionError("frames are asked for in batches")

    def __init__(self, frame):
        self.frame = frame

    def render_batch(self, requests):
        return [self.frame for _ in requests]


def plane(value):
    return np.full(SHAPE, value, dtype=np.float32)


@pytest.mark.parametrize(
    "members",
    [
        {"rgb": None},
        {"rgb": GOOD.rgb.astype(float)},
        {"alpha": plane(5.0)},
        {"alpha": plane(-0.5)},
        {"alpha": "opaque"},
        {"depth": plane(-1e30)},
        {"depth": plane(1e30)},
        {"depth": plane(np.nan)},
        {"depth": plane(1.0).T},
        {"t_us": None},
    ],
    ids=str,
)
def test_a_frame_against_the_contract_is_the_renderers_failure(members):
    with pytest.raises(RendererError):
        checked_frames(Returns(replace(GOOD, **members)), [REQUEST])


@pytest.mark.parametrize("frame", [None, GOOD.rgb, "frame"], ids=["nothing", "array", "text"])
def test_what_is_no_frame_is_the_renderers_failure(frame):
    with pytest.raises(RendererError):
        checked_frames(Returns(frame), [REQUEST])


class Far(ConstantVelocity):
    def act(self, observation):
        plan = super().act(observation)
        return replace(plan, xy=plan.xy * 1e30)


def test_a_plan_that_no_road_is_long_enough_for_is_the_policys_failure():
    with pytest.raises(PolicyError):
        run_rollout(SCENE, make_renderer("clean", SCENE), Far(SCENE))
    times_us = np.array([0, 1], dtype=np.int64)
    samples = (np.full((2, 3), 1e30),)
    assert plan_problem(Plan(0, times_us, np.zeros((2, 2)), np.zeros(2), samples=samples), 0)
    samples = (np.zeros((2, 3)),) * 1001
    problem = plan_problem(Plan(0, times_us, np.zeros((2, 2)), np.zeros(2), samples=samples), 0)
    assert "1,001 sampled alternatives" in problem


@pytest.mark.parametrize(("samples", "poses"), [(0, 200_000), (999, 101)])
def test_a_plan_of_too_many_poses_is_refused(samples, poses):
    times = 1000 * np.arange(poses)
    alternatives = (np.zeros((poses, 3)),) * samples
    plan = Plan(0, times, np.zeros((poses, 2)), np.zeros(poses), alternatives)
    problem = plan_problem(plan, 0)
    assert f"{poses * (1 + samples):,} poses" in problem
    assert "100,000 are the most" in problem


def test_a_plan_whose_debug_is_no_dictionary_is_refused():
    plan = Plan(0, np.arange(4), np.zeros((4, 2)), np.zeros(4), debug=["nearest", 3])
    assert "debug is a list" in plan_problem(plan, 0)


NOW_US = 1_700_000_000_000_000
AHEAD_US = np.arange(0, 5_000_001, 500_000)


@pytest.mark.parametrize(
    "times_us",
    [
        (NOW_US + AHEAD_US) // 1000,
        (NOW_US + AHEAD_US) * 1000,
        AHEAD_US,
        NOW_US + 20_000_000 + AHEAD_US,
        NOW_US - 6_000_000 + AHEAD_US,
    ],
    ids=["milliseconds", "nanoseconds", "own clock", "later", "over"],
)
def test_a_plan_of_another_clock_is_refused(times_us):
    assert clock_problem(times_us, NOW_US)
    assert clock_problem(NOW_US + AHEAD_US, NOW_US) == ""
    assert clock_problem(NOW_US - 400_000 + AHEAD_US, NOW_US) == "", "made for an earlier query"


def test_a_plan_that_counts_in_nanoseconds_is_the_policys_failure():
    times_us = NOW_US + 1000 * AHEAD_US
    plan = Plan(NOW_US, times_us, np.zeros((len(times_us), 2)), np.zeros(len(times_us)))
    assert "not in microseconds" in plan_problem(plan, NOW_US)


class Talks(ConstantVelocity):
    def act(self, observation):
        return replace(super().act(observation), debug={"boxes": np.ones((1000, 4))})


def test_what_a_policy_says_of_itself_has_a_budget_in_a_rollout(monkeypatch):
    monkeypatch.setattr(recorder, "MOST_BYTES", 50_000)
    done = run_rollout(SCENE, make_renderer("clean", SCENE), Talks(SCENE))
    rows = [json.loads(line) for line in (done.folder / DEBUG_NAME).read_text().splitlines()]
    assert [bool(row["boxes"]) for row in rows] == [True, False]
    assert rows[-1]["text"] == [["debug", FULL]]
