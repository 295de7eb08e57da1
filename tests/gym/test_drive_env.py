"""The Gymnasium environments: the API's own check, the same rollout as a run, the same scores, and
how episodes end.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import quat_from_yaw, se2, se3
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import EgoState, Plan, Trajectory
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.schema import LOG_NAME
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from evaluators import score
from policies.base import make_policy
from scenarios.load import load_scenario

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

import alpasim_plugin.gym as doors  # noqa: E402
from alpasim_plugin.gym.env import DriveEnv, HeldCommand  # noqa: E402
from alpasim_plugin.gym.reward import Reward, Scorer  # noqa: E402

SMALL = "cameras=[{width: 64, height: 36}]"
SHORT = ("timing.duration_us=1500000", "timing.warmup_us=300000")
STRAIGHT = "road.segments=[{kind: straight, length_m: 220}]"
STRAIGHT_ON = np.zeros(2, dtype=np.float32)


def finish(env, action=STRAIGHT_ON):
    """Repeat an action to the end of the episode; return the last reward, flags and info, and the
    number of steps.
    """
    for n in range(1, 200):
        _, worth, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return float(worth), terminated, truncated, info, n
    raise AssertionError("the episode does not end")


@pytest.mark.parametrize(
    ("name", "camera"),
    [pytest.param(doors.DRIVE, "front", marks=pytest.mark.slow), (doors.PLAN, "")],
)
@pytest.mark.filterwarnings("error::UserWarning")
def test_gymnasiums_own_check_finds_nothing(name, camera):
    env = gymnasium.make(
        name, overrides=(SMALL, *SHORT), camera=camera, render_mode="rgb_array" if camera else None
    )
    check_env(env.unwrapped, skip_close_check=True)
    if camera:
        assert env.unwrapped.render().shape == (36, 64, 3)
    env.close()


def test_stepping_with_a_policys_plans_is_the_rollout_of_a_run():
    env = DriveEnv(
        "smoke/lead_car",
        "trajectory",
        camera="",
        horizon_us=5_000_000,
        step_us=100_000,
        overrides=("timing.duration_us=2500000",),
    )
    _, info = env.reset(seed=3)
    policy = make_policy("pure-pursuit", env.scenario)
    policy.reset(info["seed"], env.scenario.route)
    policy.act(env.observation)  # of the first query in charge
    over = False
    while not over:
        plan = policy.act(env.observation)
        _, _, terminated, truncated, info = env.step(np.column_stack([plan.xy, plan.yaw])[1:])
        over = terminated or truncated
    stepped = read_asl(Path(env._episode.folder.name) / LOG_NAME)  # type: ignore[union-attr]

    class Recorded(Policy):
        """The same policy as the environment lets it drive: with a straight plan while the
        recording is forced.
        """

        sensors = env._sensors

        def reset(self, seed, route):
            self.own = make_policy("pure-pursuit", env.scenario)
            self.own.reset(seed, route)

        def act(self, observation):
            if observation.t_us < env.scenario.start_us + env.scenario.warmup_us:
                return forced(observation)
            plan = self.own.act(observation)
            return Plan(
                plan.t_us,
                plan.times_us,
                np.vstack([np.zeros(2), plan.xy[1:]]),
                np.r_[0.0, plan.yaw[1:]],
            )

    def forced(observation):
        times = observation.t_us + np.arange(0, 2_000_001, 100_000)
        xy = np.column_stack(
            [observation.ego.speed_mps * (times - times[0]) * 1e-6, np.zeros(len(times))]
        )
        return Plan(observation.t_us, times, xy, np.zeros(len(times)))

    with Recorder(env.scenario, stepped.seed, images="none") as recorder:
        run_rollout(
            env.scenario,
            make_renderer("clean", env.scenario, stepped.seed, threads=1),
            Recorded(),
            stepped.seed,
            recorder,
        )
    assert (Path(env._episode.folder.name) / LOG_NAME).read_bytes() == (
        recorder.folder / LOG_NAME
    ).read_bytes()  # type: ignore[union-attr]
    assert info["ended"] == "time"
    env.close()


def test_the_reward_is_that_of_the_evaluators_and_leaving_the_road_ends_the_episode():
    env = DriveEnv("smoke/curve", camera="")
    _, first = env.reset(seed=0)
    facts = [first]
    total = 0.0
    while True:
        _, worth, terminated, truncated, info = env.step(STRAIGHT_ON)
        facts.append(info)
        total += float(worth)
        if terminated or truncated:
            break
    assert (terminated, info["ended"]) == (True, "offroad")
    assert info["metrics"]["offroad"] == 1.0
    log = read_asl(Path(env._episode.folder.name) / LOG_NAME)  # type: ignore[union-attr]
    found = {one.name: one for one in score(log, env.scenario.scene, "paper")}
    at = np.searchsorted(log.ego.t_us, [one["t_us"] for one in facts])
    for name in ("lateral_distance_m", "progress"):
        assert_allclose(
            [one[name] for one in facts], found[name].value[at], atol=1e-5
        )  # poses in the log are float32
    assert np.flatnonzero(found["offroad"].value).tolist() == [len(log.ego.t_us) - 1]
    lateral = found["lateral_distance_m"].value[at]
    share = found["progress"].value[at]
    wanted = (
        0.1 * (share[-1] - share[0]) * found["gt_dist_traveled_m"].value[0]
        - 0.5 * 0.1 * lateral[1:].sum()
        - 5.0
    )
    assert total == pytest.approx(wanted, abs=1e-4)
    with pytest.raises(InputError, match=r"call reset\(\) first"):
        env.step(STRAIGHT_ON)
    env.close()


def test_an_instant_off_the_road_counts_in_the_step_that_it_ends_only():
    scenario = load_scenario("smoke/curve")
    log = scenario.ego_log
    poses = se3(log.xyz, log.quat)
    start, later = (EgoState(int(log.t_us[i]), poses[i], 5.0) for i in (0, len(poses) // 2))
    aside = replace(start, T_world_rig=start.T_world_rig @ se2(0.0, 6.0, 0.0))
    scorer = Scorer(scenario, "paper", Reward())
    _, ended, _ = scorer.score([(aside, {})])
    assert ended == "offroad"
    _, ended, _ = scorer.score([(later, {})])
    assert ended == ""


def test_progress_of_a_step_goes_on_from_the_step_before_when_the_recording_is_over():
    scenario = load_scenario("smoke/straight")
    x_m = np.arange(0.0, 100.0, 1.0)
    turn = np.linspace(-np.pi / 2, np.pi / 2, 20)
    legs = [
        np.column_stack([x_m, np.zeros(100)]),
        np.column_stack([100.0 + 6.0 * np.cos(turn), 6.0 + 6.0 * np.sin(turn)]),
        np.column_stack([x_m[::-1], np.full(100, 12.0)]),
    ]
    xyz = np.pad(np.concatenate(legs), ((0, 0), (0, 1)))
    ahead = np.gradient(xyz[:, :2], axis=0)
    first_us = int(scenario.ego_log.t_us[0])
    t_us = first_us + 100_000 * np.arange(len(xyz), dtype=np.int64)
    log = Trajectory(t_us, xyz, quat_from_yaw(np.arctan2(ahead[:, 1], ahead[:, 0])))
    scorer = Scorer(replace(scenario, ego_log=log), "paper", Reward())
    on_first_leg = [
        EgoState(first_us + 700_000 * i, se2(float(i), 0.0, 0.0), 10.0) for i in range(62)
    ]
    worths = [scorer.score([(ego, {})]) for ego in on_first_leg]
    gained = [worth for worth, _, _ in worths[1:]]
    shares = [metrics["progress"] for _, _, metrics in worths]
    assert gained == pytest.approx([0.1] * 61, abs=0.01)
    assert np.diff(shares) == pytest.approx(np.full(61, 1.0 / 217.0), abs=1e-3)


@pytest.mark.slow
def test_episodes_follow_from_the_seed_and_a_left_episode_leaves_nothing_behind():
    env = DriveEnv("smoke/curve", camera="", scene_seeds=(0, 1), overrides=SHORT)
    env.reset(seed=12)
    folder = Path(env._episode.folder.name)  # type: ignore[union-attr]
    first = [env.reset()[1] for _ in range(3)]
    assert not folder.exists()
    env.reset(seed=12)
    assert [env.reset()[1] for _ in range(3)] == first
    assert len({one["scene"] for one in first}) > 1
    assert len({one["seed"] for one in first}) == 3
    assert env.reset(options={"scene_seed": 1, "seed": 5})[1]["scene"] == "smoke-curve-seed1"
    env.close()


def test_wheel_and_pedals_do_what_they_say():
    env = DriveEnv("smoke/straight", camera="")
    env.reset(seed=0)
    assert isinstance(env._actions.controller, HeldCommand)
    before = env.observation.ego
    env.step(np.array([0.5, 0.0], dtype=np.float32))
    assert env.observation.ego.yaw_rate_radps > 0.0, "left is positive"
    assert env.observation.ego.speed_mps == pytest.approx(before.speed_mps)
    speeds = [
        float(env.step(np.array([0.0, -1.0], dtype=np.float32))[0]["speed"][0]) for _ in range(3)
    ]
    assert speeds[0] > speeds[1] > speeds[2]
    plan = env._actions.plan(np.array([0.0, 1.0]), env.observation)
    assert plan.xy[-1, 0] > 2.0 * env.observation.ego.speed_mps, (
        "the plan in the log is where the command leads"
    )
    env.close()


@pytest.mark.slow
def test_what_makes_no_environment_is_refused():
    for settings in (
        {"camera": "left"},
        {"actions": "words"},
        {"camera": "", "render_mode": "rgb_array"},
        {"preset": "alpasim"},
        {"step_us": 300_000},
        {"overrides": ("latency.kind=measured",)},
    ):
        with pytest.raises(InputError):
            DriveEnv(**settings)  # type: ignore[arg-type]
    env = DriveEnv(camera="", overrides=SHORT)
    env.reset()
    with pytest.raises(InputError):
        env.step(np.array([np.nan, 0.0]))
    env.close()


def blocks(name):
    page = Path(__file__).resolve().parents[2] / "docs" / name
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


@pytest.mark.slow
def test_the_example_of_the_page_runs():
    space = {}
    exec(compile(blocks("gym.md")[-1], "docs/gym.md", "exec"), space)
    assert space["seen"]["camera"].shape == (54, 96, 3)


@pytest.mark.slow
def test_environments_run_in_processes_and_agree_with_one_in_this_process():
    settings = {"camera": "", "overrides": SHORT}
    several = gymnasium.make_vec(
        doors.DRIVE,
        num_envs=2,
        vectorization_mode="async",
        vector_kwargs={"context": "spawn"},
        **settings,
    )
    seen, _ = several.reset(seed=[4, 5])
    one = DriveEnv(**settings)  # type: ignore[arg-type]
    own, _ = one.reset(seed=5)
    assert_array_equal(seen["route"][1], own["route"])
    for _ in range(3):
        seen, worth, *_ = several.step(np.array([[0.0, 0.2], [0.1, 0.0]], dtype=np.float32))
        own, alone, *_ = one.step(np.array([0.1, 0.0], dtype=np.float32))
    assert_array_equal(seen["route"][1], own["route"])
    assert worth[1] == pytest.approx(float(alone))
    several.close()
    one.close()


def test_a_brake_takes_effect_after_the_latency_of_the_scenario():
    overrides = ("latency.kind=fixed", "latency.fixed_us=500000", *SHORT)
    env = DriveEnv("smoke/straight", "controls", camera="", overrides=overrides)
    env.reset(seed=0)
    speeds = [env.observation.ego.speed_mps]
    for _ in range(7):
        env.step(np.array([0.0, -1.0], dtype=np.float32))
        speeds.append(env.observation.ego.speed_mps)
    assert_allclose(speeds[1:6], speeds[0], atol=0.05)
    assert speeds[7] < speeds[0] - 0.5
