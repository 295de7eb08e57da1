"""Plan-view areas of lanes, as shapely polygons. Apart from the other geometry, so that a served
policy needs no shapely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from alpasim_plugin.core.types import F64, Lane

HALF_WIDTH_M = 1.85


def lane_polygon(lane: Lane, half_width_m: float = HALF_WIDTH_M) -> Any:
    """Return the plan-view area of a lane as a shapely Polygon or MultiPolygon (empty where nothing
    has area).

    With both edges it is the ring of the left edge and the reversed right edge; of one that crosses
    itself, all that it winds round (`ring_area`). Where an edge is missing, the centre is buffered
    by ``half_width_m`` (round ends), which is what the paper's protocol and AlpaSim's off-road rule
    do.

    Args:
        lane: The lane; coordinates in metres, world.
        half_width_m: Buffer of the centre where an edge is missing.
    """
    if lane.left is None or lane.right is None:
        xy = np.ascontiguousarray(lane.centre[:, :2])
        line = shapely.linestrings(xy) if len(xy) > 1 else shapely.points(xy[0])
        return shapely.buffer(line, half_width_m, quad_segs=16)
    return ring_area(np.concatenate([lane.left[:, :2], lane.right[::-1, :2]]))


def lane_polygons(
    lanes: Sequence[Lane], origin: F64, half_width_m: float = HALF_WIDTH_M, even_odd: bool = False
) -> npt.NDArray[Any]:
    """Return the areas ``(L,)`` of lanes, as `lane_polygon` gives them for lanes moved to an origin
    ``(3,)``, all in a few calls.

    By ``even_odd`` what a ring winds round twice is a hole, as in AlpaSim.
    """
    out = np.full(len(lanes), None, dtype=object)
    edged = [
        (k, one.left[:, :2], one.right[::-1, :2])
        for k, one in enumerate(lanes)
        if one.left is not None and one.right is not None
    ]
    rings = {
        k: np.concatenate([left, right]) for k, left, right in edged if len(left) + len(right) > 2
    }
    if rings:
        ringed = np.array(list(rings))
        owner = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings.values()])
        out[ringed] = shapely.polygons(
            shapely.linearrings(np.concatenate(list(rings.values())) - origin[:2], indices=owner)
        )
        for k in ringed[~shapely.is_valid(out[ringed])]:
            out[k] = areal_parts(shapely.make_valid(out[k])) if even_odd else _wound(out[k])
    for k in [k for k, area in enumerate(out) if area is None]:
        left, right = (
            None if edge is None else edge - origin for edge in (lanes[k].left, lanes[k].right)
        )
        out[k] = lane_polygon(
            replace(lanes[k], centre=lanes[k].centre - origin, left=left, right=right), half_width_m
        )
    return out


def ring_area(ring: F64) -> Any:
    """Return the plan-view area that a ring ``(N, 2+)`` winds round at least once: a lane on a ramp
    may lie above itself.
    """
    if len(ring) < 3:
        return shapely.Polygon()
    polygon = shapely.polygons(np.ascontiguousarray(ring[:, :2]))
    return polygon if shapely.is_valid(polygon) else _wound(polygon)


def _wound(polygon: Any) -> Any:
    """Return what the ring of a polygon winds round; by ``make_valid`` (even-odd), what it winds
    round twice would be a hole.
    """
    faces = shapely.get_parts(
        shapely.polygonize([shapely.node(shapely.get_exterior_ring(polygon))])
    )
    inside = shapely.get_coordinates(shapely.point_on_surface(faces))  # (F, 2)
    ring = shapely.get_coordinates(polygon)[None] - inside[:, None]  # (F, N, 2)
    turn = np.diff(np.unwrap(np.arctan2(ring[..., 1], ring[..., 0]), axis=1)[:, [0, -1]])[:, 0]
    return areal_parts(shapely.union_all(faces[np.abs(turn) > np.pi]))


def areal_parts(shape: Any) -> Any:
    """Keep the polygons of any shapely geometry and drop its lines and points."""
    parts = [
        p
        for p in shapely.get_parts(shapely.get_parts(shape))
        if shapely.get_dimensions(p) == 2 and not shapely.is_empty(p)
    ]
    if not parts:
        return shapely.Polygon()
    return parts[0] if len(parts) == 1 else shapely.union_all(parts)
