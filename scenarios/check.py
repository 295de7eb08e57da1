"""Check that the expert's drive stays on the road and clear of all actors; runs when a built scenario is loaded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, lane_polygon
from alpasim_plugin.core.types import F64, I64, Actor, LaneMap, Trajectory, Vehicle

MIN_GAP_M = 0.3
STEP_US = 50_000
SEAM_M = 1e-3  # lanes that share an edge are joined over rounding


def check_drive(lane_map: LaneMap, ego_log: Trajectory, vehicle: Vehicle, actors: Sequence[Actor], end_us: int) -> None:
    """Check the ego's footprint from the log's start to ``end_us``.

    Raises:
        InputError: It comes nearer than 0.3 m to an actor, or leaves the union of the vehicle lanes.
    """
    t_us = np.arange(int(ego_log.t_us[0]), min(end_us, int(ego_log.t_us[-1])) + 1, STEP_US, dtype=np.int64)
    ego = footprints(interpolate(ego_log, t_us), vehicle.box.length_m, vehicle.box.width_m, vehicle.rear_axle_to_centre_m)
    lanes = [lane for lane in lane_map.lanes.values() if lane.kind == "vehicle" and lane.left is not None and lane.right is not None]
    road = shapely.union_all([shapely.buffer(lane_polygon(lane), SEAM_M) for lane in lanes])
    shapely.prepare(road)
    off = np.flatnonzero(~shapely.covers(road, ego))
    if len(off):
        raise InputError(
            "checking the expert's drive", "the road",
            f"at {t_us[off[0]] / 1e6:.2f} s {shapely.area(shapely.difference(ego[off[0]], road)):.2f} m2 of the ego leave the lanes",
            "use wider lanes, gentler bends, a larger corner_radius_m, or a smaller shift_m",
        )  # fmt: skip
    gap, when, who = min(((*_least_gap(ego, t_us, actor), actor.actor_id) for actor in actors), default=(np.inf, 0, ""))
    if gap < MIN_GAP_M:
        raise InputError(
            "checking the expert's drive", f"actor {who}", f"at {when / 1e6:.2f} s the gap to the ego is {gap:.2f} m (least allowed "
            f"{MIN_GAP_M} m)", "start the actor farther away, change its timing, or slow the ego down",
        )  # fmt: skip


def footprints(poses: F64, length_m: float, width_m: float, ahead_m: float = 0.0) -> F64:
    """Return rectangles (object array of polygons) of bodies at poses ``(T, 4, 4)``, their middle ``ahead_m`` in front of the pose."""
    x, y = length_m / 2, width_m / 2
    corners = np.array([[ahead_m + x, y, 0, 1], [ahead_m - x, y, 0, 1], [ahead_m - x, -y, 0, 1], [ahead_m + x, -y, 0, 1]])
    rings: F64 = shapely.polygons((corners @ np.swapaxes(poses, -1, -2))[..., :2])
    return rings


def _least_gap(ego: F64, t_us: I64, actor: Actor) -> tuple[float, int]:
    there = np.flatnonzero((t_us >= actor.track.t_us[0]) & (t_us <= actor.track.t_us[-1]))
    if len(there) == 0:
        return float("inf"), 0
    bodies = footprints(interpolate(actor.track, t_us[there]), actor.box.length_m, actor.box.width_m)
    distance = shapely.distance(ego[there], bodies)
    k = int(np.argmin(distance))
    return float(distance[k]), int(t_us[there[k]])
