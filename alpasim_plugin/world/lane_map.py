"""Spatial queries on a lane map: lanes at a point, their headings, their successors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import HALF_WIDTH_M, arc_lengths, densify, lane_polygon, project, resample, wrap_angle
from alpasim_plugin.core.types import F64, I64, LaneMap

VERTEX_STEP_M = 1.0  # the KD-trees hold a centre vertex at least this often


@dataclass(frozen=True)
class LanePath:
    """A drive along successive lanes."""

    lane_ids: tuple[str, ...]
    xyz: F64  # (N, 3) metres, world; N >= 1


class LaneIndex:
    """Index of one `LaneMap`: an STRtree over lane polygons and KD-trees over centre vertices.

    Points are ``(2,)`` or ``(3,)``, metres, world. Distances are taken in 3-D where the point has a height, so that a bridge does not
    answer for the road below it, and in plan view where it has none. Answers are in the map's own order of lanes.

    Example:
        >>> from alpasim_plugin.core.types import Lane
        >>> lane = Lane("a", np.array([[0.0, 0, 0], [10, 0, 0]]), None, None)
        >>> LaneIndex(LaneMap({"a": lane})).containing(np.array([5.0, 1.0]))
        ('a',)
    """

    def __init__(self, lane_map: LaneMap, half_width_m: float = HALF_WIDTH_M) -> None:
        self.lane_map = lane_map
        self.ids = tuple(lane_map.lanes)
        self.polygons = [lane_polygon(lane_map.lanes[i], half_width_m) for i in self.ids]
        self._tree = shapely.STRtree(self.polygons)
        dense = [densify(lane_map.lanes[i].centre, VERTEX_STEP_M) for i in self.ids]
        self._vertices = np.concatenate(dense) if dense else np.zeros((0, 3))
        self._owner: I64 = np.repeat(np.arange(len(dense)), [len(d) for d in dense]).astype(np.int64)
        self._kd = {dim: scipy.spatial.KDTree(self._vertices[:, :dim]) for dim in (2, 3)} if dense else {}

    def containing(self, point: F64) -> tuple[str, ...]:
        """Return the lanes whose polygon holds the point in plan view, its border included."""
        return self.containing_many(np.asarray(point, dtype=np.float64)[None, :2])[0]

    def containing_many(self, xy: F64) -> list[tuple[str, ...]]:
        """Return `containing` for each of ``(N, 2+)`` points at once."""
        points = shapely.points(np.ascontiguousarray(xy[:, :2]))
        which, lane = self._tree.query(points, predicate="intersects")
        found: list[list[int]] = [[] for _ in range(len(xy))]
        for i, j in zip(which.tolist(), lane.tolist(), strict=True):
            found[i].append(j)
        return [tuple(self.ids[j] for j in sorted(js)) for js in found]

    def within(self, point: F64, radius_m: float) -> tuple[str, ...]:
        """Return the lanes that have a centre vertex within ``radius_m``."""
        if not self._kd:
            return ()
        hits = self._kd[len(point)].query_ball_point(np.asarray(point, dtype=np.float64), radius_m)
        return tuple(self.ids[j] for j in np.unique(self._owner[np.asarray(hits, dtype=np.int64)]))

    def nearest(self, point: F64) -> tuple[str, float]:
        """Return the lane owning the nearest centre vertex, and that vertex's distance in metres.

        Raises:
            InputError: The map has no lanes.
        """
        if not self._kd:
            raise InputError("finding the nearest lane", "a lane map", "it has no lanes", "use a map with at least one lane")
        distance, vertex = self._kd[len(point)].query(np.asarray(point, dtype=np.float64))
        return self.ids[int(self._owner[int(vertex)])], float(distance)

    def heading_rad(self, lane_id: str, point: F64) -> float:
        """Return the driving direction of a lane at the place nearest to the point, in plan view."""
        line = self.lane_map.lanes[lane_id].centre
        a, d = line[:-1, :2], np.diff(line[:, :2], axis=0)
        length2 = np.maximum(np.sum(d * d, axis=1), 1e-300)
        f = np.clip(np.sum((np.asarray(point)[:2] - a) * d, axis=1) / length2, 0.0, 1.0)
        offset = np.asarray(point)[:2] - (a + f[:, None] * d)
        i = int(np.argmin(np.sum(offset * offset, axis=1)))
        return float(np.arctan2(d[i, 1], d[i, 0]))

    def successors(self, lane_id: str) -> tuple[str, ...]:
        """Return the lanes that follow; links that leave the map are left out."""
        return tuple(s for s in self.lane_map.lanes[lane_id].successors if s in self.lane_map.lanes)

    def straightest_successor(self, lane_id: str) -> str | None:
        """Return the follower whose own course turns least from this lane's end to its own end, or None at a dead end.

        The whole turn over the follower is compared and not its first segment: at an intersection all branches leave in the same
        direction and part only later.
        """
        here = _end_heading(self.lane_map.lanes[lane_id].centre, last=True)

        def turn(other: str) -> float:
            line = self.lane_map.lanes[other].centre
            start, end = _end_heading(line, last=False), _end_heading(line, last=True)
            return float(abs(wrap_angle(start - here)) + abs(wrap_angle(end - start)))

        followers = self.successors(lane_id)
        return min(followers, key=turn) if followers else None

    def path_ahead(self, lane_id: str, distance_m: float, start: F64 | None = None) -> LanePath:
        """Follow lane centres for a distance, at each fork along the smallest heading change.

        Args:
            lane_id: Where to begin.
            distance_m: Length in plan view; the path is shorter where the map ends.
            start: Point whose projection on the first lane begins the path; None: the lane's first point.
        """
        line = self.lane_map.lanes[lane_id].centre
        begin = 0.0 if start is None else project(line, np.asarray(start, dtype=np.float64))[0]
        ids, parts, left = [lane_id], [_from(line, begin)], distance_m
        left -= float(arc_lengths(parts[0])[-1])
        current: str | None = lane_id
        while left > 0:
            current = self.straightest_successor(ids[-1])
            if current is None or (current in ids and arc_lengths(self.lane_map.lanes[current].centre)[-1] <= 0):
                break
            ids.append(current)
            parts.append(self.lane_map.lanes[current].centre)
            left -= float(arc_lengths(np.concatenate(parts[-2:])[len(parts[-2]) - 1 :])[-1])
        xyz = np.concatenate(parts)
        s = arc_lengths(xyz)
        keep = np.concatenate([[True], np.diff(s) > 1e-9])
        xyz, s = xyz[keep], s[keep]
        if s[-1] > distance_m:
            inside = s < distance_m
            xyz = np.concatenate([xyz[inside], resample(xyz, [distance_m])])
        return LanePath(tuple(ids), xyz)


def _from(line: F64, begin_m: float) -> F64:
    """Return the rest of a polyline from an arc length on."""
    s = arc_lengths(line)
    return np.concatenate([resample(line, [begin_m]), line[s > begin_m + 1e-9]])


def _end_heading(line: F64, last: bool) -> float:
    """Return the heading over the first or last metre of a polyline, so that a tiny end segment does not decide."""
    s = arc_lengths(line)
    span = min(1.0, float(s[-1]))
    a, b = resample(line, [s[-1] - span, s[-1]] if last else [0.0, span])
    return float(np.arctan2(b[1] - a[1], b[0] - a[0]))
