"""What a scenario may hold and cost, computed before anything is built: the one gate that every
source passes.

`check_specification` looks at a built road's file before the road is made, `check_record` at what a
reader returned, `check_scenario` at the finished scenario of either kind. Ranges of single
quantities are in `alpasim_plugin.core.limits`.

The cost of the Gaussians follows what was counted on built roads of 0.1 to 5 km
(docs/runs.md): ground and kerbs by the drive's length, trees and walls by the surroundings.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from alpasim_plugin.core import limits as b
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths
from alpasim_plugin.core.types import (
    F64,
    Actor,
    Box,
    CameraSpec,
    Environment,
    LaneMap,
    Scenario,
    Trajectory,
)
from scenarios.recorded import RecordedLog
from scenarios.schema_parts import IdmActor, NarrowGapSegment, ParkedActor
from scenarios.variation import Drawn

DOING = "checking what a scenario costs"
REACH_M = 110.0  # the surroundings are built so far from the drive
BYTES_PER_GAUSSIAN = 200
SECONDS_PER_GAUSSIAN = 3e-6
PLAN_CELL_M2 = 0.0625

ACTORS = b.Bound("road users", "", 0, 1_000, "recorded scenes have a few hundred")
REACTIVE = b.Bound("reactive drivers", "", 0, 200, "each follows its lane in every step")
LANES = b.Bound("lanes", "", 1, 50_000, "the map of a town has some thousands")
VERTICES = b.Bound("vertices of a map", "", 0, 5_000_000, "the map of a town has some 100,000")
POSES = b.Bound(
    "poses of all tracks", "", 0, 5_000_000, "an hour of a hundred road users at 10 a second"
)
GAUSSIANS = b.Bound(
    "Gaussians", "", 0, 20_000_000, "they would take more than 4 GB and a minute to build"
)
PLAN_CELLS = b.Bound(
    "cells of the ground plan", "", 0, 50_000_000, "a square of 1.7 km at 0.25 m takes about 1 GB"
)
BUDGETS = (ACTORS, REACTIVE, LANES, VERTICES, POSES, GAUSSIANS, PLAN_CELLS)


def check_specification(drawn: Drawn) -> None:
    """Check a built road's file before it is built.

    Args:
        drawn: Specification with ``road``.

    Raises:
        InputError: The road, its actors or their number are more than a scenario may have; the
            number is named.
    """
    spec = drawn.spec
    assert spec.road is not None

    def fail(key: tuple[str, ...], found: str, do_this: str) -> InputError:
        return drawn.document.error(key, found, do_this)

    lengths = [
        getattr(segment, "length_m", 2 * getattr(segment, "arm_length_m", 0.0))
        for segment in spec.road.segments
    ]
    if not b.ROAD_M.holds(sum(lengths)):
        raise fail(
            ("road", "segments"),
            _found(b.ROAD_M, sum(lengths)),
            "shorten segments, or make several scenarios",
        )
    gaps = sum(
        s.cars_left + s.cars_right for s in spec.road.segments if isinstance(s, NarrowGapSegment)
    )
    actors = gaps + sum(
        actor.count if isinstance(actor, ParkedActor) else 1 for actor in spec.actors
    )
    reactive = sum(isinstance(actor, IdmActor) for actor in spec.actors)
    for bound, value in ((ACTORS, actors), (REACTIVE, reactive)):
        if not bound.holds(value):
            raise fail(
                ("actors",), _found(bound, value), "leave out those that the ego never meets"
            )
    driven_m = min(
        spec.built_until_us * 1e-6 * max(spec.ego.cruise_mps, spec.ego.speed_mps), sum(lengths)
    )
    if spec.background is None:
        count = gaussians(spec.environment, driven_m, driven_m, 0.0)
        if not GAUSSIANS.holds(count):
            raise fail(
                ("environment",),
                _cost(count),
                "shorten timing.duration_us, lower building_height_m or trees_per_100m",
            )


def check_record(record: RecordedLog, where: str) -> None:
    """Check what a reader returned, ours or a third party's.

    Args:
        record: Map, drive and traffic.
        where: The log, for messages.

    Raises:
        InputError: A number that is not finite or out of range, or more of something than a
            scenario may have.
    """
    b.COORDINATE_M.check(
        _reach(record.ego_log.xyz, *_lines(record.lane_map)),
        f"{where}, map",
        "farthest point",
    )
    _check_map(record.lane_map, where)
    _check_track(record.ego_log, f"{where}, ego")
    _check_actors(record.actors, where)
    _check_cameras(record.cameras, where)
    _check_box(record.vehicle.box, f"{where}, ego", b.VEHICLE_M)
    for name in ("rear_axle_to_centre_m", "wheelbase_m"):
        b.AXLE_M.check(getattr(record.vehicle, name), f"{where}, ego", name)
    if not (np.isfinite(record.ground.z).all() and record.ground.cell_m > 0):
        raise InputError(
            f"{where}, ground: a height that is not finite",
            "repair the heights of the map",
        )


def check_scenario(scenario: Scenario, where: str) -> None:
    """Check a finished scenario of any source: its road users, its length and what building it
    would cost.

    Raises:
        InputError: More than a scenario may have; the number is named.
    """
    _check_actors(scenario.actors, where)
    _check_cameras(scenario.cameras, where)
    b.LOG_S.check((scenario.end_us - scenario.start_us) * 1e-6, where, "length")
    if scenario.background is not None:
        return
    xy = scenario.ego_log.xyz[:, :2]
    wide, high = np.ptp(xy, axis=0) + 2 * REACH_M
    count = gaussians(
        scenario.environment, float(arc_lengths(scenario.ego_log.xyz)[-1]), float(wide), float(high)
    )
    if not GAUSSIANS.holds(count):
        raise InputError(
            f"{where}: {_cost(count)}",
            "drive a shorter part of it, or lower environment.building_height_m",
        )
    cells = wide * high / PLAN_CELL_M2
    PLAN_CELLS.check(float(cells), f"{where}: a drive through {wide:.0f} x {high:.0f} m")


def gaussians(
    environment: Environment | object, driven_m: float, wide_m: float, high_m: float
) -> float:
    """Estimate how many Gaussians a scene takes, within about half of the true number.

    Args:
        environment: Surroundings; `Environment`, or the file's section of the same names.
        driven_m: Length of the logged path.
        wide_m, high_m: Sides of the rectangle around it, with what is built beside it.
    """
    trees_per_100m, buildings = (
        getattr(environment, "trees_per_100m", 0.0),
        getattr(environment, "buildings", 0.0),
    )
    length = driven_m + 40.0
    area = max(wide_m, 2 * REACH_M) * max(high_m, 2 * REACH_M)
    trees = trees_per_100m * (0.02 * length + 0.00022 * area)
    walls_m2 = (
        buildings
        * 2
        * length
        * float(np.mean(getattr(environment, "building_height_m", (0.0, 0.0))))
        * 2.3
    )
    spacing = getattr(environment, "poles_spacing_m", 0.0)
    poles = 2 * length / spacing if spacing > 0 else 0.0
    return 1500.0 * (length + 100.0) + 760.0 * trees + 22.0 * walls_m2 + 100.0 * poles


def _cost(count: float) -> str:
    gib, seconds = count * BYTES_PER_GAUSSIAN / b.GIB, count * SECONDS_PER_GAUSSIAN
    return f"{_found(GAUSSIANS, count)}: about {gib:.0f} GiB and {seconds:.0f} s to build"


def _found(bound: b.Bound, value: float) -> str:
    return f"{b.number(round(value))} {bound.unit or bound.name}{' of road' if bound is b.ROAD_M else ''}, at most {b.number(bound.high)}"


def _lines(lane_map: LaneMap) -> Iterable[F64]:
    for lane in lane_map.lanes.values():
        yield lane.centre
        if lane.left is not None:
            yield lane.left
        if lane.right is not None:
            yield lane.right
    for group in (
        lane_map.road_edges,
        lane_map.drivable_areas,
        lane_map.crosswalks,
        lane_map.stop_lines,
        lane_map.poles,
    ):
        yield from group
    for marking in lane_map.markings:
        yield marking.xyz


def _reach(*lines: F64) -> float:
    """Return the largest coordinate of all lines; NaN where one is not finite."""
    return float(np.max([np.max(np.abs(line), initial=0.0) for line in lines], initial=0.0))


def _check_map(lane_map: LaneMap, where: str) -> None:
    LANES.check(len(lane_map.lanes), f"{where}, map")
    VERTICES.check(sum(len(line) for line in _lines(lane_map)), f"{where}, map")
    for lane in lane_map.lanes.values():
        if lane.speed_limit_mps is not None:
            b.LIMIT_MPS.check(lane.speed_limit_mps, f"{where}, lane {lane.lane_id}")
    for pose, box in lane_map.signs:
        b.COORDINATE_M.check(_reach(pose), f"{where}, signs")
        _check_box(box, f"{where}, signs", b.SIGN_M)


def _check_actors(actors: tuple[Actor, ...], where: str) -> None:
    ACTORS.check(len(actors), where)
    REACTIVE.check(sum(actor.behaviour.kind == "idm" for actor in actors), where)
    POSES.check(sum(len(actor.track) for actor in actors), where)
    for actor in actors:
        here = f"{where}, road user {actor.actor_id}"
        _check_box(actor.box, here, b.BODY_M)
        _check_track(actor.track, here)


def _check_track(track: Trajectory, where: str) -> None:
    b.COORDINATE_M.check(_reach(track.xyz), where, "farthest position")
    b.EPOCH_US.check(float(np.abs(track.t_us[[0, -1]].astype(np.float64)).max()), where)
    b.LOG_S.check(float(track.t_us[-1] - track.t_us[0]) * 1e-6, where, "length of its track")
    if not np.isfinite(track.quat).all():
        raise InputError(f"{where}: a rotation that is not finite", "repair or drop its track")


def _check_box(box: Box, where: str, bound: b.Bound) -> None:
    for name in ("length_m", "width_m", "height_m"):
        bound.check(getattr(box, name), where, name)


def _check_cameras(cameras: tuple[CameraSpec, ...], where: str) -> None:
    for camera in cameras:
        for name in ("width", "height"):
            b.IMAGE_SIDE_PX.check(getattr(camera, name), f"{where}, camera {camera.name}", name)
        if not (
            np.isfinite(camera.K).all()
            and np.isfinite(camera.T_rig_camera).all()
            and camera.K[0, 0] > 0
            and camera.K[1, 1] > 0
        ):
            raise InputError(
                f"{where}, camera {camera.name}: a lens or mount that is not finite",
                "repair the calibration",
            )
        b.MOUNT_M.check(_reach(camera.T_rig_camera[:3, 3]), f"{where}, camera {camera.name}")
