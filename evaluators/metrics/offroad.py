"""Lane keeping: off the road, in a wrong lane or in none for cars, and the gap to the border of the
lanes around the ego.

Protocol (paper, appendix "Off-road"). Nearby lanes are those whose centre line passes within 6 m of
the ego's box centre, in 3-D and whatever their direction. A step is on the road if one nearby
lane's area contains the footprint (touching its border from inside is inside), or else if the union
of all nearby areas does. Only if neither holds, the road edges decide: the step is off-road if the
footprint is nearer than 1 mm to a road-edge polyline. "Off-road" thus means *touching the edge*
outside the lanes: far beyond the edge, where nothing is touched, a step counts as on the road. The
drive to there has crossed the edge, and steps after the first event are dropped.

Preset ``strict`` measures by how much the footprint leaves the drivable surface
(`evaluators.metrics.surface`).
"""

from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.geometry import wrap_angle, yaw_from_quat
from alpasim_plugin.core.types import F64, Bool, MetricSeries, RolloutLog, Scene
from evaluators.metrics.footprint import Footprints, ego_footprints, origin_of
from evaluators.metrics.presets import Preset
from evaluators.metrics.road import Road, road_of
from evaluators.metrics.score import series, with_preset
from evaluators.metrics.surface import MARGIN_M

WRONG_HEADING_RAD = 2 * np.pi / 3

NO_LANES = "the map has no lanes"
NO_SURFACE = "nothing drivable is on the ego's level"
NO_EDGES = "no lane contains the footprint and the map has no road edges to decide"


@dataclass(frozen=True)
class Containment:
    """How the lanes around the ego hold its footprint, per step."""

    near: Bool  # (T, L) lanes within the radius
    in_one: Bool  # (T,) one lane's area contains the footprint
    in_union: Bool  # (T,) the union of nearby areas contains it
    boundary_gap_m: (
        F64  # (T,) distance to the union's border where it contains the footprint, else 0
    )


def containment(road: Road, ego: Footprints, xyz: F64, below_m: float) -> Containment:
    """Test footprints ``(T,)`` with box centres ``(T, 3)``, so far above the ground, against single
    lanes and against the union of nearby lanes.
    """
    near = road.lanes_near(xyz, below_m)
    shapes = ego.shapes()
    step, lane = np.nonzero(near)
    areas = road.areas(lane)
    held = shapely.contains(areas, shapes[step])
    in_one = np.zeros(len(near), dtype=np.bool_)
    in_one[step[held]] = True
    in_union = np.zeros_like(in_one)
    gap_m = np.zeros(len(near))
    sets, group = np.unique(near, axis=0, return_inverse=True)
    for g in np.flatnonzero(sets.any(axis=1)):
        union = road.union(sets[g])
        rows = np.flatnonzero(group.reshape(-1) == g)
        inside = rows[shapely.contains(union, shapes[rows])]
        in_union[inside] = True
        gap_m[inside] = shapely.distance(shapely.boundary(union), shapes[inside])
    return Containment(near, in_one, in_union, gap_m)


def wrong_lane(road: Road, near: Bool, xy: F64, yaw: F64, preset: Preset) -> Bool:
    """Return whether the ego is in a lane of the opposite direction.

    Looked at are the nearby lanes that contain its centre ``(T, 2)``; one opposes where its
    direction differs from the ego's heading ``(T,)`` by more than 120 degrees. In a junction lanes
    of many directions overlap, so by default a step is wrong only if all of the lanes under the ego
    oppose; AlpaSim calls it wrong if any does.
    """
    step, lane = np.nonzero(near)
    inside = shapely.contains(road.areas(lane), shapely.points(xy[step]))
    step = step[inside]
    lane = lane[inside]
    delta = road.heading_at(lane, xy[step]) - yaw[step]
    opposes = np.abs(wrap_angle(delta) if preset.wrap_heading else delta) > WRONG_HEADING_RAD
    out = np.zeros(len(xy), dtype=np.bool_)
    agreed = np.zeros(len(xy), dtype=np.bool_)
    out[step[opposes]] = True
    agreed[step[~opposes]] = True
    return out if preset.wrong_lane_rule == "any_opposes" else out & ~agreed


