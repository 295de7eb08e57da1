"""The policies that see nothing: exact poses, straight lines, routes; and names that are wrong."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.control import make_controller
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.geometry import interpolate, inverse, se2, trajectory_from_poses, yaw_of
from alpasim_plugin.core.types import EgoState, Observation, Plan, Route, Vehicle
from policies.base import make_policy
from policies.conformance import START_US, canned_scenario
from tests.policies.policy_world import NO_ROUTE, to_world

SCENARIO = canned_scenario()


def blind(ego, route=NO_ROUTE):
    return Observation(
        ego.t_us, {}, {}, ego, trajectory_from_poses([ego.t_us], ego.T_world_rig[None]), route
    )


def curved_log():
    t = START_US + 50_000 * np.arange(200)
    s = 0.4 * np.arange(200)
    poses = [se2(3e5 + 40 * np.sin(a / 40), 4e6 + 40 * (1 - np.cos(a / 40)), a / 40) for a in s]
    return replace(SCENARIO, ego_log=trajectory_from_poses(t, np.array(poses)))


def test_log_replay_with_the_perfect_controller_is_the_log():
    scenario = curved_log()
    policy = make_policy("log-replay", scenario)
    controller = make_controller(policy.controller, Vehicle())  # type: ignore[attr-defined]
    ego = EgoState(START_US, interpolate(scenario.ego_log, START_US), 8.0)
    for _ in range(60):
        plan = policy.act(blind(ego))
        ego = controller.advance(ego, to_world(plan, ego.T_world_rig), ego.t_us + 100_000)
        truth = interpolate(scenario.ego_log, ego.t_us)
        assert np.hypot(*(ego.T_world_rig - truth)[:2, 3]) < 1e-6
        assert abs(yaw_of(inverse(truth) @ ego.T_world_rig)) < 1e-9


def test_log_replay_ends_its_plan_with_the_log():
    scenario = curved_log()
    last = int(scenario.ego_log.t_us[-1])
    plan = make_policy("log-replay", scenario).act(
        blind(EgoState(last - 1_000_000, np.eye(4), 8.0))
    )
    assert plan.times_us[-1] <= last
    assert len(plan.times_us) == 11


def test_log_replay_outside_its_log_is_an_error_and_not_a_guess():
    with pytest.raises(InputError):
        make_policy("log-replay", curved_log()).act(blind(EgoState(START_US - 1, np.eye(4), 8.0)))


@pytest.mark.parametrize("speed", [0.0, 13.0, -2.0])
def test_constant_velocity_goes_straight_on(speed):
    plan = make_policy("constant-velocity", SCENARIO).act(
        blind(EgoState(START_US, se2(5, 5, 2.0), speed))
    )
    assert plan.xy[10] == pytest.approx([speed, 0.0])
    assert not plan.yaw.any()


def arc_route(radius):
    a = np.arange(20) * 80 / 19 / abs(radius)
    return np.column_stack(
        [abs(radius) * np.sin(a), np.sign(radius) * abs(radius) * (1 - np.cos(a)), 0 * a]
    )


def pursue(route, speed):
    policy = make_policy("pure-pursuit", SCENARIO)
    policy.reset(0, Route(np.zeros((2, 3))))
    return policy.act(blind(EgoState(START_US, np.eye(4), speed), route))


@pytest.mark.parametrize("radius", [25.0, -25.0, 60.0, -200.0])
def test_pure_pursuit_stays_on_a_circle(radius):
    plan = pursue(arc_route(radius), 6.0)
    off = np.hypot(plan.xy[:, 0], plan.xy[:, 1] - radius) - abs(radius)
    assert np.abs(off).max() < 0.15


def test_pure_pursuit_slows_down_before_a_bend_it_cannot_take_at_speed():
    a = np.linspace(0, 1.5, 12)
    straight = np.column_stack([np.arange(0, 32, 4.2), np.zeros(8)])
    bend = np.concatenate([straight, np.column_stack([32 + 15 * np.sin(a), 15 * (1 - np.cos(a))])])
    route = np.column_stack([bend, np.zeros(len(bend))])
    speeds = np.hypot(*np.diff(pursue(route, 14.0).xy, axis=0).T) / 0.1
    assert speeds[0] > 13.0
    assert speeds[-1] < 9.5
    unhurried = np.hypot(*np.diff(pursue(arc_route(1e6), 14.0).xy, axis=0).T) / 0.1
    assert unhurried[-1] == pytest.approx(14.0, abs=0.1)


def test_pure_pursuit_sets_off_from_standstill_and_keeps_its_first_speed_as_cruise():
    policy = make_policy("pure-pursuit", SCENARIO)
    policy.reset(0, Route(np.zeros((2, 3))))
    plan = policy.act(blind(EgoState(START_US, np.eye(4), 0.0), arc_route(1e6)))
    assert plan.xy[-1, 0] > 8.0
    assert (
        policy.act(blind(EgoState(START_US + 100_000, np.eye(4), 9.0), arc_route(1e6))).debug[
            "cruise_mps"
        ]
        == 6.0
    )


@pytest.mark.parametrize("route", [NO_ROUTE, np.where(np.arange(20)[:, None] < 1, 0.0, NO_ROUTE)])
def test_pure_pursuit_without_a_route_goes_straight(route):
    plan = pursue(route, 7.0)
    assert np.abs(plan.xy[:, 1]).max() < 1e-9
    assert plan.xy[-1, 0] == pytest.approx(35.0, abs=0.5)  # 5 s at 7 m/s


# --- names


class Bare:
    """A policy of a third party that needs no scenario."""

    sensors: tuple[()] = ()

    def reset(self, seed, route): ...

    def act(self, observation):
        return Plan(
            observation.t_us,
            observation.t_us + 100_000 * np.arange(30),
            np.zeros((30, 2)),
            np.zeros(30),
        )


class WithScenario(Bare):
    def __init__(self, scenario):
        self.scenario = scenario


class NotAPolicy:
    def act(self, observation): ...


def test_import_form_makes_a_class_with_or_without_the_scenario():
    assert isinstance(make_policy(f"{__name__}:Bare", SCENARIO), Bare)
    made = make_policy(f"{__name__}:WithScenario", SCENARIO)
    assert isinstance(made, WithScenario)
    assert made.scenario.scene_id == SCENARIO.scene_id
    assert not made.scenario.ego_log.xyz.flags.writeable  # the next policy sees the same scenario


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("pure-persuit", "did you mean 'pure-pursuit'"),
        ("no_such_package.x:Y", "ModuleNotFoundError"),
        (f"{__name__}:Missing", "has no 'Missing'"),
        (f"{__name__}:NotAPolicy", "without sensors, reset"),
    ],
)
def test_wrong_name_says_what_is_wrong(name, text):
    with pytest.raises((InputError, PolicyError), match="policy") as caught:
        make_policy(name, SCENARIO)
    assert text in str(caught.value)
