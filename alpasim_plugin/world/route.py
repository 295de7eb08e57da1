"""Spatial queries on a lane map, and where the ego should go: the recorded path, named by lanes and
carried on past its end.

`LaneIndex` answers which lanes are at a point, where they head and what follows them; routes are
made with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import shapely

from alpasim_plugin.core.geometry import (
    arc_lengths,
    densify,
    heading_of,
    inverse,
    project,
    resample,
    transform_points,
    wrap_angle,
    yaw_from_quat,
    yaw_of,
)
from alpasim_plugin.core.lane_areas import HALF_WIDTH_M, distance_and_rise, lane_polygon
from alpasim_plugin.core.types import F64, I64, LaneMap, Route, Trajectory

VERTEX_STEP_M = 1.0  # the KD-trees hold a centre vertex at least this often
# A lane farther above or below a point than this is another road. A point on a lane's edge may lie
# so much above or below its middle, or the recording so much above the map; decks of car parks are
# 2.5 m apart and more.
LEVEL_M = 2.0


@dataclass(frozen=True)
class LanePath:
    """A drive along successive lanes."""

    lane_ids: tuple[str, ...]
    xyz: F64  # (N, 3) metres, world; N >= 1


class LaneIndex:
    """Index of one `LaneMap`: an STRtree over lane polygons and KD-trees over centre vertices.

    Points are ``(2,)`` or ``(3,)``, metres, world; one with a height lies on the ground. Distances
    are taken in 3-D where the point has a height, and lanes farther than `LEVEL_M` above or below it
    do not count, so that a bridge does not answer for the road below it; in plan view where it has
    none. Answers are in the map's own order of lanes.

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
        self._owner: I64 = np.repeat(np.arange(len(dense)), [len(d) for d in dense]).astype(
            np.int64
        )
        self._kd = (
            {dim: scipy.spatial.KDTree(self._vertices[:, :dim]) for dim in (2, 3)} if dense else {}
        )

    def containing(self, point: F64) -> tuple[str, ...]:
        """Return the lanes at the point's height whose polygon holds it in plan view, its border
        included.
        """
        return self.containing_many(point[None])[0]

    def containing_many(self, points: F64) -> list[tuple[str, ...]]:
        """Return `containing` for each of ``(N, 2)`` or ``(N, 3)`` points at once."""
        places = shapely.points(np.ascontiguousarray(points[:, :2]))
        point, lane = self._tree.query(places, predicate="intersects")
        if points.shape[1] > 2:
            is_level = self._apart_m(point, lane, points) <= LEVEL_M
            point = point[is_level]
            lane = lane[is_level]
        lane_numbers: list[list[int]] = [[] for _ in range(len(points))]
        for i, j in zip(point.tolist(), lane.tolist(), strict=True):
            lane_numbers[i].append(j)
        return [tuple(self.ids[j] for j in sorted(js)) for js in lane_numbers]

    def _apart_m(self, point: I64, lane: I64, points: F64) -> F64:
        """Return how far ``(P,)`` lanes are above or below points in pairs ``(P,)`` of both; of a lane
        that winds above itself the level counts that is nearest.
        """
        out = np.zeros(len(point))
        for number in np.unique(lane).tolist():
            pairs = np.flatnonzero(lane == number)
            xyz = points[point[pairs]]
            line = self.lane_map.lanes[self.ids[number]].centre
            if np.ptp(line[:, 2]) == 0:
                out[pairs] = np.abs(line[0, 2] - xyz[:, 2])
                continue
            _, out[pairs] = distance_and_rise(line, xyz)
        return out

    def within(self, point: F64, radius_m: float) -> tuple[str, ...]:
        """Return the lanes at the point's height that have a centre vertex within ``radius_m``."""
        if not self._kd:
            return ()
        hits = np.asarray(self._kd[len(point)].query_ball_point(point, radius_m), dtype=np.int64)
        if len(point) > 2:
            hits = hits[np.abs(self._vertices[hits, 2] - point[2]) <= LEVEL_M]
        return tuple(self.ids[j] for j in np.unique(self._owner[hits]))

    def heading_rad(self, lane_id: str, point: F64) -> float:
        """Return the driving direction of a lane at the place nearest to the point, in plan
        view.
        """
        step, _, offset = _on_segments(self.lane_map.lanes[lane_id].centre, point[:2])
        i = int(np.argmin(np.sum(offset * offset, axis=1)))
        return float(heading_of(step[i]))

    def successors(self, lane_id: str) -> tuple[str, ...]:
        """Return the lanes that follow; links that leave the map are left out."""
        return tuple(s for s in self.lane_map.lanes[lane_id].successors if s in self.lane_map.lanes)

    def straightest_successor(self, lane_id: str) -> str | None:
        """Return the follower whose own course turns least from this lane's end to its own end, or
        None at a dead end.

        The whole turn over the follower is compared and not its first segment: at an intersection
        all branches leave in the same direction and part only later.
        """
        heading = _end_heading(self.lane_map.lanes[lane_id].centre, last=True)

        def turn(other: str) -> float:
            line = self.lane_map.lanes[other].centre
            start = _end_heading(line, last=False)
            end = _end_heading(line, last=True)
            return float(abs(wrap_angle(start - heading)) + abs(wrap_angle(end - start)))

        followers = self.successors(lane_id)
        return min(followers, key=turn) if followers else None

    def path_ahead(self, lane_id: str, distance_m: float, start: F64 | None = None) -> LanePath:
        """Follow lane centres for a distance, at each fork along the smallest heading change.

        Args:
            lane_id: Where to begin.
            distance_m: Length in plan view; the path is shorter where the map ends.
            start: Point whose projection on the first lane begins the path; None: the lane's first
                point.
        """
        line = self.lane_map.lanes[lane_id].centre
        begin = 0.0 if start is None else project(line, start)[0]
        ids = [lane_id]
        following = line[arc_lengths(line) > begin + 1e-9]
        parts = [np.concatenate([resample(line, [begin]), following])]
        left = distance_m - float(arc_lengths(parts[0])[-1])
        current: str | None = lane_id
        while left > 0:
            current = self.straightest_successor(ids[-1])
            if current is None or (
                current in ids and arc_lengths(self.lane_map.lanes[current].centre)[-1] <= 0
            ):
                break
            ids.append(current)
            parts.append(self.lane_map.lanes[current].centre)
            left -= float(arc_lengths(np.concatenate(parts[-2:])[len(parts[-2]) - 1 :])[-1])
        xyz = np.concatenate(parts)
        s = arc_lengths(xyz)
        keep = np.concatenate([[True], np.diff(s) > 1e-9])
        xyz = xyz[keep]
        s = s[keep]
        if s[-1] > distance_m:
            inside = s < distance_m
            xyz = np.concatenate([xyz[inside], resample(xyz, [distance_m])])
        return LanePath(tuple(ids), xyz)


