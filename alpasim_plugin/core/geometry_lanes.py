"""Plan-view shapes of lanes, shared by the map index and by evaluators: pure functions of a `Lane`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F64, Lane

HALF_WIDTH_M = 1.85


def lane_polygon(lane: Lane, half_width_m: float = HALF_WIDTH_M) -> Any:
    """Return the plan-view area of a lane as a shapely Polygon or MultiPolygon (empty where nothing has area).

    With both edges it is the ring of the left edge and the reversed right edge; a ring that crosses itself is repaired by
    ``make_valid`` and only its areal parts are kept. Where an edge is missing, the centre is buffered by ``half_width_m`` (round ends),
    which is what the paper's protocol and AlpaSim's off-road rule do.

    Args:
        lane: The lane; coordinates in metres, world.
        half_width_m: Buffer of the centre where an edge is missing.
    """
    if lane.left is None or lane.right is None:
        xy = np.ascontiguousarray(lane.centre[:, :2])
        line = shapely.linestrings(xy) if len(xy) > 1 else shapely.points(xy[0])
        return shapely.buffer(line, half_width_m, quad_segs=16)
    return ring_area(np.concatenate([lane.left[:, :2], lane.right[::-1, :2]]))


def lane_polygons(lanes: Sequence[Lane], origin: F64, half_width_m: float = HALF_WIDTH_M) -> npt.NDArray[Any]:
    """Return the areas ``(L,)`` of lanes, as `lane_polygon` gives them for lanes moved to an origin ``(3,)``, all in a few calls."""
    out = np.full(len(lanes), None, dtype=object)
    edged = [(k, one.left[:, :2], one.right[::-1, :2]) for k, one in enumerate(lanes) if one.left is not None and one.right is not None]
    rings = {k: np.concatenate([left, right]) for k, left, right in edged if len(left) + len(right) > 2}
    if rings:
        ringed = np.array(list(rings))
        owner = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings.values()])
        out[ringed] = shapely.polygons(shapely.linearrings(np.concatenate(list(rings.values())) - origin[:2], indices=owner))
        for k in ringed[~shapely.is_valid(out[ringed])]:
            out[k] = areal_parts(shapely.make_valid(out[k]))
    for k in [k for k, area in enumerate(out) if area is None]:
        left, right = (None if edge is None else edge - origin for edge in (lanes[k].left, lanes[k].right))
        out[k] = lane_polygon(replace(lanes[k], centre=lanes[k].centre - origin, left=left, right=right), half_width_m)
    return out


def ring_area(ring: F64) -> Any:
    """Return the plan-view area inside a ring ``(N, 2+)``, repaired as in `lane_polygon`."""
    if len(ring) < 3:
        return shapely.Polygon()
    polygon = shapely.polygons(np.ascontiguousarray(ring[:, :2]))
    return polygon if shapely.is_valid(polygon) else areal_parts(shapely.make_valid(polygon))


def areal_parts(shape: Any) -> Any:
    """Keep the polygons of any shapely geometry and drop its lines and points."""
    parts = [p for p in shapely.get_parts(shapely.get_parts(shape)) if shapely.get_dimensions(p) == 2 and not shapely.is_empty(p)]
    if not parts:
        return shapely.Polygon()
    return parts[0] if len(parts) == 1 else shapely.union_all(parts)


def densify(line: F64, max_step_m: float = 2.0) -> F64:
    """Insert points so that neighbours of a polyline ``(N, D)`` are at most ``max_step_m`` apart in plan view; its own vertices stay."""
    steps = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
    count = np.maximum(np.ceil(steps / max_step_m - 1e-9).astype(np.int64), 1)  # pieces per segment
    if count.size == 0 or int(count.max()) == 1:
        return line
    segment = np.repeat(np.arange(len(count)), count)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    fraction = (np.arange(len(segment)) - first[segment]) / count[segment]
    points = line[segment] + fraction[:, None] * (line[segment + 1] - line[segment])
    return np.concatenate([points, line[-1:]])


def centre_line(left: F64, right: F64, max_step_m: float = 2.0) -> F64:
    """Return the line ``(N, 3)`` halfway between two edges ``(L, 3)`` and ``(R, 3)`` that need not have the same number of points.

    Points at equal shares of both edges' lengths are averaged, at every vertex of either edge and at most ``max_step_m`` apart.
    """
    share_left, share_right = _shares(left), _shares(right)
    shares = np.unique(np.round(np.concatenate([share_left, share_right]), 9))
    length = max(float(arc_lengths(left)[-1]), float(arc_lengths(right)[-1]))
    at_left, at_right = resample(left, shares * arc_lengths(left)[-1]), resample(right, shares * arc_lengths(right)[-1])
    middle = (at_left + at_right) / 2
    steps = np.linalg.norm(np.diff(middle[:, :2], axis=0), axis=1)
    keep = np.concatenate([[True], steps > 1e-6 * max(length, 1.0)])
    keep[-1] = True
    return densify(middle[keep], max_step_m)


def _shares(line: F64) -> F64:
    s = arc_lengths(line)
    return s / s[-1] if s[-1] > 0 else np.linspace(0.0, 1.0, len(s))
