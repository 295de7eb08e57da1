"""The policies without a camera: constant velocity, the lower bound; log replay, the upper one;
pure pursuit of the route.
"""

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.geometry import interpolate, inverse, yaw_of
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import (
    Observation,
    Plan,
    Route,
    Scenario,
    SensorSpec,
    Trajectory,
)
from policies.base import (
    MIN_CRUISE_MPS,
    curve_speeds,
    follow,
    make_path,
    plan_times,
    route_points,
    seconds,
    smooth_line,
    speed_profile,
)


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
        return Plan(
            observation.t_us, times, np.column_stack([x, np.zeros_like(x)]), np.zeros_like(x)
        )


class LogReplay(Policy):
    """Return the recorded future in the rig frame. With the perfect controller the rollout is the
    log.

    It knows the scenario's ego log, so it is a reference and not a policy under test. Where the log
    ends before the horizon the plan ends there as well, except where the scene goes on behind the
    log: there the plan keeps the last speed of the log, straight on, past the goal.
    """

    sensors: Sequence[SensorSpec] = ()
    controller = "perfect"

    def __init__(self, scenario: Scenario) -> None:
        self.log = _carried_on(scenario.ego_log, scenario.end_us)

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


def _carried_on(log: Trajectory, until_us: int) -> Trajectory:
    """Return a log that keeps its last speed, straight on, up to a time; the log itself where it does
    not end before.
    """
    more_us = until_us - int(log.t_us[-1])
    if more_us <= 0 or len(log) < 2:
        return log
    step_share = more_us / int(log.t_us[-1] - log.t_us[-2])
    last = log.xyz[-1] + step_share * (log.xyz[-1] - log.xyz[-2])
    return Trajectory(
        np.append(log.t_us, until_us),
        np.concatenate([log.xyz, last[None]]),
        np.concatenate([log.quat, log.quat[-1:]]),
    )


class PurePursuit(Policy):
    """Follow the route at the speed of the first observation, slower where curves ask for it.

    Blind by design: it looks at no camera and knows no actor, so it drives into whatever stands on
    its route. It measures what vehicle, tracker and route alone can do. Where the route ends it
    goes straight on; without a route it keeps its heading.
    """

    sensors: Sequence[SensorSpec] = ()

    def __init__(self, scenario: Scenario) -> None:
        del scenario
        self.cruise_mps: float | None = None

    def reset(self, seed: int, route: Route) -> None:
        """Forget the cruising speed."""
        self.cruise_mps = None

    def act(self, observation: Observation) -> Plan:
        """Return an arc-by-arc pursuit of the route."""
        speed = max(observation.ego.speed_mps, 0.0)
        if self.cruise_mps is None:
            self.cruise_mps = max(speed, MIN_CRUISE_MPS)
        times = plan_times(observation.t_us)
        path = make_path(smooth_line(route_points(observation.route_rig)), speed_mps=speed)
        progress = speed_profile(speed, curve_speeds(path, self.cruise_mps), seconds(times))
        xy, yaw = follow(path, progress, speed)
        return Plan(observation.t_us, times, xy, yaw, debug={"cruise_mps": self.cruise_mps})
