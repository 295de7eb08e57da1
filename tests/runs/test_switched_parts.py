"""Parts that are switched while a rollout goes on, as a fork does."""

from dataclasses import dataclass, field

import pytest

from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import SensorSpec
from alpasim_plugin.runs.fork import SwitchedPolicy, merge_sensors
from scenarios.load import load_scenario


@dataclass
class Recording(Policy):
    """Remembers the seeds that it was reset with."""

    sensors: tuple = ()
    seeds: list = field(default_factory=list)

    def reset(self, seed, route):
        self.seeds.append(seed)

    def act(self, observation):
        raise AssertionError("nothing is driven here")


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("smoke/straight")


def test_each_policy_is_reset_with_its_own_seed(scenario):
    first = Recording()
    then = Recording()
    SwitchedPolicy(first, then, 500_000, 7, scenario).reset(3, None)
    assert (first.seeds, then.seeds) == ([3], [7])
    alone = Recording()
    SwitchedPolicy(alone, alone, 500_000, 7, scenario).reset(3, None)
    assert alone.seeds == [3]


def test_a_camera_of_both_policies_has_the_shorter_period(scenario):
    slow = SensorSpec("front", 400_000)
    fast = SensorSpec("front", 200_000)
    left = SensorSpec("left", 300_000)
    assert merge_sensors((slow,), (fast, left), scenario) == (fast, left)
    assert merge_sensors((left, fast), (slow,), scenario) == (left, fast)
