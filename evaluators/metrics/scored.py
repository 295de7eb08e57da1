"""What several scores ask of one trajectory of the ego: contacts, time to collision, road,
direction, comfort.
"""

from functools import cached_property

import numpy as np
import shapely

from alpasim_plugin.core.lights_passed import passed_red, passings
from alpasim_plugin.core.types import F64, I64, Bool, RolloutLog, Scene, Trajectory
from evaluators.metrics import nuplan
from evaluators.metrics.footprint import Footprints, origin_of
from evaluators.metrics.presets import Preset
from evaluators.metrics.road import Road, road_of
from evaluators.metrics.states import states_of
from evaluators.metrics.surface import MARGIN_M

Part = float | str  # a value, or what is missing
NO_MAP = "a map"
NO_LIMITS = "the speed limits of the lanes"
SHORT = "more than three instants"
NO_SIGNALS = "the states of the traffic lights"
RED = ("red", "red_yellow")
LANE_M = 0.5
LANE_S = 2.0


class ScoredRollout:
    """One trajectory of the ego's box centre, driven or planned, among the road users of a log."""

    def __init__(
        self, rollout: RolloutLog, scene: Scene, preset: Preset, centre: Trajectory
    ) -> None:
        origin = origin_of(scene.ego_log, preset)
        self.ego, self.tracks = states_of(rollout, preset, centre, origin)
        self._lanes_by_id = scene.lane_map.lanes
        self._lanes = list(scene.lane_map.lanes.values())
        self._xyz = centre.xyz - origin
        self._below_m = rollout.ego_box.height_m / 2
        self._road = road_of(scene.lane_map, origin, preset) if self._lanes else None
        self._signals = scene.lane_map.signals
        self._origin = origin

    @property
    def road(self) -> Road:
        """Give the road; ask `has_map` before."""
        assert self._road is not None
        return self._road

    @property
    def has_map(self) -> bool:
        """Tell whether lanes are known."""
        return self._road is not None

    @cached_property
    def boxes(self) -> Footprints:
        """The ego's boxes ``(T,)``."""
        return self.ego.boxes(self.ego.centre, self.ego.yaw)

    @cached_property
    def _in_lanes(self) -> tuple[I64, I64]:
        """Pairs of step and lane whose area holds the centre of the box."""
        step, lane = np.nonzero(self.road.lanes_near(self._xyz, self._below_m))
        inside = shapely.contains_xy(self.road.areas(lane), *self.ego.centre[step].T)
        return step[inside], lane[inside]

    @cached_property
    def astray(self) -> Bool | None:
        """Where ``(T,)`` no lane holds the ego, not even with those that lead into it and that it
        leads to: it is in several lanes that are not connected, or off the road; None without a
        map.
        """
        if not self.has_map:
            return None
        step, lane = self._in_lanes
        boxes = self.boxes.shapes()
        out = np.ones(len(self._xyz), dtype=np.bool_)
        out[step[shapely.covers(self.road.areas(lane), boxes[step])]] = False
        across = np.flatnonzero(out)
        row, lane = np.nonzero(self.road.lanes_near(self._xyz[across], self._below_m))
        touches = shapely.intersects(self.road.areas(lane), boxes[across[row]])
        row = row[touches]
        lane = lane[touches]
        for k in np.unique(lane).tolist():
            steps = across[row[lane == k]]
            inner = shapely.buffer(boxes[steps], -MARGIN_M, join_style="mitre")
            out[steps] &= ~shapely.covers(self.road.connected(k).shape, inner)
        return out

    @cached_property
    def hits(self) -> list[nuplan.Collision]:
        """Its collisions."""
        return nuplan.collisions(self.ego, self.tracks, self.astray)

    @cached_property
    def ttc_s(self) -> F64:
        """Seconds ``(T,)`` to a collision."""
        beside = self.astray
        if beside is not None:
            step, lane = self._in_lanes
            beside = beside.copy()
            crosses = [self._lanes[k].is_intersection for k in lane.tolist()]
            beside[step[np.array(crosses, dtype=np.bool_)]] = True
        return nuplan.time_to_collision(self.ego, self.tracks, self.hits, beside)

    def time_to_collision(self) -> Part:
        """Return whether the time to a collision is always long enough."""
        return float(self.ttc_s.min() > nuplan.LEAST_TTC_S)

    def drivable(self, beyond_m: float) -> Part:
        """Return whether no part of the ego is ever farther than this off the drivable surface."""
        if not self.has_map:
            return NO_MAP
        ground = self._xyz - np.array([0.0, 0.0, self._below_m])
        margin_m = self.road.surface.margin_m(self.boxes.shapes(), ground)
        return float(margin_m.min() >= -beyond_m)

    @cached_property
    def against_m(self) -> F64:
        """Metres ``(T,)`` driven against the lanes within the last `nuplan.AGAINST_S`; of several
        lanes the one that agrees best counts.
        """
        step, lane = self._in_lanes
        moved = np.diff(self.ego.centre, axis=0, prepend=self.ego.centre[:1])[step]
        heading = self.road.heading_at(lane, self.ego.centre[step])
        best = np.full(len(self._xyz), -np.inf)
        np.maximum.at(best, step, moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading))
        total = np.concatenate(
            [[0.0], np.cumsum(np.where(np.isfinite(best), np.maximum(-best, 0.0), 0.0))]
        )
        first = np.searchsorted(
            self.ego.t_us, self.ego.t_us - round(nuplan.AGAINST_S * 1e6), side="right"
        )
        return total[1:] - total[first]

    def direction(self) -> Part:
        """Return nuPlan's score of driving with the traffic."""
        return nuplan.direction_score(float(self.against_m.max())) if self.has_map else NO_MAP

    @cached_property
    def ran_red(self) -> Bool | None:
        """Where ``(T,)`` the middle of the ego's front passes the line of a red traffic light of the
        lane that it follows; None where no states are known.
        """
        if self._signals is None:
            return None
        front = self.ego.centre + self.ego.size[0] / 2 * self.ego.heading
        t_us = self.ego.t_us
        out = np.zeros(len(t_us), dtype=np.bool_)
        line = np.column_stack([front, self._xyz[:, 2]])
        at_lines = passings(line, self._signals, self._lanes_by_id, self._origin)
        are_red = []
        for passing in at_lines:
            step_us = t_us[passing.vertex + 1] - t_us[passing.vertex]
            passed_us = round(float(t_us[passing.vertex] + passing.share * step_us))
            are_red.append(passing.signal.colour_at(passed_us) in RED)
        out[[passing.vertex + 1 for passing in passed_red(at_lines, are_red)]] = True
        return out

    def traffic_lights(self) -> Part:
        """Return whether no red light is passed."""
        return NO_SIGNALS if self.ran_red is None else float(not self.ran_red.any())

    def speed_limit(self) -> Part:
        """Return nuPlan's score of the speed limit: the highest of the lanes under the ego, where
        one is known.
        """
        limits = np.array([lane.speed_limit_mps or np.nan for lane in self._lanes])
        if not self.has_map or np.isnan(limits).all():
            return NO_LIMITS
        step, lane = self._in_lanes
        allowed = np.full(len(self._xyz), -np.inf)
        np.maximum.at(allowed, step, np.where(np.isnan(limits), np.inf, limits)[lane])
        return nuplan.speed_limit_score(
            np.where(np.isfinite(allowed), self.ego.speed - allowed, 0.0), self.ego.t_us
        )

    def comfort(self, place: nuplan.Place) -> Part:
        """Return whether the drive is within nuPlan's bounds of comfort, by accelerations at a place
        of the vehicle.
        """
        if len(self._xyz) <= nuplan.LEAST_INSTANTS:
            return SHORT
        return float(not nuplan.uncomfortable(nuplan.motion(self.ego, place)).any())

    def lane_keeping(self) -> Part:
        """Return whether the ego never stays farther from the middle of its lane than `LANE_M` for
        `LANE_S`; at junctions it may.
        """
        if not self.has_map:
            return NO_MAP
        step, lane = self._in_lanes
        free = np.array([self._lanes[k].is_intersection for k in lane.tolist()], dtype=np.bool_)
        away = np.full(len(self._xyz), np.inf)
        np.minimum.at(
            away,
            step,
            np.where(
                free,
                0.0,
                shapely.distance(
                    self.road.centre_lines[lane], shapely.points(self.ego.centre[step])
                ),
            ),
        )
        far = np.isfinite(away) & (away > LANE_M)
        began = np.maximum.accumulate(
            np.where(far, 0, self.ego.t_us)
        )  # the last instant at which it was not far
        return float(not np.any(far & (self.ego.t_us - began > LANE_S * 1e6)))
