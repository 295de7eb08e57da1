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
from alpasim_plugin.world.ground import BUILT_WHOLE_M
from scenarios.recorded import RecordedLog
from scenarios.schema import EnvironmentSpec
from scenarios.schema_parts import IdmActor, NarrowGapSegment, ParkedActor
from scenarios.variation import Drawn

REACH_M = 110.0  # the surroundings are built so far from the drive

ACTORS = b.Bound("road users", "", 0, 1_000, "recorded scenes have a few hundred")
REACTIVE = b.Bound("reactive drivers", "", 0, 200, "each follows its lane in every step")
LANES = b.Bound("lanes", "", 1, 50_000, "the map of a town has some thousands")
VERTICES = b.Bound("vertices of a map", "", 0, 5_000_000, "the map of a town has some 100,000")
POSES = b.Bound(
    "poses of all tracks", "", 0, 5_000_000, "an hour of a hundred road users at 10 a second"
)
GAUSSIANS = b.Bound(
    "Gaussians",
    "",
    0,
    20_000_000,
    "more would take 4 GB and a minute to build; lower environment.building_height_m or trees_per_100m",
)


def check_specification(drawn: Drawn) -> None:
    """Check a built road's file before it is built.

    Args:
        drawn: Specification with ``road``.

    Raises:
        InputError: The road, its actors or their number are more than a scenario may have; the
            number is named.
    """
    spec = drawn.spec
    document = drawn.document
    assert spec.road is not None
    segments = spec.road.segments
    length_m = sum(
        getattr(segment, "length_m", 2 * getattr(segment, "arm_length_m", 0.0))
        for segment in segments
    )
    b.ROAD_M.check(length_m, document.mark(("road", "segments")))
    gaps = sum(s.cars_left + s.cars_right for s in segments if isinstance(s, NarrowGapSegment))
    parked = sum(actor.count - 1 for actor in spec.actors if isinstance(actor, ParkedActor))
    reactive = sum(isinstance(actor, IdmActor) for actor in spec.actors)
    place = document.mark(("actors",))
    ACTORS.check(gaps + parked + len(spec.actors), place)
    REACTIVE.check(reactive, place)
    speed_mps = max(spec.ego.cruise_mps, spec.ego.speed_mps)
    driven_m = min(spec.built_until_us * 1e-6 * speed_mps, length_m)
    if spec.background is None:
        held_m = min(driven_m, BUILT_WHOLE_M)
        count = gaussians(spec.environment, held_m, held_m, 0.0)
        GAUSSIANS.check(count, document.mark(("environment",)))


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
    # A longer drive is built in sections, of which no more than so much of its path is held.
    held_m = min(float(arc_lengths(scenario.ego_log.xyz)[-1]), BUILT_WHOLE_M)
    wide, high = np.minimum(np.ptp(xy, axis=0), held_m) + 2 * REACH_M
    GAUSSIANS.check(gaussians(scenario.environment, held_m, float(wide), float(high)), where)


def gaussians(
    environment: Environment | EnvironmentSpec, driven_m: float, wide_m: float, high_m: float
) -> float:
    """Estimate how many Gaussians a scene takes, within about half of the true number.

    Args:
        environment: Surroundings; `Environment`, or the file's section of the same names.
        driven_m: Length of the logged path.
        wide_m, high_m: Sides of the rectangle around it, with what is built beside it.
    """
    length = driven_m + 40.0
    area = max(wide_m, 2 * REACH_M) * max(high_m, 2 * REACH_M)
    trees = environment.trees_per_100m * (0.02 * length + 0.00022 * area)
    walls_m2 = (
        environment.buildings * 2 * length * float(np.mean(environment.building_height_m)) * 2.3
    )
    spacing = environment.poles_spacing_m
    poles = 2 * length / spacing if spacing > 0 else 0.0
    return 1500.0 * (length + 100.0) + 760.0 * trees + 22.0 * walls_m2 + 100.0 * poles


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
    b.EPOCH_US.check(float(np.abs(track.t_us[[0, -1]]).max()), where)
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