def in_no_car_lane(road: Road, near: Bool, xy: F64) -> Bool:
    """Return whether the nearby lanes that contain the ego's centre ``(T, 2)`` are shoulders, parking
    strips, bicycle or bus lanes alone. Where no lane contains it, it is in none of these.
    """
    step, lane = np.nonzero(near)
    inside = shapely.contains(road.areas(lane), shapely.points(xy[step]))
    step = step[inside]
    is_for_cars = road.is_for_cars[lane[inside]]
    out = np.zeros(len(xy), dtype=np.bool_)
    out[step[~is_for_cars]] = True
    out[step[is_for_cars]] = False
    return out


def evaluate_offroad(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give ``offroad``, ``wrong_lane`` and ``min_distance_to_lane_boundary_m`` per step; a missing
    map is invalid, never zero.
    """
    t_us = rollout.ego.t_us
    names = ("offroad", "wrong_lane", "min_distance_to_lane_boundary_m")
    lane_map = (
        scene.alpasim_map
        if preset.alpasim_map and scene.alpasim_map is not None
        else scene.lane_map
    )
    if not lane_map.lanes:
        if preset.missing_road == "absent":
            return []
        if preset.missing_road == "error":
            raise _no_map(rollout, preset, NO_LANES)
        return [series(name, t_us, np.nan, False, NO_LANES) for name in names]
    origin = origin_of(scene.ego_log, preset)
    road = road_of(lane_map, origin, preset)
    ego = ego_footprints(rollout, preset, origin)
    xyz = rollout.ego.xyz - origin
    below_m = rollout.ego_box.height_m / 2
    if preset.offroad_rule == "margin":
        if preset.missing_road == "error" and road.surface.is_empty:
            raise _no_map(rollout, preset, "no lane of the map has an area")
        margin_m = road.surface.margin_m(ego.shapes(), xyz - np.array([0.0, 0.0, below_m]))
        near = road.lanes_near(xyz, below_m)
        against = wrong_lane(road, near, ego.centres(), ego.yaw, preset)
        return [
            series("offroad", t_us, margin_m < -MARGIN_M),
            series("offroad_margin_m", t_us, margin_m, np.isfinite(margin_m), NO_SURFACE),
            series("wrong_lane", t_us, against),
            series("no_car_lane_share", t_us, in_no_car_lane(road, near, ego.centres())),
            series("min_distance_to_lane_boundary_m", t_us, np.maximum(margin_m, 0.0)),
        ]
    held = containment(road, ego, xyz, below_m)
    off = np.zeros(len(t_us), dtype=np.bool_)
    is_decided = held.in_one | held.in_union
    undecided = np.flatnonzero(~is_decided)
    if len(road.edges) and len(undecided):
        off[undecided] = road.touches_edge(ego.take(undecided).shapes(), xyz[undecided])
        is_decided[undecided] = True
    if preset.missing_road == "absent" and not is_decided.all():
        return []
    against = wrong_lane(road, held.near, ego.centres(), yaw_from_quat(rollout.ego.quat), preset)
    return [
        series("offroad", t_us, off, is_decided, NO_EDGES),
        series("wrong_lane", t_us, against),
        series("min_distance_to_lane_boundary_m", t_us, held.boundary_gap_m),
    ]


def _no_map(rollout: RolloutLog, preset: Preset, problem: str) -> EvaluatorError:
    return EvaluatorError(
        f"scene {rollout.scene_id!r}, preset {preset.name!r}: {problem}",
        "score with a scene that has a map, or with a preset that can do without (paper, alpasim)",
    )


FACTORY = with_preset(evaluate_offroad)
