"""Constant velocity: the lower bound that every policy should exceed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.types import Observation, Plan, Policy, Route, Scenario, SensorSpec
from policies.base import plan_times, seconds


class ConstantVelocity(Policy):
    """Keep the present heading and speed. Looks at no camera, no route and no actor."""

    sensors: Sequence[SensorSpec] = ()

    def __init__(self, scenario: Scenario) -> None:
        del scenario

    def reset(self, seed: int, route: Route) -> None:
        """Do nothing: there is no memory."""

    def act(self, observation: Observation) -> Plan:
        """Return a straight plan."""
        times = plan_times(observation.t_us)
        x = observation.ego.speed_mps * seconds(times)
        return Plan(observation.t_us, times, np.stack([x, np.zeros_like(x)], axis=1), np.zeros_like(x))
