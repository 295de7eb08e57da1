"""Where the ego should go: the recorded path, named by lanes and carried on past the end of the recording."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths, inverse, project, resample, transform_points, wrap_angle, yaw_from_quat, yaw_of
from alpasim_plugin.core.types import F64, LaneMap, Route, Trajectory
from alpasim_plugin.world.lane_map import LaneIndex

MIN_STEP_M = 0.2  # recorded points closer than this to the last kept one are dropped: a car at rest only adds noise
SAMPLE_M = 1.0  # the recorded path is matched to lanes this often
EXTENSION_M = 120.0  # enough for the 80 m that a policy sees, beyond the end of the log
BLEND_M = 20.0  # the lateral offset at the end of the log fades out over this length
MATCH_RADIUS_M = 4.0  # a point outside every lane is matched to lanes with a centre vertex this near
MAX_HEADING_ERROR_RAD = np.pi / 3
HEADING_WEIGHT_M = 3.0


def route_from_log(lane_map: LaneMap, ego_log: Trajectory, extension_m: float = EXTENSION_M) -> Route:
    """Make the route of a recorded drive.

    The polyline is the recorded path itself, thinned to `MIN_STEP_M`, so that following it reproduces the human; past its end it goes on
    along lane centres, at each fork with the smallest heading change, and the offset from the centre fades out over `BLEND_M`. Where
    the log ends outside every lane, or the map ends, the route ends too. ``lane_ids`` are the lanes of both parts in driving order.

    Raises:
        InputError: The log has no pose, or a position that is not finite.
    """
    if len(ego_log) == 0 or not np.isfinite(ego_log.xyz).all():
        found = "no poses" if len(ego_log) == 0 else "positions that are not finite"
        raise InputError("making a route", "the recorded drive", found, "use a log with at least one finite pose")
    driven = _thin(ego_log.xyz)
    index = LaneIndex(lane_map)
    if len(driven) < 2:
        driven = np.concatenate([driven, driven])
        heading = float(yaw_from_quat(ego_log.quat[-1]))
    else:
        heading = _heading_at_end(driven)
    ids = match_lanes(index, driven, float(yaw_from_quat(ego_log.quat[0])))
    if not ids or extension_m <= 0:
        return Route(driven, ids)
    end = driven[-1]
    ahead = index.path_ahead(ids[-1], extension_m, start=end)
    if len(ahead.xyz) < 2 or abs(float(wrap_angle(index.heading_rad(ids[-1], end) - heading))) > MAX_HEADING_ERROR_RAD:
        return Route(driven, ids)
    s = arc_lengths(ahead.xyz)
    fade = np.clip(1 - s / BLEND_M, 0.0, 1.0)
    fade = fade * fade * (3 - 2 * fade)  # smooth at both ends
    tail = ahead.xyz + fade[:, None] * (end - ahead.xyz[0])
    if np.linalg.norm(driven[0] - driven[-1]) == 0 and len(driven) == 2:
        driven = driven[:1]
    return Route(np.concatenate([driven, tail[1:]]), ids + ahead.lane_ids[1:])


def match_lanes(index: LaneIndex, path: F64, first_heading_rad: float) -> tuple[str, ...]:
    """Name the lanes along a path ``(N, 3)`` in driving order, consistently over places where lanes overlap.

    Lanes overlap in intersections, so single points are ambiguous. A shortest path over all samples (Viterbi) weighs how far each
    sample is from a lane's centre and heading against how plausible the change of lane is: staying is free, a successor nearly, a
    neighbour costs more, a jump most. Samples in no lane's reach name no lane.
    """
    total = float(arc_lengths(path)[-1])
    at = np.linspace(0.0, total, max(int(np.ceil(total / SAMPLE_M)), 1) + 1) if total > 0 else np.zeros(1)
    points = resample(path, at) if total > 0 else path[:1]
    ahead = resample(path, np.minimum(at + SAMPLE_M / 2, total)) - resample(path, np.maximum(at - SAMPLE_M / 2, 0.0)) if total > 0 else None
    headings = np.array([first_heading_rad]) if ahead is None else np.arctan2(ahead[:, 1], ahead[:, 0])
    inside = index.containing_many(points)
    layers: list[dict[str, tuple[float, str | None]]] = []
    for point, heading, lanes in zip(points, headings, inside, strict=True):
        local = _local_costs(index, point, float(heading), lanes)
        if not local:
            continue
        before = layers[-1] if layers else {}
        layer: dict[str, tuple[float, str | None]] = {}
        for new, cost in local.items():
            options = [(c + _change_cost(index, old, new), old) for old, (c, _) in before.items()]
            best: tuple[float, str | None] = min(options) if options else (0.0, None)
            layer[new] = (best[0] + cost, best[1])
        layers.append(layer)
    if not layers:
        return ()
    lane: str | None = min(layers[-1], key=lambda name: layers[-1][name][0])
    chain: list[str] = []
    for layer in reversed(layers):
        assert lane is not None
        if not chain or chain[-1] != lane:
            chain.append(lane)
        lane = layer[lane][1]
    return tuple(reversed(chain))


def _local_costs(index: LaneIndex, point: F64, heading_rad: float, inside: tuple[str, ...]) -> dict[str, float]:
    """Return the cost of each lane that a sample may be in: offset from the centre in metres plus heading error."""
    candidates = inside or index.within(point, MATCH_RADIUS_M)
    costs: dict[str, float] = {}
    for lane_id in candidates:
        error = abs(float(wrap_angle(index.heading_rad(lane_id, point) - heading_rad)))
        if error < MAX_HEADING_ERROR_RAD:
            offset = abs(project(index.lane_map.lanes[lane_id].centre, point)[1])
            costs[lane_id] = offset + 2.0 * error
    return costs


def _change_cost(index: LaneIndex, old: str, new: str) -> float:
    if old == new:
        return 0.0
    lane = index.lane_map.lanes[old]
    if new in lane.successors:
        return 0.1
    return 4.0 if new in (lane.left_neighbour, lane.right_neighbour) else 12.0


def route_in_rig(route: Route, T_world_rig: F64, n: int = 20, spacing_m: float = 80 / 19) -> F64:
    """Return the route ahead ``(n, 3)`` in the rig frame, z = 0, with NaN rows after the route's end.

    The first point is the ego's projection on the route. Where the route passes the same place twice, the pass that runs in the
    ego's direction counts: one radian of heading error weighs as much as `HEADING_WEIGHT_M` of distance.
    """
    out = np.full((n, 3), np.nan)
    line = route.xyz
    if len(line) < 2:
        return out
    begin = _project_ahead(line, T_world_rig[:2, 3], yaw_of(T_world_rig))
    at = begin + spacing_m * np.arange(n)
    seen = at <= arc_lengths(line)[-1] + 1e-9
    out[seen] = transform_points(inverse(T_world_rig), resample(line, at[seen]))
    out[seen, 2] = 0.0
    return out


def _project_ahead(line: F64, xy: F64, yaw: float) -> float:
    """Return the arc length of the point of the route that is nearest in place and direction."""
    a, d = line[:-1, :2], np.diff(line[:, :2], axis=0)
    length2 = np.maximum(np.sum(d * d, axis=1), 1e-300)
    f = np.clip(np.sum((xy - a) * d, axis=1) / length2, 0.0, 1.0)
    distance = np.linalg.norm(xy - (a + f[:, None] * d), axis=1)
    error = np.abs(wrap_angle(np.arctan2(d[:, 1], d[:, 0]) - yaw))
    i = int(np.argmin(distance + HEADING_WEIGHT_M * error))
    return float(arc_lengths(line)[i] + f[i] * np.sqrt(length2[i]))


def _thin(xyz: F64) -> F64:
    """Drop points nearer than `MIN_STEP_M` to the last kept one; the last point stays."""
    kept = [0]
    for i in range(1, len(xyz)):
        if np.linalg.norm(xyz[i, :2] - xyz[kept[-1], :2]) >= MIN_STEP_M:
            kept.append(i)
    if kept[-1] != len(xyz) - 1 and np.linalg.norm(xyz[-1, :2] - xyz[kept[-1], :2]) > 0.05:
        kept.append(len(xyz) - 1)
    return np.asarray(xyz[kept], dtype=np.float64)


def _heading_at_end(line: F64) -> float:
    s = arc_lengths(line)
    a, b = resample(line, [max(s[-1] - 1.0, 0.0), s[-1]])
    return float(np.arctan2(b[1] - a[1], b[0] - a[0]))
