"""What a scenario may hold and cost: the one gate that every source passes.

`check_record` looks at what a reader returned, `check_scenario` at the finished scenario. Ranges of
single quantities are in `alpasim_plugin.core.files.limits`.

The cost of the Gaussians follows what was counted on built roads of 0.1 to 5 km: ground and kerbs by the drive's length, trees and walls by the surroundings, and for
sharp cameras lane markings, kerbs and road users once more for every halving of their cells.
"""

from dataclasses import astuple

import numpy as np

from alpasim_plugin.core.detail import halvings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import limits as b
from alpasim_plugin.core.geometry import arc_lengths
from alpasim_plugin.core.types import F64, Scenario
from alpasim_plugin.world.ground import BUILT_WHOLE_M
from scenarios.map_borders import lane_edges
from scenarios.recorded import RecordedLog

REACH_M = 110.0  # the surroundings are built so far from the drive

ACTORS = b.Bound("road users", "", 0, 1_000, "recorded scenes have a few hundred")
REACTIVE = b.Bound("reactive drivers", "", 0, 200, "each follows its lane in every step")
GAUSSIANS = b.Bound(
    "Gaussians",
    "",
    0,
    20_000_000,
    "more would take 4 GB and a minute to build; lower environment.building_height_m or trees_per_100m",
)


def check_record(record: RecordedLog, location: str) -> None:
    """Check what a reader returned, ours or a third party's.

    Args:
        record: Map, drive and traffic.
        location: The log, for messages.

    Raises:
        InputError: A number that is not finite or out of range.
    """
    lane_map = record.lane_map
    lines = [
        record.ego_log.xyz,
        *(lane.centre for lane in lane_map.lanes.values()),
        *lane_edges(lane_map.lanes),
        *lane_map.road_edges,
        *lane_map.drivable_areas,
    ]
    _check_reach(np.concatenate(lines), f"{location}, map and drive")
    for actor in record.actors:
        part_location = f"{location}, road user {actor.actor_id}"
        for side_m in astuple(actor.box):
            b.BODY_M.check(side_m, part_location)
        _check_reach(actor.track.xyz, part_location)
    for side_m in astuple(record.vehicle.box):
        b.VEHICLE_M.check(side_m, f"{location}, ego")
    for camera in record.cameras:
        part_location = f"{location}, camera {camera.name}"
        for side_px in (camera.width, camera.height):
            b.IMAGE_SIDE_PX.check(side_px, part_location)
        if not (np.isfinite(camera.K).all() and np.isfinite(camera.T_rig_camera).all()):
            raise InputError(f"{part_location}: a lens or mount that is not finite", "repair it")


def check_scenario(scenario: Scenario, location: str) -> None:
    """Check a finished scenario of any source: its road users, its length and what building it
    would cost.

    Raises:
        InputError: More than a scenario may have; the number is named.
    """
    ACTORS.check(len(scenario.actors), location)
    REACTIVE.check(sum(actor.behaviour.kind != "replay" for actor in scenario.actors), location)
    b.LOG_S.check((scenario.end_us - scenario.start_us) * 1e-6, location, "length")
    if scenario.background is not None:
        return
    GAUSSIANS.check(gaussians_of(scenario), location)


def gaussians_of(scenario: Scenario) -> float:
    """Estimate how many Gaussians a built scene takes at all levels of detail, within about half of
    the true number.
    """
    xyz = scenario.ego_log.xyz
    driven_m = float(arc_lengths(xyz)[-1])
    # A longer drive is built in sections, of which no more than so much of its path is held.
    held_m = min(driven_m, BUILT_WHOLE_M)
    sides_m = np.minimum(np.ptp(xyz[:, :2], axis=0), held_m) + 2 * REACH_M
    environment = scenario.environment
    length = held_m + 40.0
    trees = environment.trees_per_100m * (0.02 * length + 0.00022 * float(np.prod(sides_m)))
    height_m = float(np.mean(environment.building_height_m))
    walls_m2 = environment.buildings * 2 * length * height_m * 2.3
    spacing = environment.poles_spacing_m
    poles = 2 * length / spacing if spacing > 0 else 0.0
    usual = 1500.0 * (length + 100.0) + 760.0 * trees + 22.0 * walls_m2 + 100.0 * poles
    halved = halvings(scenario)
    if not halved:
        return usual
    low = xyz[:, :2].min(axis=0) - REACH_M
    high = xyz[:, :2].max(axis=0) + REACH_M
    lanes_m = 0.0
    for lane in scenario.lane_map.lanes.values():
        near = ((lane.centre[1:, :2] > low) & (lane.centre[1:, :2] < high)).all(axis=1)
        lanes_m += float(np.diff(arc_lengths(lane.centre))[near].sum())
    held_lanes_m = lanes_m * held_m / max(driven_m, 1.0)
    finer = sum(4**n for n in halved) * (5.0 * held_lanes_m + 20.0 * (held_m + 40.0))
    return usual + finer + 13_000.0 * len(scenario.actors)


def memory_mb(scenario: Scenario, drawn_pixels: float) -> float:
    """Estimate the most memory that a process takes to show a built scene."""
    return 220.0 + 2e-4 * gaussians_of(scenario) + 3e-5 * drawn_pixels


def _check_reach(xyz: F64, location: str) -> None:
    """Refuse points farther from the origin than a scene reaches, or not finite."""
    b.COORDINATE_M.check(float(np.abs(xyz).max(initial=0.0)), location, "farthest coordinate")