def _end_heading(line: F64, last: bool) -> float:
    """Return the heading over the first or last metre of a polyline, so that a tiny end segment
    does not decide.
    """
    s = arc_lengths(line)
    span = min(1.0, float(s[-1]))
    a, b = resample(line, [s[-1] - span, s[-1]] if last else [0.0, span])
    return float(heading_of(b - a))


# recorded points closer than this to the last kept one are dropped: a car at rest only adds noise
MIN_STEP_M = 0.2
SAMPLE_M = 1.0  # the recorded path is matched to lanes this often
EXTENSION_M = 120.0  # enough for the 80 m that a policy sees, beyond the end of the log
BLEND_M = 20.0  # the lateral offset at the end of the log fades out over this length
MATCH_RADIUS_M = (
    4.0  # a point outside every lane is matched to lanes with a centre vertex this near
)
MAX_HEADING_ERROR_RAD = np.pi / 3
HEADING_WEIGHT_M = 3.0
# Places of a route that fit the ego's by no more than this worse than the best one are as good, and
# of several passes of a street the first counts.
SAME_PASS_M = 1.0
REACH_M = 5.0  # beside twice what the ego has moved: how far along the route it may have come
LEFT_M = 4.0  # from the route: it is looked for anywhere
FOUND_M = 2.0  # where it is this near


