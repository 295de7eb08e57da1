"""Borders of the drivable surface of a map: of the union of its areas, on each level.

Where no areas lie above one another, the surface is their union in plan view. Elsewhere, as with a
bridge, a ramp or the decks of a car park, areas are put on sheets, of which none holds two areas
above one another. The borders of each sheet are those of its union, without the places where it
joins an area of another sheet at the same height. Lanes that climb are cut in pieces before, so that
each has one height and none lies above itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import scipy
import shapely

from alpasim_plugin.core.geometry import arc_lengths, densify, resample
from alpasim_plugin.core.lane_areas import lane_polygon, touching_pairs
from alpasim_plugin.core.types import F64, I64, Bool, Lane
from alpasim_plugin.world.route import LEVEL_M

SEAM_M = 0.1  # neighbouring areas drawn with gaps up to this wide are one surface
MIN_HOLE_M2 = 0.5  # smaller holes are seams too
STEP_M = 2.0  # AlpaSim's loaders keep the vertices of edges at most this far apart
SLOPE = 0.2  # areas on one slope may differ in height by so much a metre of their distance
CLIMB_M = 1.0  # a piece of a lane climbs no more


def lane_edges(lanes: Mapping[str, Lane]) -> list[F64]:
    """Return the edges ``(N, 3)`` that lanes have, left before right, lane by lane."""
    return [edge for lane in lanes.values() for edge in (lane.left, lane.right) if edge is not None]


def lane_borders(lanes: Mapping[str, Lane]) -> tuple[F64, ...]:
    """Return the borders ``(N, 3)`` of the surface that lanes make."""
    edges = lane_edges(lanes)
    points = np.concatenate(edges or [lane.centre for lane in lanes.values()])
    if np.ptp(points[:, 2]) > LEVEL_M:
        pieces = [piece for lane in lanes.values() for piece in _pieces(lane)]
        areas = [lane_polygon(piece) for piece in pieces]
        by_level = _level_borders(areas, [piece.centre for piece in pieces], _points_of(pieces))
        if by_level is not None:
            return by_level
    return border_lines(merge_areas([lane_polygon(lane) for lane in lanes.values()]), points)


def surface_borders(
    areas: Sequence[Any], outlines: Sequence[F64], points: Sequence[F64]
) -> tuple[F64, ...]:
    """Return the borders ``(N, 3)`` of the surface that areas make.

    Args:
        areas: B plan-view polygons.
        outlines: B polylines ``(N, 3)`` that say how high an area is near a place.
        points: B arrays ``(N, 3)`` of points on each area, of which borders take their heights.
    """
    by_level = _level_borders(areas, outlines, points)
    if by_level is not None:
        return by_level
    return border_lines(merge_areas(areas), np.concatenate(points))


def _points_of(lanes: Sequence[Lane]) -> list[F64]:
    """Return the points ``(N, 3)`` that each lane has: of its edges, or of its centre."""
    out = []
    for lane in lanes:
        edges = [edge for edge in (lane.left, lane.right) if edge is not None]
        out.append(np.concatenate([densify(line, STEP_M) for line in edges or [lane.centre]]))
    return out


def _pieces(lane: Lane) -> list[Lane]:
    """Return a lane cut across where it has climbed by `CLIMB_M`."""
    lines = [line for line in (lane.centre, lane.left, lane.right) if line is not None]
    climbs_m = max(float(np.abs(np.diff(line[:, 2])).sum()) for line in lines)
    count = int(np.ceil(climbs_m / CLIMB_M))
    if count <= 1:
        return [lane]
    centre, left, right = (
        [None] * count if line is None else _cut(line, count)
        for line in (lane.centre, lane.left, lane.right)
    )
    return [
        replace(lane, centre=c, left=before, right=after)
        for c, before, after in zip(centre, left, right, strict=True)
        if c is not None
    ]


def _cut(line: F64, count: int) -> list[F64]:
    """Cut a polyline ``(N, 3)`` in pieces of equal length."""
    along = arc_lengths(line)
    cuts = np.linspace(0.0, along[-1], count + 1)
    ends = resample(line, cuts)
    out = []
    for k in range(count):
        between = line[(along > cuts[k] + 1e-9) & (along < cuts[k + 1] - 1e-9)]
        out.append(np.concatenate([ends[k : k + 1], between, ends[k + 1 : k + 2]]))
    return out


def _level_borders(
    areas: Sequence[Any], outlines: Sequence[F64], points: Sequence[F64]
) -> tuple[F64, ...] | None:
    """Return the borders of areas of which some lie above one another, None where none do; arguments
    as of `surface_borders`.
    """
    if np.ptp(np.concatenate(points)[:, 2]) <= LEVEL_M:
        return None
    shapes = np.array([shapely.make_valid(area) for area in areas], dtype=object)
    pairs, apart_m, away_m = touching_pairs(shapes, outlines, SEAM_M)
    is_apart = apart_m > LEVEL_M + SLOPE * away_m
    if not is_apart.any():
        return None
    sheet = _sheets(len(shapes), pairs, is_apart)
    wide = shapely.buffer(shapes, SEAM_M, join_style="mitre")
    out: list[F64] = []
    for number in range(int(sheet.max()) + 1):
        members = np.flatnonzero(sheet == number)
        surface = merge_areas(list(shapes[members]))
        joins = pairs[~is_apart & np.any(sheet[pairs] == number, axis=1)]
        joins = joins[sheet[joins[:, 0]] != sheet[joins[:, 1]]]
        joints = shapely.union_all(shapely.intersection(wide[joins[:, 0]], wide[joins[:, 1]]))
        heights = np.concatenate([points[member] for member in members.tolist()])
        out += _open_borders(surface, joints, heights)
    return tuple(out)


def _sheets(count: int, pairs: I64, is_apart: Bool) -> I64:
    """Return the number of the sheet ``(count,)`` of each area.

    An area comes onto the sheet of a neighbour at its height where nothing there lies above or below
    it, else onto the first such sheet.

    Args:
        count: How many areas there are.
        pairs: ``(P, 2)`` areas that touch.
        is_apart: ``(P,)`` whether they do so in plan view alone.
    """
    neighbours: list[list[int]] = [[] for _ in range(count)]
    stacked: list[set[int]] = [set() for _ in range(count)]
    for (first, second), apart in zip(pairs.tolist(), is_apart.tolist(), strict=True):
        if apart:
            stacked[first].add(second)
            stacked[second].add(first)
        else:
            neighbours[first].append(second)
            neighbours[second].append(first)
    sheet = np.full(count, -1, dtype=np.int64)
    for start in range(count):
        queue = [start] if sheet[start] < 0 else []
        while queue:
            area = queue.pop(0)
            if sheet[area] >= 0:
                continue
            taken = {int(sheet[other]) for other in stacked[area]}
            joined = [int(sheet[other]) for other in neighbours[area] if sheet[other] >= 0]
            sheet[area] = next(
                number for number in chain(sorted(joined), range(count)) if number not in taken
            )
            queue += neighbours[area]
    return sheet


def _open_borders(surface: Any, joints: Any, heights: F64) -> list[F64]:
    """Return the borders ``(N, 3)`` of a surface outside of the places where it is joined."""
    if shapely.is_empty(joints):
        return list(border_lines(surface, heights))
    tree = scipy.spatial.KDTree(heights[:, :2])
    rings = [ring for part in shapely.get_parts(surface) for ring in shapely.get_rings(part)]
    open_parts = shapely.get_parts(shapely.difference(np.array(rings, dtype=object), joints))
    lines = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(open_parts)))
    return [_lifted(line, tree, heights) for line in lines if shapely.length(line) > SEAM_M]


def merge_areas(areas: Sequence[Any]) -> Any:
    """Return the union of shapely areas with seams up to `SEAM_M` closed and tiny holes filled.

    Closing is a mitred offset outwards and back, which moves no straight border.
    """
    half = SEAM_M / 2
    merged = shapely.union_all([shapely.make_valid(area) for area in areas])
    closed = shapely.buffer(merged, half, join_style="mitre", mitre_limit=2.0)
    closed = shapely.union_all(
        [merged, shapely.buffer(closed, -half, join_style="mitre", mitre_limit=2.0)]
    )
    parts = [part for part in shapely.get_parts(closed) if shapely.get_type_id(part) == 3]
    filled = [
        shapely.Polygon(
            p.exterior, [h for h in p.interiors if shapely.Polygon(h).area >= MIN_HOLE_M2]
        )
        for p in parts
    ]
    return shapely.union_all(filled)


def border_lines(area: Any, heights: F64) -> tuple[F64, ...]:
    """Return the borders of a shapely area as closed polylines ``(N, 3)``, exterior rings first in
    each part.

    Args:
        area: Polygon or MultiPolygon.
        heights: ``(M, 3)`` points of the source; a border vertex takes the height of the nearest
            one.
    """
    tree = scipy.spatial.KDTree(heights[:, :2])
    rings = [ring for part in shapely.get_parts(area) for ring in shapely.get_rings(part)]
    return tuple(_lifted(ring, tree, heights) for ring in rings)


def _lifted(line: Any, tree: Any, heights: F64) -> F64:
    """Return a shapely line as a polyline ``(N, 3)`` at the heights of the nearest points ``(M, 3)``,
    whose places in plan view ``tree`` holds.
    """
    xy = densify(shapely.get_coordinates(line), STEP_M)
    return np.column_stack([xy, heights[tree.query(xy)[1], 2]])
