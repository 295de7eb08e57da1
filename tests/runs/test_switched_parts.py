"""Parts that are switched while a rollout goes on, as a fork does."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.interfaces import Controller, Policy, Renderer
from alpasim_plugin.core.types import Frame, SensorSpec
from alpasim_plugin.runs.fork import SwitchedController, SwitchedPolicy, merge_sensors
from alpasim_plugin.runs.rollout import run_rollout
from policies.simple import ConstantVelocity
from scenarios.load import load_scenario


@dataclass
class Recording(Policy):
    """Remembers the seeds that it was reset with, and what else it is called for."""

    name: str = ""
    sensors: tuple = ()
    seeds: list = field(default_factory=list)
    calls: list = field(default_factory=list)

    def reset(self, seed, route):
        self.seeds.append(seed)

    def act(self, observation):
        raise AssertionError("nothing is driven here")

    def end(self, frames):
        self.calls.append("end")

    def close(self):
        self.calls.append("close")

    def facts(self):
        return {"name": self.name} if self.name else {}


class ClosesBadly(Recording):
    def close(self):
        super().close()
        raise RuntimeError("the session is gone")


class Looks(ConstantVelocity):
    """Remembers when the frames were made that it saw at each query, by camera."""

    def __init__(self, *sensors):
        self.sensors = sensors
        self.views = []

    def act(self, observation):
        self.views.append({name: one.t_us for name, one in observation.frames.items()})
        assert set(observation.cameras) == {sensor.camera for sensor in self.sensors}
        return super().act(observation)


class Grey(Renderer):
    has_history = False

    def render(self, request):
        shape = (request.camera.height, request.camera.width, 3)
        return Frame(request.t_us, request.camera.name, np.full(shape, 90, dtype=np.uint8))


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("smoke/straight", overrides=("timing.duration_us=1500000",))


def test_each_policy_is_reset_with_its_own_seed(scenario):
    first = Recording()
    then = Recording()
    SwitchedPolicy(first, then, 500_000, 7, scenario).reset(3, None)
    assert (first.seeds, then.seeds) == ([3], [7])
    alone = Recording()
    SwitchedPolicy(alone, alone, 500_000, 7, scenario).reset(3, None)
    assert alone.seeds == [3]


def test_both_policies_end_and_close_and_the_second_one_states_its_facts(scenario):
    first = Recording("first")
    then = Recording("then")
    switched = SwitchedPolicy(first, then, 500_000, 7, scenario)
    switched.end({})
    switched.close()
    assert first.calls == then.calls == ["end", "close"]
    assert switched.facts() == {"name": "then"}
    assert SwitchedPolicy(first, Recording(), 0, 7, scenario).facts() == {"name": "first"}


def test_one_policy_throughout_ends_and_closes_once(scenario):
    alone = Recording()
    switched = SwitchedPolicy(alone, alone, 500_000, 7, scenario)
    switched.end({})
    switched.close()
    assert alone.calls == ["end", "close"]


@pytest.mark.parametrize("kinds", [(ClosesBadly, Recording), (Recording, ClosesBadly)])
def test_a_policy_that_fails_to_close_does_not_keep_the_other_open(scenario, kinds):
    first, then = (kind() for kind in kinds)
    with pytest.raises(PolicyError, match=r"ClosesBadly\.close: RuntimeError: the session"):
        SwitchedPolicy(first, then, 500_000, 7, scenario).close()
    assert first.calls == then.calls == ["close"]


def test_both_controllers_close():
    class Closing(Controller):
        is_closed = False

        def advance(self, state, plan, to_us):
            raise AssertionError("nothing is driven here")

        def close(self):
            self.is_closed = True

    first = Closing()
    then = Closing()
    SwitchedController(first, then, 500_000).close()
    assert first.is_closed
    assert then.is_closed


def test_a_camera_of_both_policies_has_the_shorter_period(scenario):
    slow = SensorSpec("front", 400_000)
    fast = SensorSpec("front", 200_000)
    left = SensorSpec("left", 300_000)
    assert merge_sensors((slow,), (fast, left), scenario) == (fast, left)
    assert merge_sensors((left, fast), (slow,), scenario) == (left, fast)


@pytest.mark.parametrize("periods_us", [(300_000, 200_000), (150_000, 50_000)])
def test_periods_of_which_one_would_not_be_drawn_are_refused(scenario, periods_us):
    first, then = (SensorSpec("front", period_us) for period_us in periods_us)
    with pytest.raises(InputError, match="front"):
        merge_sensors((first,), (then,), scenario)


@pytest.mark.parametrize("periods_us", [(300_000, 100_000), (100_000, 300_000)])
def test_each_policy_sees_its_own_cameras_at_its_own_periods(scenario, periods_us):
    def pair():
        return [Looks(SensorSpec("front", period_us)) for period_us in periods_us]

    alone = pair()
    for policy in alone:
        run_rollout(scenario, Grey(), policy)
    together = pair()
    switched = SwitchedPolicy(*together, scenario.start_us + 700_000, 0, scenario)
    run_rollout(scenario, Grey(), switched)
    first, then = together
    assert first.views == alone[0].views[: len(first.views)]
    assert then.views == alone[1].views
    assert alone[0].views != alone[1].views