def route_from_log(
    lane_map: LaneMap, ego_log: Trajectory, extension_m: float = EXTENSION_M
) -> Route:
    """Make the route of a recorded drive; see `recorded_route`."""
    return recorded_route(lane_map, ego_log, extension_m)[0]


def recorded_route(lane_map: LaneMap, ego_log: Trajectory, extension_m: float) -> tuple[Route, F64]:
    """Make the route of a recorded drive, and return it with its part behind the drive ``(N, 3)``.

    The polyline is the recorded path itself, thinned to `MIN_STEP_M`, so that following it
    reproduces the human; past its end it goes on along lane centres, at each fork with the smallest
    heading change, and the offset from the centre fades out over `BLEND_M`. Where the log ends
    outside every lane, or the map ends, the route ends too. ``lane_ids`` are the lanes of both
    parts in driving order.
    """
    # Drop points nearer than `MIN_STEP_M` to the last kept one; the last point stays.
    xyz = ego_log.xyz
    kept = [0]
    for i in range(1, len(xyz)):
        if np.linalg.norm(xyz[i, :2] - xyz[kept[-1], :2]) >= MIN_STEP_M:
            kept.append(i)
    if kept[-1] != len(xyz) - 1 and np.linalg.norm(xyz[-1, :2] - xyz[kept[-1], :2]) > 0.05:
        kept.append(len(xyz) - 1)
    driven = xyz[kept]
    index = LaneIndex(lane_map)
    if len(driven) < 2:
        driven = np.concatenate([driven, driven])
        heading = float(yaw_from_quat(ego_log.quat[-1]))
    else:
        heading = _end_heading(driven, last=True)
    ids = match_lanes(index, driven, float(yaw_from_quat(ego_log.quat[0])))
    if not ids or extension_m <= 0:
        return Route(driven, ids), driven[:0]
    end = driven[-1]
    ahead = index.path_ahead(ids[-1], extension_m, start=end)
    if (
        len(ahead.xyz) < 2
        or abs(float(wrap_angle(index.heading_rad(ids[-1], end) - heading))) > MAX_HEADING_ERROR_RAD
    ):
        return Route(driven, ids), driven[:0]
    fade = np.clip(1 - arc_lengths(ahead.xyz) / BLEND_M, 0.0, 1.0)
    fade = fade * fade * (3 - 2 * fade)  # smooth at both ends
    tail = ahead.xyz + fade[:, None] * (end - ahead.xyz[0])
    if np.linalg.norm(driven[0] - driven[-1]) == 0 and len(driven) == 2:
        driven = driven[:1]
    route = Route(np.concatenate([driven, tail[1:]]), ids + ahead.lane_ids[1:])
    return route, tail[1:]


def match_lanes(index: LaneIndex, path: F64, first_heading_rad: float) -> tuple[str, ...]:
    """Name the lanes along a path ``(N, 3)`` in driving order, consistently over places where lanes
    overlap.

    Lanes overlap in intersections, so single points are ambiguous. A shortest path over all samples
    (Viterbi) weighs how far each sample is from a lane's centre and heading against how plausible
    the change of lane is: staying is free, a successor nearly, a neighbour costs more, a jump most.
    Samples in no lane's reach name no lane.
    """
    total = float(arc_lengths(path)[-1])
    stations = np.linspace(0.0, total, max(int(np.ceil(total / SAMPLE_M)), 1) + 1)
    points = path[:1]
    headings = np.array([first_heading_rad])
    if total > 0:
        points = resample(path, stations)
        behind = resample(path, np.maximum(stations - SAMPLE_M / 2, 0.0))
        ahead = resample(path, np.minimum(stations + SAMPLE_M / 2, total)) - behind
        headings = heading_of(ahead)
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


