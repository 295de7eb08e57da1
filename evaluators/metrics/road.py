"""The road as evaluators see it: lane areas, lane centres and road edges of one map.

Areas and unions are built where a rollout comes, and kept for the next rollout.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy
import shapely

from alpasim_plugin.core.geometry import heading_of
from alpasim_plugin.core.lane_areas import lane_polygon, ring_area
from alpasim_plugin.core.types import F64, I64, Bool, LaneMap
from evaluators.metrics.footprint import Geometries
from evaluators.metrics.presets import Preset
from evaluators.metrics.surface import SLOPE, Region, Surface, segment_distance

LEVEL_RADIUS_M = 30.0  # AlpaSim's later rule looks no further for road edges


@dataclass(frozen=True)
class Level:
    """What is on the level of a vehicle: no farther above or below the ground under it than
    ``height_m``, and `evaluators.metrics.surface.SLOPE` for each metre of distance. The ground is
    ``below_m`` below the middle of its box.
    """

    height_m: float
    below_m: float


class Polylines:
    """Segments and vertices of many polylines in 3-D, indexed in plan view."""

    def __init__(self, lines: Sequence[F64], origin: F64) -> None:
        """Take polylines ``(N, 3)``; they are held relative to an origin ``(3,)``."""
        self.n_lines = len(lines)
        lines = [np.repeat(line, 2, axis=0) if len(line) == 1 else line for line in lines]
        self.vertices = np.concatenate([np.zeros((0, 3)), *lines]) - origin
        self.vertex_owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
        follows = np.flatnonzero(self.vertex_owner[1:] == self.vertex_owner[:-1])
        self.start = self.vertices[follows]
        self.end = self.vertices[follows + 1]
        self.owner = self.vertex_owner[follows]

    @cached_property
    def _segments(self) -> Geometries:
        return shapely.linestrings(np.stack([self.start[:, :2], self.end[:, :2]], axis=1))

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(self._segments)

    def line_within(self, xyz: F64, radius_m: float, level: Level | None = None) -> Bool:
        """Return which lines ``(T, L)`` come within a radius of points ``(T, 3)``, in 3-D; with a
        level only by their parts on it.
        """
        out = np.zeros((len(xyz), self.n_lines), dtype=np.bool_)
        point, segment = self._tree.query(
            shapely.points(xyz[:, :2]), predicate="dwithin", distance=radius_m + 1e-6
        )
        near = segment_distance(self.start[segment], self.end[segment], xyz[point]) <= radius_m
        if level is not None:
            near &= self._on_level(segment, xyz[point], level)
        out[point[near], self.owner[segment[near]]] = True
        return out

    def _on_level(self, segment: I64, xyz: F64, level: Level) -> Bool:
        """Return which segments ``(M,)`` are on the level of points ``(M, 3)`` where they are nearest
        in plan view.
        """
        along = self.end[segment] - self.start[segment]
        offset = xyz - self.start[segment]
        length2 = np.maximum(np.sum(along[:, :2] ** 2, axis=1), 1e-12)
        share = np.clip(np.sum(along[:, :2] * offset[:, :2], axis=1) / length2, 0.0, 1.0)
        rise_m = np.abs(share * along[:, 2] - offset[:, 2] + level.below_m)
        away_m = np.hypot(*(share[:, None] * along[:, :2] - offset[:, :2]).T)
        return rise_m <= level.height_m + SLOPE * away_m

    def vertex_within(self, xyz: F64, radius_m: float) -> Bool:
        """Return which lines ``(T, L)`` own a vertex within a radius of points ``(T, 3)``, in
        3-D.
        """
        out = np.zeros((len(xyz), self.n_lines), dtype=np.bool_)
        if len(self.vertices):
            near = scipy.spatial.cKDTree(self.vertices).query_ball_point(xyz, radius_m)
            for i, vertices in enumerate(near):
                out[i, self.vertex_owner[vertices]] = True
        return out

    def nearest_vertex_owner(self, xyz: F64) -> I64:
        """Return the line ``(T,)`` that owns the vertex nearest to each point ``(T, 3)``, in
        3-D.
        """
        return self.vertex_owner[scipy.spatial.cKDTree(self.vertices).query(xyz)[1]]

    def nearest_of_level(self, xyz: F64, height_m: float) -> I64:
        """Return the nearest line ``(T,)`` at the height of each point ``(T, 3)``, -1 where there
        is none.

        Each line with a vertex within `LEVEL_RADIUS_M` in 3-D is placed by its vertex nearest in
        plan view: that one must lie within ``height_m`` of the point's height, and the line whose
        such vertex is nearest in 3-D is taken.
        """
        out = np.full(len(xyz), -1, dtype=np.int64)
        start = np.concatenate(
            [[0], np.flatnonzero(np.diff(self.vertex_owner)) + 1, [len(self.vertices)]]
        )
        for i, near in enumerate(self.vertex_within(xyz, LEVEL_RADIUS_M)):
            best_m = np.inf
            for line in np.flatnonzero(near):
                vertices = self.vertices[start[line] : start[line + 1]]
                beside = vertices[np.argmin(np.hypot(*(vertices[:, :2] - xyz[i, :2]).T))]
                away_m = float(np.linalg.norm(beside - xyz[i]))
                if abs(beside[2] - xyz[i, 2]) <= height_m and away_m < best_m:
                    out[i], best_m = line, away_m
        return out

    def touched(self, footprints: Geometries, z: F64, limit_m: float, height_m: float) -> Bool:
        """Return whether each footprint is nearer than a limit to a segment whose middle is at most
        ``height_m`` above or below it.
        """
        out = np.zeros(len(footprints), dtype=np.bool_)
        body, segment = self._tree.query(footprints, predicate="dwithin", distance=limit_m)
        middle = (self.start[segment, 2] + self.end[segment, 2]) / 2
        level = np.abs(middle - z[body]) <= height_m
        body = body[level]
        segment = segment[level]
        out[body[shapely.distance(self._segments[segment], footprints[body]) < limit_m]] = True
        return out


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
        self._unions: dict[bytes, Any] = {}
        self._rings = lane_map.drivable_areas

    def areas(self, lane: I64) -> Geometries:
        """Return the prepared areas ``(M,)`` of lanes ``(M,)``; a drive comes near few lanes of a
        map, so they are built when asked for.
        """
        is_needed = np.zeros(len(self._lanes), dtype=np.bool_)
        is_needed[lane] = True
        new = [k for k in np.flatnonzero(is_needed).tolist() if self._areas[k] is None]
        if new:
            for k in new:
                self._areas[k] = lane_polygon(
                    self._lanes[k],
                    self._preset.lane_half_width_m,
                    self._preset.alpasim_map,
                    self.origin,
                )
            shapely.prepare(self._areas[new])
        return self._areas[lane]

    @cached_property
    def is_for_cars(self) -> Bool:
        """Which lanes ``(L,)`` are for cars: no shoulder, parking strip, bicycle or bus lane."""
        return np.array([lane.kind == "vehicle" for lane in self._lanes], dtype=np.bool_)

    @cached_property
    def edges(self) -> Geometries:
        """Road edges in plan view, ``(E,)``."""
        return _lines(self._edges, self.origin)

    @cached_property
    def centre_lines(self) -> Geometries:
        """Middles of the lanes in plan view, ``(L,)``."""
        return _lines([lane.centre for lane in self._lanes], self.origin)

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
        level_m = self._preset.lane_height_m or self._preset.edge_height_m
        return Surface(areas, outlines, self._preset.seam_m, level_m)

    def lanes_near(self, xyz: F64, below_m: float) -> Bool:
        """Return which lanes ``(T, L)`` pass near box centres ``(T, 3)``, by the preset's radius and
        query, in 3-D whatever their direction; the ground is so far below the centres.
        """
        if self._preset.lane_query == "vertices":
            return self._centre.vertex_within(xyz, self._preset.lane_radius_m)
        height_m = self._preset.lane_height_m
        level = None if height_m is None else Level(height_m, below_m)
        return self._centre.line_within(xyz, self._preset.lane_radius_m, level)

    def union(self, lanes: Bool) -> Any:
        """Return the prepared union of the lanes marked in ``(L,)``; kept, as unions are costly and
        recur along a drive.
        """
        key = np.packbits(lanes).tobytes()
        if key not in self._unions:
            shape = join(self.areas(np.flatnonzero(lanes)), self._preset.seam_m)
            shapely.prepare(shape)
            self._unions[key] = shape
        return self._unions[key]

    def connected(self, lane: int) -> Region:
        """Return a lane with those that lead into it and that it leads to; a seam between them is
        no border.
        """
        lane_data = self._lanes[lane]
        chosen = np.zeros(self.surface.n_areas, dtype=np.bool_)
        for k, other in enumerate(self._lanes):
            chosen[k] = (
                lane_data.lane_id in other.successors or other.lane_id in lane_data.successors
            )
        chosen[lane] = True
        return self.surface.region(chosen)

    def touches_edge(self, footprints: Geometries, xyz: F64) -> Bool:
        """Return whether footprints ``(T,)`` with box centres ``(T, 3)`` lie nearer than the
        preset's threshold to the road edge.

        ``edge_query`` "any": to any edge at the ego's height. "nearest_vertex": to the edge that
        owns the vertex nearest to the centre. "nearest_of_level": to the one of
        `_Polylines.nearest_of_level`.
        """
        limit_m = self._preset.edge_touch_m
        if self._preset.edge_query == "nearest_of_level":
            owner = self._edge.nearest_of_level(xyz, self._preset.edge_height_m)
            return (owner >= 0) & (shapely.distance(self.edges[owner], footprints) < limit_m)
        if self._preset.edge_query == "nearest_vertex":
            return (
                shapely.distance(self.edges[self._edge.nearest_vertex_owner(xyz)], footprints)
                < limit_m
            )
        return self._edge.touched(footprints, xyz[:, 2], limit_m, self._preset.edge_height_m)

    def heading_at(self, lane: I64, xy: F64) -> F64:
        """Return the direction of lanes ``(M,)`` beside points ``(M, 2)``: from 1 cm before to 1 cm
        after the centre's nearest point.
        """
        lines = self.centre_lines[lane]
        s = shapely.line_locate_point(lines, shapely.points(xy))
        before = shapely.get_coordinates(
            shapely.line_interpolate_point(lines, np.maximum(s - 0.01, 0.0))
        )
        after = shapely.get_coordinates(shapely.line_interpolate_point(lines, s + 0.01))
        delta = after - before
        return heading_of(delta)


def join(areas: Geometries, seam_m: float) -> Any:
    """Return the union of lane areas with gaps up to ``seam_m`` wide closed.

    Lanes that share an edge, but not its vertices, differ there by rounding. Without closing,
    rounding would decide whether a footprint across the edge is contained, and differently at every
    origin.
    """
    shape = areas[0] if len(areas) == 1 else shapely.union_all(areas)
    return (
        shapely.buffer(shape, seam_m / 2, join_style="mitre")
        if seam_m > 0 and len(areas) > 1
        else shape
    )


def _lines(lines: Sequence[F64], origin: F64) -> Geometries:
    """Return lines ``(N, 3)`` in plan view, relative to an origin; one of a single point is a line
    without length.
    """
    flat = [line[:, :2] - origin[:2] for line in lines]
    shapes = [shapely.linestrings(np.repeat(xy, 2, axis=0) if len(xy) == 1 else xy) for xy in flat]
    return np.array(shapes, dtype=object)


_ROADS: deque[tuple[LaneMap, bytes, Preset, Road]] = deque(maxlen=8)


def road_of(lane_map: LaneMap, origin: F64, preset: Preset) -> Road:
    """Return the prepared road of a map; the last few are kept, as rollouts of one scene come in a
    row.
    """
    for known_map, known_origin, known_preset, road in _ROADS:
        if known_map is lane_map and known_origin == origin.tobytes() and known_preset == preset:
            return road
    road = Road(lane_map, origin, preset)
    _ROADS.append((lane_map, origin.tobytes(), preset, road))
    return road
