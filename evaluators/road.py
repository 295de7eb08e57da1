"""The road as evaluators see it: lane areas, lane centres and road edges of one map.

Areas, borders and unions are built where a drive comes, and kept for the next drive.
"""

from __future__ import annotations

import weakref
from functools import cached_property
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.geometry import lane_polygons, ring_area
from alpasim_plugin.core.types import F64, I64, Bool, LaneMap
from evaluators.border import Borders
from evaluators.footprint import Geometries
from evaluators.polylines import Polylines
from evaluators.presets import Preset
from evaluators.surface import Surface

MOST_SEAM_M = 1e-4  # wider seams change the shape of gaps, not only rounding
MOST_XY_M = 1e5  # farther from the origin, rounding comes near the seam


class Road:
    """Lanes and edges of one map, metres relative to ``origin``."""

    def __init__(self, lane_map: LaneMap, origin: F64, preset: Preset) -> None:
        self._lanes = tuple(lane_map.lanes.values())
        self.origin = origin
        self.lane_ids = tuple(lane.lane_id for lane in self._lanes)
        self._preset = preset
        self._centre = Polylines([lane.centre for lane in self._lanes], origin)
        self._edges = lane_map.road_edges
        self._areas: Geometries = np.full(len(self._lanes), None, dtype=object)
        self._centres: Geometries = np.full(len(self._lanes), None, dtype=object)
        self._unions: dict[bytes, Any] = {}
        self._borders: Borders | None = None
        self._rings = lane_map.drivable_areas

    def areas(self, lane: I64) -> Geometries:
        """Return the prepared areas ``(M,)`` of lanes ``(M,)``; a drive comes near few lanes of a map, so they are built when asked for."""
        asked = np.zeros(len(self._lanes), dtype=np.bool_)
        asked[lane] = True
        new = [k for k in np.flatnonzero(asked).tolist() if self._areas[k] is None]
        if new:
            self._areas[new] = lane_polygons([self._lanes[k] for k in new], self.origin, self._preset.lane_half_width_m)
            shapely.prepare(self._areas[new])
        return np.asarray(self._areas[lane])

    @cached_property
    def edges(self) -> Geometries:
        """Road edges in plan view, ``(E,)``."""
        return np.array([_line(edge[:, :2] - self.origin[:2]) for edge in self._edges], dtype=object)

    @cached_property
    def _edge(self) -> Polylines:
        return Polylines(self._edges, self.origin)

    @cached_property
    def surface(self) -> Surface:
        """All lanes and drivable areas as one surface."""
        outer = [ring - self.origin for ring in self._rings]
        rings = [ring_area(ring) for ring in outer]
        areas = np.array([*self.areas(np.arange(len(self._lanes))), *rings], dtype=object)
        outlines = [*(lane.centre - self.origin for lane in self._lanes), *outer]
        return Surface(areas, outlines, self._preset.seam_m, self._preset.edge_height_m)

    def lanes_near(self, xyz: F64) -> Bool:
        """Return which lanes ``(T, L)`` pass near points ``(T, 3)``, by the preset's radius and query, in 3-D whatever their direction."""
        if self._preset.lane_query == "vertices":
            return self._centre.vertex_within(xyz, self._preset.lane_radius_m)
        return self._centre.line_within(xyz, self._preset.lane_radius_m)

    def union(self, lanes: Bool) -> Any:
        """Return the prepared union of the lanes marked in ``(L,)``; kept, as unions are costly and recur along a drive."""
        key = np.packbits(lanes).tobytes()
        if key not in self._unions:
            shape = join(self.areas(np.flatnonzero(lanes)), self._preset.seam_m)
            shapely.prepare(shape)
            self._unions[key] = shape
        return self._unions[key]

    def borders(self, sets: Bool) -> Borders | None:
        """Return borders that know the union of each set of lanes ``(G, L)``; None where only `union` knows it.

        That is where no seam is closed: rounding then decides whether lanes that share an edge are joined there.
        """
        if not 0 < self._preset.seam_m <= MOST_SEAM_M or float(np.abs(self._centre.vertices).max(initial=0.0)) > MOST_XY_M:
            return None
        if self._borders is None or not self._borders.know(sets):
            lanes = np.flatnonzero(sets.any(axis=0))
            self._borders = Borders(self.areas(lanes), lanes, sets, self._preset.seam_m)
        return self._borders

    def touches_edge(self, footprints: Geometries, xyz: F64) -> Bool:
        """Return whether footprints ``(T,)`` with box centres ``(T, 3)`` lie nearer than the preset's threshold to the road edge.

        ``edge_query`` "any": to any edge at the ego's height. "nearest_vertex": to the edge that owns the vertex nearest to the centre.
        "nearest_of_level": to the one of `_Polylines.nearest_of_level`.
        """
        limit_m = self._preset.edge_touch_m
        if self._preset.edge_query == "nearest_of_level":
            owner = self._edge.nearest_of_level(xyz, self._preset.edge_height_m)
            return np.asarray((owner >= 0) & (shapely.distance(self.edges[owner], footprints) < limit_m))
        if self._preset.edge_query == "nearest_vertex":
            return np.asarray(shapely.distance(self.edges[self._edge.nearest_vertex_owner(xyz)], footprints) < limit_m)
        return self._edge.touched(footprints, xyz[:, 2], limit_m, self._preset.edge_height_m)

    def heading_at(self, lane: I64, xy: F64) -> F64:
        """Return the direction of lanes ``(M,)`` beside points ``(M, 2)``: from 1 cm before to 1 cm after the centre's nearest point."""
        for k in np.unique(lane).tolist():
            if self._centres[k] is None:
                self._centres[k] = _line(self._lanes[k].centre[:, :2] - self.origin[:2])
        lines = self._centres[lane]
        s = shapely.line_locate_point(lines, shapely.points(xy))
        before = shapely.get_coordinates(shapely.line_interpolate_point(lines, np.maximum(s - 0.01, 0.0)))
        after = shapely.get_coordinates(shapely.line_interpolate_point(lines, s + 0.01))
        delta = after - before
        return np.asarray(np.arctan2(delta[:, 1], delta[:, 0]))


def join(areas: Geometries, seam_m: float) -> Any:
    """Return the union of lane areas with gaps up to ``seam_m`` wide closed.

    Lanes that share an edge, but not its vertices, differ there by rounding. Without closing, rounding would decide whether a footprint
    across the edge is contained, and differently at every origin.
    """
    shape = areas[0] if len(areas) == 1 else shapely.union_all(areas)
    return shapely.buffer(shape, seam_m / 2, join_style="mitre") if seam_m > 0 and len(areas) > 1 else shape


def _line(xy: F64) -> Any:
    return shapely.linestrings(np.repeat(xy, 2, axis=0) if len(xy) == 1 else xy)


_cache: dict[tuple[int, bytes, Preset], tuple[weakref.ref[LaneMap], Road]] = {}
_CACHED_ROADS = 8


def road_of(lane_map: LaneMap, origin: F64, preset: Preset) -> Road:
    """Return the prepared road of a map; the last few are kept, as rollouts of one scene come in a row."""
    key = (id(lane_map), origin.tobytes(), preset)
    held = _cache.get(key)
    # An id can be reused after its object is gone; the weak reference shows that.
    if held is not None and held[0]() is lane_map:
        return held[1]
    while len(_cache) >= _CACHED_ROADS:
        del _cache[next(iter(_cache))]
    road = Road(lane_map, origin, preset)
    _cache[key] = (weakref.ref(lane_map), road)
    return road