def _local_costs(
    index: LaneIndex, point: F64, heading_rad: float, inside: tuple[str, ...]
) -> dict[str, float]:
    """Return the cost of each lane that a sample may be in: offset from the centre in metres plus
    heading error.
    """
    candidates = inside or index.within(point, MATCH_RADIUS_M)
    costs = {}
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


def route_in_rig(
    route: Route,
    T_world_rig: F64,
    n: int = 20,
    spacing_m: float = 80 / 19,
    about_m: float | None = None,
) -> F64:
    """Return the route ahead ``(n, 3)`` in the rig frame, z = 0, with NaN rows after the route's
    end.

    The first point is the ego's projection on the route. Where the route passes the same place
    twice, the pass that runs in the ego's direction counts: one radian of heading error weighs as
    much as `HEADING_WEIGHT_M` of distance. Of passes in the same direction it is the first, or the
    one within `REACH_M` of ``about_m``; `RouteAhead` follows a drive from pass to pass.

    Args:
        route: Where to go.
        T_world_rig: ``(4, 4)`` where the ego is.
        n: Number of points.
        spacing_m: Between points, along the route.
        about_m: Arc length near which the ego is; None: not known.
    """
    if len(route.xyz) < 2:
        return np.full((n, 3), np.nan)
    places = _PlacesOnRoute.near(route.xyz, T_world_rig)
    if about_m is None:
        begin_m, _ = places.first_pass()
    else:
        begin_m, _ = places.within(about_m - REACH_M, about_m + REACH_M)
    return _sampled(places, T_world_rig, begin_m, n, spacing_m)


class RouteAhead:
    """The route ahead of an ego that drives along it. Where it is along the route is state, so that
    a street that the route passes twice is left each time as the route leaves it.

    Args:
        route: Where to go. At the first place the ego is on the route's first pass of it.
    """

    def __init__(self, route: Route) -> None:
        self._route = route
        self._last: tuple[float, F64] | None = None

    def follow(self, T_world_rig: F64) -> float:
        """Move along the route with the ego, as far as it can have come since the last call, and
        return the arc length where it is. Where the ego has left the route and meets it again, the
        nearest place of the whole route counts. A route of fewer than two points has the place 0.
        """
        return self._moved_to(T_world_rig)[1] if len(self._route.xyz) >= 2 else 0.0

    def in_rig(self, T_world_rig: F64, n: int = 20, spacing_m: float = 80 / 19) -> F64:
        """Follow the ego and return the route ahead of it; see `route_in_rig`."""
        if len(self._route.xyz) < 2:
            return np.full((n, 3), np.nan)
        places, begin_m = self._moved_to(T_world_rig)
        return _sampled(places, T_world_rig, begin_m, n, spacing_m)

    def _moved_to(self, T_world_rig: F64) -> tuple[_PlacesOnRoute, float]:
        xy = T_world_rig[:2, 3]
        places = _PlacesOnRoute.near(self._route.xyz, T_world_rig)
        if self._last is None:
            begin_m, _ = places.first_pass()
        else:
            last_m, last_xy = self._last
            reach_m = REACH_M + 2.0 * float(np.hypot(*(xy - last_xy)))
            begin_m, away_m = places.within(last_m - reach_m, last_m + reach_m)
            if away_m > LEFT_M:
                anywhere_m, distance_m = places.first_pass()
                begin_m = anywhere_m if distance_m <= FOUND_M else begin_m
        self._last = begin_m, np.array(xy)
        return places, begin_m


