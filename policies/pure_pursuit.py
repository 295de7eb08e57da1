"""Pure pursuit along the route, without cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.types import F64, Observation, Plan, Policy, Route, Scenario, SensorSpec
from policies.base import plan_times, seconds
from policies.paths import curve_speeds, follow, make_path, smooth_line, speed_profile

MIN_CRUISE_MPS = 6.0  # where the drive begins at standstill there is no speed to keep


class PurePursuit(Policy):
    """Follow the route at the speed of the first observation, slower where curves ask for it.

    Blind by design: it looks at no camera and knows no actor, so it drives into whatever stands on its route. It measures what vehicle,
    tracker and route alone can do. Where the route ends it goes straight on; without a route it keeps its heading.
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


def has_route(route_rig: F64) -> bool:
    """Return whether at least half a metre of the route ``(20, 3)`` is left."""
    points = route_rig[np.isfinite(route_rig).all(axis=1), :2]
    return len(points) >= 2 and float(np.hypot(*(points[-1] - points[0]))) > 0.5


def route_points(route_rig: F64) -> F64:
    """Return the route's points ``(M, 2)`` before its NaN rows; straight ahead where no route is left.

    The route begins at the ego's projection, so the first point may lie beside the ego.
    """
    points = np.asarray(route_rig[np.isfinite(route_rig).all(axis=1), :2])
    if has_route(route_rig):
        return points
    start = points[0] if len(points) else np.zeros(2)
    return np.stack([start, start + np.array([1.0, 0.0])])
