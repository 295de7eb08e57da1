"""Plan-view areas of lanes, as shapely polygons. Apart from the other geometry, so that a served
policy needs no shapely.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.geometry import heading_of
from alpasim_plugin.core.types import F64, I64, Lane

HALF_WIDTH_M = 1.85
WORLD_ORIGIN = np.zeros(3)
PASSAGE_M = 1.0  # passages of a line at distances that differ by less are equally near


def lane_polygon(
    lane: Lane,
    half_width_m: float = HALF_WIDTH_M,
    even_odd: bool = False,
    origin: F64 = WORLD_ORIGIN,
) -> Any:
    """Return the plan-view area of a lane as a shapely Polygon or MultiPolygon (empty where nothing
    has area).

    With both edges it is the ring of the left edge and the reversed right edge; of one that crosses
    itself, all that it winds round (`ring_area`). Where an edge is missing, the centre is buffered
    by ``half_width_m`` (round ends), which is what the paper's protocol and AlpaSim's off-road rule
    do.

    Args:
        lane: The lane; coordinates in metres, world.
        half_width_m: Buffer of the centre where an edge is missing.
        even_odd: What the ring winds round twice is a hole, as in AlpaSim.
        origin: ``(3,)`` world point that becomes (0, 0) of the area.
    """
    if lane.left is None or lane.right is None:
        xy = np.ascontiguousarray(lane.centre[:, :2] - origin[:2])
        line = shapely.linestrings(xy) if len(xy) > 1 else shapely.points(xy[0])
        return shapely.buffer(line, half_width_m, quad_segs=16)
    edges = lane.left, lane.right
    if not even_odd and all(
        len(edge) > 3 and np.allclose(edge[0], edge[-1], 0, 1e-6) for edge in edges
    ):
        # A lane that leads into itself: what lies between its two closed edges.
        return shapely.symmetric_difference(*(ring_area(edge - origin) for edge in edges))
    ring = np.concatenate([lane.left[:, :2], lane.right[::-1, :2]])
    return ring_area(ring - origin[:2], even_odd)


def ring_area(ring: F64, even_odd: bool = False) -> Any:
    """Return the plan-view area that a ring ``(N, 2+)`` winds round at least once: a lane on a ramp
    may lie above itself. By ``even_odd`` what it winds round twice is a hole.
    """
    if len(ring) < 3:
        return shapely.Polygon()
    polygon = shapely.polygons(np.ascontiguousarray(ring[:, :2]))
    if shapely.is_valid(polygon):
        return polygon
    if even_odd:
        return areal_parts(shapely.make_valid(polygon))
    faces = shapely.get_parts(
        shapely.polygonize([shapely.node(shapely.get_exterior_ring(polygon))])
    )
    inside = shapely.get_coordinates(shapely.point_on_surface(faces))  # (F, 2)
    to_ring = shapely.get_coordinates(polygon)[None] - inside[:, None]  # (F, N, 2)
    turn = np.diff(np.unwrap(heading_of(to_ring), axis=1)[:, [0, -1]])[:, 0]
    return areal_parts(shapely.union_all(faces[np.abs(turn) > np.pi]))


def areal_parts(shape: Any) -> Any:
    """Keep the polygons of any shapely geometry and drop its lines and points."""
    parts = [
        part
        for part in shapely.get_parts(shapely.get_parts(shape))
        if shapely.get_dimensions(part) == 2 and not shapely.is_empty(part)
    ]
    if not parts:
        return shapely.Polygon()
    return parts[0] if len(parts) == 1 else shapely.union_all(parts)


def touching_pairs(areas: Any, outlines: Sequence[F64], reach_m: float) -> tuple[I64, F64, F64]:
    """Return the pairs of areas that share a place, or come nearer to each other than twice a
    distance, how far they are apart in height there, and how far that place is from their outlines:
    on a slope two areas at one height differ by as much as it rises over that distance.

    Args:
        areas: ``(B,)`` plan-view polygons.
        outlines: B polylines ``(N, 3)`` that give their heights: of a place, that of the nearest
            point of the line.
        reach_m: Distance by which areas are widened.

    Returns:
        Rows ``(P, 2)`` of areas, the lower number first; differences of height ``(P,)``, metres; and
        sums of both distances ``(P,)``, metres.
    """
    wide = shapely.buffer(areas, reach_m, join_style="mitre")
    first, second = shapely.STRtree(wide).query(wide, predicate="intersects")
    pairs = np.stack([first, second], axis=1)[first < second]
    shared = shapely.intersection(wide[pairs[:, 0]], wide[pairs[:, 1]])
    has_area = shapely.area(shared) > 0
    pairs = pairs[has_area]
    places = shapely.point_on_surface(shared[has_area])
    lines = np.array([_line_of(outline) for outline in outlines], dtype=object)
    heights = []
    away_m = np.zeros(len(pairs))
    for number in pairs.T:
        along = shapely.line_locate_point(lines[number], places)
        heights.append(shapely.get_z(shapely.line_interpolate_point(lines[number], along)))
        away_m += shapely.distance(lines[number], places)
    return pairs, np.abs(heights[0] - heights[1]), away_m


def distance_and_rise(line: F64, xyz: F64) -> tuple[F64, F64]:
    """Return how far ``(T,)`` a polyline ``(N, 3)`` is from points ``(T, 3)`` in plan view, and how
    far it is above or below them there: where it passes several times equally near, as a road that
    winds above itself, at the height of the passage that is nearest in height.
    """
    start = line if len(line) == 1 else line[:-1]
    step = np.zeros((1, 3)) if len(line) == 1 else np.diff(line, axis=0)
    length2 = np.maximum(np.sum(step[:, :2] ** 2, axis=1), 1e-12)
    offset = xyz[:, None, :2] - start[None, :, :2]  # (T, N - 1, 2)
    share = np.clip(np.sum(offset * step[None, :, :2], axis=2) / length2, 0.0, 1.0)
    away_m = np.linalg.norm(offset - share[..., None] * step[None, :, :2], axis=2)
    rise_m = np.abs(start[:, 2] + share * step[:, 2] - xyz[:, None, 2])
    nearest_m = away_m.min(axis=1)
    is_near = away_m <= nearest_m[:, None] + PASSAGE_M
    return nearest_m, np.where(is_near, rise_m, np.inf).min(axis=1)


def _line_of(outline: F64) -> Any:
    """Return a polyline ``(N, 3)`` in space; of one point a line without length."""
    return shapely.linestrings(np.repeat(outline, 2, axis=0) if len(outline) == 1 else outline)