@dataclass(frozen=True)
class _PlacesOnRoute:
    """The place of each segment of a route that is nearest to the ego.

    Attributes:
        line: ``(S + 1, 3)`` the route.
        along_m: ``(S + 1,)`` arc lengths of its vertices.
        s_m: ``(S,)`` arc length of each place.
        distance_m: ``(S,)`` from the ego.
        cost_m: ``(S,)`` the distance, and what the ego's heading differs from the segment's.
    """

    line: F64
    along_m: F64
    s_m: F64
    distance_m: F64
    cost_m: F64

    @classmethod
    def near(cls, line: F64, T_world_rig: F64) -> _PlacesOnRoute:
        """Project the ego on each segment of a line ``(S + 1, 3)``."""
        along_m = arc_lengths(line)
        step, share, offset = _on_segments(line, T_world_rig[:2, 3])
        distance_m = np.linalg.norm(offset, axis=1)
        error_rad = np.abs(wrap_angle(heading_of(step) - yaw_of(T_world_rig)))
        s_m = along_m[:-1] + share * np.sqrt(np.maximum(np.sum(step * step, axis=1), 1e-300))
        return cls(line, along_m, s_m, distance_m, distance_m + HEADING_WEIGHT_M * error_rad)

    def first_pass(self) -> tuple[float, float]:
        """Return arc length and distance of the best place on the first pass that is nearly as good
        as the best of the whole route.
        """
        is_near = self.cost_m <= self.cost_m.min() + SAME_PASS_M
        first = int(np.argmax(is_near))
        others = np.flatnonzero(~is_near[first:])
        end = first + int(others[0]) if len(others) else len(is_near)
        return self._at(first + int(np.argmin(self.cost_m[first:end])))

    def within(self, low_m: float, high_m: float) -> tuple[float, float]:
        """Return arc length and distance of the best place between two arc lengths."""
        inside = (self.along_m[1:] >= low_m) & (self.along_m[:-1] <= high_m)
        return self._at(int(np.argmin(np.where(inside, self.cost_m, np.inf))))

    def _at(self, segment: int) -> tuple[float, float]:
        return float(self.s_m[segment]), float(self.distance_m[segment])


def _sampled(
    places: _PlacesOnRoute, T_world_rig: F64, begin_m: float, n: int, spacing_m: float
) -> F64:
    """Return points ``(n, 3)`` of a route from an arc length on, in the rig frame; see
    `route_in_rig`.
    """
    out = np.full((n, 3), np.nan)
    stations = begin_m + spacing_m * np.arange(n)
    on_route = stations <= places.along_m[-1] + 1e-9
    points = resample(places.line, stations[on_route], places.along_m)
    out[on_route] = transform_points(inverse(T_world_rig), points)
    out[on_route, 2] = 0.0
    return out


def from_offset(route_rig: F64, offset_m: float) -> F64:
    """Return a route ``(n, 3)`` without its points nearer than ``offset_m``, as many rows of NaN
    behind the others.

    Distances are summed along the points, as AlpaSim sums them for ``route_start_offset_m``
    (`alpasim_runtime/route_generator.py`, branch ``e2e_challenge``, commit 9177bd0).
    """
    if offset_m <= 0.0:
        return route_rig
    points = route_rig[np.isfinite(route_rig).all(axis=1)]
    ahead = points[arc_lengths(points) >= offset_m] if len(points) else points
    out = np.full_like(route_rig, np.nan)
    out[: len(ahead)] = ahead
    return out


def _on_segments(line: F64, xy: F64) -> tuple[F64, F64, F64]:
    """Return the segments ``(S, 2)`` of a polyline, the share of each at which it is nearest to a
    point, and the offsets there.
    """
    start = line[:-1, :2]
    step = line[1:, :2] - line[:-1, :2]
    length2 = np.maximum(np.sum(step * step, axis=1), 1e-300)
    share = np.minimum(np.maximum(np.sum((xy - start) * step, axis=1) / length2, 0.0), 1.0)
    return step, share, xy - (start + share[:, None] * step)
