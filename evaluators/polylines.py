"""Many polylines of a map in 3-D, indexed in plan view."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy
import shapely

from alpasim_plugin.core.types import F64, I64, Bool
from evaluators.footprint import Geometries
from evaluators.ragged import pairs_of, spans
from evaluators.surface import segment_distance

LEVEL_RADIUS_M = 30.0  # AlpaSim's later rule looks no further for road edges
_RUN = 8  # points in a row that are looked up together


class Polylines:
    """Segments and vertices of many polylines in 3-D, indexed in plan view."""

    def __init__(self, lines: Sequence[F64], origin: F64) -> None:
        """Take polylines ``(N, 3)``; they are held relative to an origin ``(3,)``."""
        self.n_lines = len(lines)
        lines = [np.repeat(line, 2, axis=0) if len(line) == 1 else line for line in lines]
        self.vertices = np.concatenate([np.zeros((0, 3)), *lines]) - origin
        self.vertex_owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
        follows = np.flatnonzero(self.vertex_owner[1:] == self.vertex_owner[:-1])
        self.start, self.end = self.vertices[follows], self.vertices[follows + 1]
        self.owner = self.vertex_owner[follows]
        bounds = np.searchsorted(self.owner, np.arange(self.n_lines + 1))
        self._first, self._last = bounds[:-1], bounds[1:]  # segments of each line

    @cached_property
    def _bounds(self) -> tuple[F64, F64]:
        """Least and greatest coordinates ``(L, 3)`` of each line."""
        first = np.searchsorted(self.vertex_owner, np.arange(self.n_lines))
        return np.minimum.reduceat(self.vertices, first), np.maximum.reduceat(self.vertices, first)

    @cached_property
    def _segments(self) -> Geometries:
        return np.asarray(shapely.linestrings(np.stack([self.start[:, :2], self.end[:, :2]], axis=1)))

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(self._segments)

    def line_within(self, xyz: F64, radius_m: float) -> Bool:
        """Return which lines ``(T, L)`` come within a radius of points ``(T, 3)``, in 3-D."""
        out = np.zeros((len(xyz), self.n_lines), dtype=np.bool_)
        # Points in a row are near each other: lines, then segments are sorted out by the bounds of each run, and only then measured. The
        # slack keeps rounding from hiding a segment.
        run = np.arange(0, len(xyz), _RUN)
        low, high = np.minimum.reduceat(xyz, run) - (radius_m + 1e-6), np.maximum.reduceat(xyz, run) + (radius_m + 1e-6)
        least, most = self._bounds
        meet = np.ones((len(run), self.n_lines), dtype=np.bool_)
        for d in (0, 1):
            meet &= (most[:, d] >= low[:, [d]]) & (least[:, d] <= high[:, [d]])
        which, line = pairs_of(meet)
        found, segment = spans(self._first[line], self._last[line])
        which = which[found]
        least, most = np.minimum(self.start, self.end).T, np.maximum(self.start, self.end).T
        for d in (0, 1):
            keep = (most[d][segment] >= low[which, d]) & (least[d][segment] <= high[which, d])
            which, segment = which[keep], segment[keep]
        point = (run[which, None] + np.arange(_RUN)).reshape(-1)
        segment = np.repeat(segment, _RUN)[point < len(xyz)]
        point = point[point < len(xyz)]
        near = segment_distance(self.start[segment], self.end[segment], xyz[point]) <= radius_m
        out[point[near], self.owner[segment[near]]] = True
        return out

    def vertex_within(self, xyz: F64, radius_m: float) -> Bool:
        """Return which lines ``(T, L)`` own a vertex within a radius of points ``(T, 3)``, in 3-D."""
        out = np.zeros((len(xyz), self.n_lines), dtype=np.bool_)
        if len(self.vertices):
            found = scipy.spatial.cKDTree(self.vertices).query_ball_point(xyz, radius_m)
            for i, vertices in enumerate(found):
                out[i, self.vertex_owner[vertices]] = True
        return out

    def nearest_vertex_owner(self, xyz: F64) -> I64:
        """Return the line ``(T,)`` that owns the vertex nearest to each point ``(T, 3)``, in 3-D."""
        return np.asarray(self.vertex_owner[scipy.spatial.cKDTree(self.vertices).query(xyz)[1]])

    def nearest_of_level(self, xyz: F64, height_m: float) -> I64:
        """Return the nearest line ``(T,)`` at the height of each point ``(T, 3)``, -1 where there is none.

        Each line with a vertex within `LEVEL_RADIUS_M` in 3-D is judged by its vertex nearest in plan view: that one must lie within
        ``height_m`` of the point's height, and the line whose such vertex is nearest in 3-D is taken.
        """
        out = np.full(len(xyz), -1, dtype=np.int64)
        start = np.concatenate([[0], np.flatnonzero(np.diff(self.vertex_owner)) + 1, [len(self.vertices)]])
        for i, near in enumerate(self.vertex_within(xyz, LEVEL_RADIUS_M)):
            best_m = np.inf
            for line in np.flatnonzero(near):
                own = self.vertices[start[line] : start[line + 1]]
                beside = own[np.argmin(np.hypot(*(own[:, :2] - xyz[i, :2]).T))]
                away_m = float(np.linalg.norm(beside - xyz[i]))
                if abs(beside[2] - xyz[i, 2]) <= height_m and away_m < best_m:
                    out[i], best_m = line, away_m
        return out

    def touched(self, footprints: Geometries, z: F64, limit_m: float, height_m: float) -> Bool:
        """Return whether each footprint is nearer than a limit to a segment whose middle is at most ``height_m`` above or below it."""
        out = np.zeros(len(footprints), dtype=np.bool_)
        body, segment = self._tree.query(footprints, predicate="dwithin", distance=limit_m)
        middle = (self.start[segment, 2] + self.end[segment, 2]) / 2
        level = np.abs(middle - z[body]) <= height_m
        body, segment = body[level], segment[level]
        out[body[shapely.distance(self._segments[segment], footprints[body]) < limit_m]] = True
        return out
