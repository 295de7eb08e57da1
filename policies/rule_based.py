"""A policy that obeys the rules of the road, from the map and the boxes of road users alone.

It is a reference for policies that see: it needs no camera, and drives as the expert of built roads
does (`scenarios.expert`), but knows nothing of what others will do. It follows its route within
speed limits and what bends allow, keeps the distance of the Intelligent Driver Model, stops at red
lights, gives way at lines, and stays behind whoever will come into its way. Planning along the centre
line with a model of followers is the idea of PDM-Closed (Dauner et al., "Parting with Misconceptions
about Learning-based Vehicle Motion Planning", CoRL 2023), without its proposals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.geometry import inverse, transform_points
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import (
    F64,
    LaneMap,
    Observation,
    Plan,
    Route,
    Scenario,
    SensorSpec,
)
from alpasim_plugin.world.idm import (
    Bodies,
    IdmParams,
    Leader,
    allowed_speeds,
    find_leader,
    idm_acceleration,
)
from alpasim_plugin.world.path import Lines, Path, smooth_path, thinned
from alpasim_plugin.world.route import LaneIndex, RouteAhead
from alpasim_plugin.world.signals import LightAhead, give_way_gap_m, lights_on, red_gap_m
from alpasim_plugin.world.yielding import MIN_GAP_M, PredictedBodies, yielding_acceleration
from policies.base import follow, make_path, plan_times, seconds
from policies.road_forecast import RoadForecast, RoadUsers

UNPOSTED_MPS = 13.9  # where no limit stands; a drive that begins faster keeps its speed
LATERAL_MPS2 = 2.0  # in bends
ACCEL_MPS2 = 1.5
HARD_BRAKE_MPS2 = 7.0
SPEED_GAIN_PER_S = 1.5
LOOK_S = 0.4  # a limit is met where the ego will be after this time
ROUTE_STEP_M = 2.0  # between points of the route that the line passes
MARGIN_M = 0.3  # to both sides of the ego, where others are in its way
PLANNED_M = 80.0
PLAN_STEP_M = 1.0


@dataclass(frozen=True)
class _Way:
    """The route as a line of the rear axle, with what stands on it.

    Attributes:
        path: The line.
        line: The same, alone.
        limit_mps: ``(N,)`` speed that limits, bends and the route's end allow at its vertices.
        lights, give_way: Lines at which to stop.
    """

    path: Path
    line: Lines
    limit_mps: F64
    lights: tuple[LightAhead, ...]
    give_way: tuple[LightAhead, ...]

    @classmethod
    def along(cls, route: Route, lane_map: LaneMap, unposted_mps: float) -> _Way:
        """Return the way of a route; at its end the ego stands."""
        path = smooth_path(route.xyz[thinned(route.xyz, ROUTE_STEP_M)])
        most_mps = _posted(route, lane_map, path, unposted_mps)
        most_mps[-1] = 0.0
        return cls(
            path,
            Lines([path]),
            allowed_speeds(path, most_mps, LATERAL_MPS2),
            lights_on(path, lane_map.signals, lane_map.lanes),
            lights_on(path, lane_map.give_way, lane_map.lanes),
        )


def _posted(route: Route, lane_map: LaneMap, path: Path, unposted_mps: float) -> F64:
    """Return the speed limit ``(N,)`` at each vertex of a path: the lowest of the route's lanes
    there.
    """
    route_lanes = {key: lane_map.lanes[key] for key in route.lane_ids if key in lane_map.lanes}
    if not route_lanes:
        return np.full(len(path.s), unposted_mps)
    lanes_at = LaneIndex(LaneMap(route_lanes)).containing_many(path.xyz)
    posted = [
        [limit for key in keys if (limit := route_lanes[key].speed_limit_mps) is not None]
        for keys in lanes_at
    ]
    return np.array([min(limits, default=unposted_mps) for limits in posted])


@dataclass(frozen=True)
class _Surroundings:
    """What the ego has to mind now.

    Attributes:
        leader: Whom it follows.
        stop_m: From its front to a line to stop at; infinite without one.
        most_mps2: Acceleration that stays behind those who will come into the way.
    """

    leader: Leader
    stop_m: float
    most_mps2: float


class RuleBased(Policy):
    """Drive along the route by the rules, from the map and the boxes of road users.

    Args:
        scenario: Its map with lights, the sizes of road users and of the ego.
    """

    sensors: Sequence[SensorSpec] = ()
    sees_road_users = True

    def __init__(self, scenario: Scenario) -> None:
        self.lane_map = scenario.lane_map
        self.vehicle = scenario.vehicle
        self.front_m = self.vehicle.rear_axle_to_centre_m + self.vehicle.box.length_m / 2
        self._actors = scenario.actors

    def reset(self, seed: int, route: Route) -> None:
        """Begin a drive along a route. Nothing is random."""
        self._route = route
        self._way: _Way | None = None
        self._forecast = RoadForecast(self.lane_map, route.lane_ids)
        self._users = RoadUsers(self._actors)

    def act(self, observation: Observation) -> Plan:
        """Return the drive of the next seconds.

        Raises:
            PolicyError: The observation does not tell where road users are, or the route has fewer
                than two points.
        """
        if observation.road_users is None:
            raise PolicyError(
                "policy 'rule-based': the observation has no `road_users`",
                "drive it in a rollout of simrun; a served policy receives none",
            )
        way = self._way or self._started(observation)
        s_m = self._place.follow(observation.ego.T_world_rig)
        users = self._users.observed(observation.t_us, observation.road_users)
        ahead = self._forecast.predicted(users, observation.t_us)
        around = self._surroundings(way, s_m, observation, ahead)
        times = plan_times(observation.t_us)
        progress = self._progress(way, s_m, observation.ego.speed_mps, around, seconds(times))
        xy, yaw = self._followed(way, s_m, observation, progress)
        debug = {
            "s_m": s_m,
            "limit_mps": float(np.interp(s_m, way.path.s, way.limit_mps)),
            "leader_m": around.leader.gap_m,
            "stop_m": around.stop_m,
        }
        return Plan(observation.t_us, times, xy, yaw, debug=debug)

    def _started(self, observation: Observation) -> _Way:
        """Return the way of the drive; it keeps the speed at its begin where no limit stands."""
        if len(self._route.xyz) < 2:
            raise PolicyError(
                "policy 'rule-based': the route has fewer than two points",
                "use a scenario with a route",
            )
        unposted_mps = max(observation.ego.speed_mps, UNPOSTED_MPS)
        self._way = _Way.along(self._route, self.lane_map, unposted_mps)
        self._place = RouteAhead(Route(self._way.path.xyz))
        return self._way

    def _surroundings(
        self, way: _Way, s_m: float, observation: Observation, ahead: PredictedBodies
    ) -> _Surroundings:
        """Return what is ahead of the ego at a place of its way."""
        speed_mps = observation.ego.speed_mps
        front_s_m = s_m + self.front_m
        others = ahead.now()
        half_m = self.vehicle.box.width_m / 2
        return _Surroundings(
            find_leader(way.line, front_s_m, half_m, others, margin_m=MARGIN_M),
            self._stop_m(way, front_s_m, speed_mps, others, observation.t_us),
            yielding_acceleration(way.line, front_s_m, speed_mps, self.vehicle.box, ahead),
        )

    def _stop_m(
        self, way: _Way, front_s_m: float, speed_mps: float, others: Bodies, t_us: int
    ) -> float:
        return min(
            red_gap_m(way.lights, front_s_m, speed_mps, t_us),
            give_way_gap_m(way.give_way, way.path, front_s_m, others, -1),
        )

    def _progress(
        self, way: _Way, s_m: float, speed_mps: float, around: _Surroundings, t_s: F64
    ) -> F64:
        """Return how far ``(T,)`` the ego gets until times ``(T,)``: the leader keeps its speed, and
        a line to stop at stays one.
        """
        progress = np.zeros_like(t_s)
        speed_mps = max(speed_mps, 0.0)
        params = IdmParams(100.0, 1.5, MIN_GAP_M, ACCEL_MPS2, 2.0, HARD_BRAKE_MPS2)
        for k in range(1, len(t_s)):
            gone_m = float(progress[k - 1])
            dt_s = float(t_s[k] - t_s[k - 1])
            looked_m = s_m + gone_m + LOOK_S * speed_mps
            limit_mps = float(np.interp(looked_m, way.path.s, way.limit_mps))
            accel = min(SPEED_GAIN_PER_S * (limit_mps - speed_mps), ACCEL_MPS2, around.most_mps2)
            leader = around.leader
            if leader.index >= 0:
                gap_m = leader.gap_m + leader.speed_mps * float(t_s[k - 1]) - gone_m
                closing_mps = speed_mps - leader.speed_mps
                accel = min(accel, idm_acceleration(speed_mps, gap_m, closing_mps, params))
            if around.stop_m < np.inf:
                stop_m = around.stop_m - gone_m
                accel = min(accel, idm_acceleration(speed_mps, stop_m, speed_mps, params))
            accel = max(accel, -HARD_BRAKE_MPS2, -speed_mps / dt_s)
            progress[k] = gone_m + speed_mps * dt_s + 0.5 * accel * dt_s * dt_s
            speed_mps = max(speed_mps + accel * dt_s, 0.0)
        return progress

    def _followed(
        self, way: _Way, s_m: float, observation: Observation, progress: F64
    ) -> tuple[F64, F64]:
        """Return places ``(T, 2)`` and headings ``(T,)`` in the rig frame on the way ahead."""
        speed_mps = max(observation.ego.speed_mps, 0.0)
        stations = np.arange(s_m, min(s_m + PLANNED_M, way.path.length_m), PLAN_STEP_M)
        points = np.concatenate([way.path.at(stations)[0], way.path.xyz[-1:]])
        if len(stations) and s_m + PLANNED_M < way.path.length_m:
            points = points[:-1]
        in_rig = transform_points(inverse(observation.ego.T_world_rig), points)[:, :2]
        if len(in_rig) < 2 or np.hypot(*(in_rig[-1] - in_rig[0])) < 0.1:
            in_rig = np.array([[0.0, 0.0], [1.0, 0.0]])
        return follow(make_path(in_rig, speed_mps=speed_mps), progress, speed_mps)
