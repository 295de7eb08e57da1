"""Replay of the recorded drive: the upper bound, and a check of the simulation loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.geometry import interpolate, inverse, yaw_of
from alpasim_plugin.core.types import Observation, Plan, Policy, Route, Scenario, SensorSpec
from policies.base import plan_times


class LogReplay(Policy):
    """Return the recorded future in the rig frame. With the perfect controller the rollout is the log.

    It knows the scenario's ego log, so it is a reference and not a policy under test. Where the log ends before the horizon the plan
    ends there as well.
    """

    sensors: Sequence[SensorSpec] = ()
    controller = "perfect"

    def __init__(self, scenario: Scenario) -> None:
        self.log = scenario.ego_log

    def reset(self, seed: int, route: Route) -> None:
        """Do nothing: the plan depends on the time alone."""

    def act(self, observation: Observation) -> Plan:
        """Return the log from now on, seen from where the ego is.

        The first pose is the log's too: beside the ego where the ego has left the log.

        Raises:
            InputError: The log does not cover the present time.
        """
        now = observation.t_us
        times = plan_times(now)
        times = times[times <= max(now, int(self.log.t_us[-1]))]
        in_rig = inverse(observation.ego.T_world_rig) @ interpolate(self.log, times)
        yaw = np.array([yaw_of(pose) for pose in in_rig])
        return Plan(now, times, in_rig[:, :2, 3].copy(), yaw)
