"""A built road: from the validated file to map, expert log and actors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Actor, LaneMap, Route, Trajectory, Vehicle
from alpasim_plugin.world.path import Path
from alpasim_plugin.world.road_elements import Curve, Element, Intersection, LaneTaper, Profile
from alpasim_plugin.world.roads import build_road
from scenarios.check import check_drive
from scenarios.ego_path import EgoPath, LaneChange, LateralShift, make_ego_path
from scenarios.expert import Drive, ExpertStyle, drive
from scenarios.schema import ScenarioSpec
from scenarios.schema_road import (
    ArcSegment,
    ClothoidSegment,
    IntersectionSegment,
    MergeSegment,
    NarrowGapSegment,
    RoadSpec,
    SplitSegment,
    StraightSegment,
)
from scenarios.traffic import Fail, Traffic, place_actors

TAIL_US = 4_000_000  # scripts go on for so long after the end, so that the expert's lookahead does not see them stop
DEFAULT_DURATION_US = 8_000_000


@dataclass(frozen=True)
class BuiltRoad:
    """A built road with its traffic."""

    lane_map: LaneMap
    ego_log: Trajectory
    route: Route
    actors: tuple[Actor, ...]


def build(spec: ScenarioSpec, vehicle: Vehicle, fail: Fail) -> BuiltRoad:
    """Build the road, place the actors and let the expert drive.

    Args:
        spec: Validated and jittered file, with ``road``.
        vehicle: Ego vehicle.
        fail: Puts the position of a key path into an error.

    Raises:
        InputError: A road, an actor or a drive that cannot be built.
    """
    assert spec.road is not None
    try:
        road = build_road(elements(spec.road), profile(spec.road), (0.0, 0.0, np.deg2rad(spec.road.heading_deg)))
    except InputError as e:
        raise fail(("road", "segments"), e) from e
    try:
        changes = [LaneChange(spec.ego.start_m + c.at_m, c.to_lane, c.length_m) for c in spec.ego.lane_changes]
        plain = make_ego_path(road, spec.ego.lane, changes)
        ego_path = make_ego_path(road, spec.ego.lane, changes, _lateral_shifts(spec.road, plain))
    except InputError as e:
        raise fail(("ego",), e) from e
    end_us = last_us(spec)
    if spec.ego.start_m >= ego_path.path.length_m:
        raise fail(("ego", "start_m"), _too_short(ego_path.path.length_m, spec.ego.start_m))
    traffic = place_actors(spec, road, ego_path, vehicle, end_us + TAIL_US, fail)
    run = _drive(spec, ego_path, vehicle, traffic, end_us, fail)
    actors = traffic.actors(run)
    try:
        check_drive(road.lane_map, run.ego_log, vehicle, actors, end_us)
    except InputError as e:
        raise fail(_blame(spec, e.with_what), e) from e
    return BuiltRoad(road.lane_map, run.ego_log, Route(ego_path.path.xyz[::4], ego_path.lane_ids), actors)


def _blame(spec: ScenarioSpec, with_what: str) -> tuple[str | int, ...]:
    """Return the key path of the actor that an error names."""
    name = with_what.removeprefix("actor ")
    for i, actor in enumerate(spec.actors):
        if name == actor.id or name.startswith(f"{actor.id}-"):
            return ("actors", i)
    return ("road", "segments")


def last_us(spec: ScenarioSpec) -> int:
    """Return the end of the scenario after the log's first pose."""
    duration = spec.timing.duration_us
    return spec.timing.start_us + (DEFAULT_DURATION_US if duration is None else duration)


def elements(spec: RoadSpec) -> list[Element]:
    """Return the road's elements."""
    out: list[Element] = []
    for segment in spec.segments:
        match segment:
            case StraightSegment() | NarrowGapSegment():
                out.append(Curve(segment.length_m))
            case ArcSegment():
                out.append(Curve(segment.length_m, segment.curvature_per_m, segment.curvature_per_m))
            case ClothoidSegment():
                out.append(Curve(segment.length_m, segment.start_curvature_per_m, segment.end_curvature_per_m))
            case MergeSegment() | SplitSegment():
                out.append(LaneTaper(segment.kind, segment.length_m))
            case IntersectionSegment():
                out.append(
                    Intersection(segment.turn, segment.arms, segment.cross_lanes, segment.arm_length_m, segment.corner_radius_m,
                                 segment.crosswalks, segment.guide_lines)
                )  # fmt: skip
    return out


def profile(spec: RoadSpec) -> Profile:
    """Return the cross-section."""
    return Profile(
        spec.lanes_forward, spec.lanes_backward, spec.lane_width_m, spec.median_m, spec.shoulder_m, spec.parking_m,
        spec.speed_limit_mps, spec.centre_paint,
    )  # fmt: skip


def _lateral_shifts(spec: RoadSpec, ego_path: EgoPath) -> list[LateralShift]:
    out = []
    for i, segment in enumerate(spec.segments):
        if isinstance(segment, NarrowGapSegment) and segment.shift_m:
            begin, end = ego_path.stretch_s[i], ego_path.stretch_s[i + 1]
            quarter = (end - begin) / 4
            out.append(LateralShift(begin + quarter, end - quarter, max(2 * quarter, 12.0), segment.shift_m))
    return out


def _drive(spec: ScenarioSpec, ego_path: EgoPath, vehicle: Vehicle, traffic: Traffic, end_us: int, fail: Fail) -> Drive:
    style = ExpertStyle(spec.ego.speed_mps, spec.ego.cruise_mps, spec.ego.max_lateral_accel_mps2, spec.ego.headway_s)
    run = drive(ego_path.path, spec.ego.start_m, vehicle, style, traffic.scripts(), traffic.followers, end_us)
    reached = int(run.ego_log.t_us[-1])
    if reached < end_us:
        raise fail(("road", "segments"), _too_short(ego_path.path.length_m, _driven(ego_path.path, run.ego_log), reached, end_us))
    return run


def _driven(path: Path, log: Trajectory) -> float:
    s, _ = path.project(log.xyz[-1:, :2])
    return float(s[0])


def _too_short(length_m: float, s_m: float, reached_us: int = 0, end_us: int = 0) -> InputError:
    when = f" after {reached_us / 1e6:.1f} s of {end_us / 1e6:.1f} s" if end_us else ""
    return InputError(
        "driving the expert", "road", f"the road is {length_m:.0f} m long and the ego stands at {s_m:.0f} m{when}",
        "add or lengthen a segment, shorten timing.duration_us, or lower ego.cruise_mps",
    )  # fmt: skip
