"""An OpenDRIVE map as AlpaSim's own loader reads it, so that its road metrics can be reproduced.

Facts from AlpaSim's copy of trajdata (Apache-2.0, ``dataset_specific/xodr``). Where it departs from OpenDRIVE:

- Only lines and arcs are sampled; other records are passed over, and elevations after them slip by their length.
- Records are sampled at ``max(2, ceil(length / 0.5))`` stations, both ends included; widths and lane offsets are read at multiples of
  0.5 m by station number, which drifts from the true arc length with every record.
- A lane exists along the whole road with the widths of all sections together; a sidewalk is none, every other type is one.
- Road edges are the outer borders of the outermost lanes on each side, sidewalks included. A road outside junctions without lanes on a
  side gets an edge 1 cm beside its reference line there, at height 0. Edges that come within 0.2 m of a coarsened lane centre are dropped,
  and of two edges with nearly the same middle the shorter one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import shapely

from alpasim_plugin.core.geometry import transform_points
from alpasim_plugin.core.types import F64, Lane, LaneMap
from scenarios.map_lines import with_vertices
from scenarios.opendrive_road import MAX_ROAD_M, Cubic, OdrMap, Road, beside, cubics_at

STEP_M = 0.5
CROSSING_M = 0.2  # an edge nearer than this to a lane centre crosses it
LANE_STRIDE, SAME_MIDDLE_M, PARALLEL_RAD = 3, 2.0, math.radians(11.0)
LONE_EDGE_M = 0.01


def alpasim_map(odr: OdrMap, T_local_map: F64) -> LaneMap:
    """Return lanes and road edges in the local frame; empty where no road has a line or an arc."""
    lanes: dict[str, tuple[F64, F64, F64]] = {}
    edges: dict[str, F64] = {}
    for road in odr.roads:
        _add_road(road, lanes, edges)
    kept = _without_duplicates(_without_crossing(edges, lanes))

    def local(line: F64) -> F64:
        moved = transform_points(T_local_map, line)
        # A width that is read far beyond its section can be very large; AlpaSim would then fill the memory with vertices.
        return with_vertices(moved) if np.abs(moved - moved[0]).max() <= MAX_ROAD_M else moved

    return LaneMap(
        {key: Lane(key, local(centre), local(left), local(right)) for key, (centre, left, right) in lanes.items()},
        tuple(local(edge) for edge in kept.values()),
    )


def _add_road(road: Road, lanes: dict[str, tuple[F64, F64, F64]], edges: dict[str, F64]) -> None:
    line = _stations(road)
    if not len(line) or not road.sections:
        return
    s = np.asarray(STEP_M * np.arange(len(line)), dtype=np.float64)
    line[:, :2] = beside(line[:, :3], cubics_at(road.lane_offset, s))
    z = line[:, 3]
    by_id: dict[int, list[Cubic]] = {}
    kinds: dict[int, str] = {}
    for section in road.sections:
        for lane in (*section.side(1), *section.side(-1)):
            kinds.setdefault(lane.lane_id, lane.kind.lower())
            if lane.widths:
                by_id.setdefault(lane.lane_id, []).extend(lane.widths)
    for sign, name in ((1, "L"), (-1, "R")):
        inner = line[:, :2]
        for lane_id in sorted((i for i in by_id if i * sign > 0), key=abs):
            width = cubics_at(sorted(by_id[lane_id], key=lambda one: one.s_m), s)
            at = np.column_stack([inner, line[:, 2]])
            rows = [np.column_stack([xy, z]) for xy in (beside(at, sign * width / 2), inner, beside(at, sign * width))]
            centre, left, right = (row[::-1] for row in rows) if sign > 0 else rows
            if kinds[lane_id] != "sidewalk":
                lanes[f"{road.road_id}_{lane_id}"] = (centre, left, right)
            inner = rows[2][:, :2]
            edges[f"{road.road_id}_{name}"] = rows[2]
    if by_id and road.junction == "-1":
        for sign, name in ((1, "L"), (-1, "R")):
            lone = np.column_stack([beside(line[:, :3], np.full(len(line), sign * LONE_EDGE_M)), np.zeros(len(line))])
            edges.setdefault(f"{road.road_id}_{name}", lone)


def _stations(road: Road) -> F64:
    """Return ``(N, 4)`` x, y, heading, z at the loader's stations; where records meet, the point stands twice."""
    rows, passed_m = [], 0.0
    for record in road.records:
        if record.kind not in ("line", "arc"):
            continue
        s = np.linspace(0.0, record.length_m, max(2, math.ceil(record.length_m / STEP_M)), dtype=np.float64)
        rows.append(np.column_stack([record.at(s), cubics_at(road.elevation, passed_m + s)]))
        passed_m += record.length_m
    return np.concatenate(rows) if rows else np.zeros((0, 4))


def _without_crossing(edges: Mapping[str, F64], lanes: Mapping[str, tuple[F64, F64, F64]]) -> dict[str, F64]:
    coarse = [centre[::LANE_STRIDE, :2] for centre, _, _ in lanes.values()]
    pairs = [np.stack([line[:-1], line[1:]], axis=1) for line in coarse if len(line) > 1]
    if not pairs:
        return dict(edges)
    segments = shapely.linestrings(np.concatenate(pairs))
    tree = shapely.STRtree(segments)
    out = {}
    for key, edge in edges.items():
        line = shapely.linestrings(edge[:, :2])
        near = segments[tree.query(line, predicate="dwithin", distance=CROSSING_M)]
        low_x, low_y, high_x, high_y = shapely.bounds(line)
        box = shapely.bounds(near).reshape(-1, 4)
        # The loader queries its tree by bounding box only, and takes a segment with the edge's own box for a parallel one.
        looked_at = (box[:, 0] <= high_x) & (box[:, 2] >= low_x) & (box[:, 1] <= high_y) & (box[:, 3] >= low_y)
        looked_at &= ~np.all(box == (low_x, low_y, high_x, high_y), axis=1)
        if not np.any(shapely.distance(line, near[looked_at]) < CROSSING_M):
            out[key] = edge
    return out


def _without_duplicates(edges: Mapping[str, F64]) -> dict[str, F64]:
    """Drop of two edges whose middles are within 2 m the shorter one, if they are within 11 degrees or their middles within 1 m."""
    keys = list(edges)
    lines = np.array([shapely.linestrings(edges[k][:, :2]) for k in keys], dtype=object)
    length = shapely.length(lines)
    middle = shapely.get_coordinates(shapely.centroid(lines))
    chord = np.array([edges[k][-1, :2] - edges[k][0, :2] for k in keys]).reshape(-1, 2)
    bearing = np.arctan2(chord[:, 1], chord[:, 0])
    gone: set[int] = set()
    for a in range(len(keys)):
        if a in gone or length[a] < STEP_M:
            continue
        apart = np.hypot(*(middle[a + 1 :] - middle[a]).T)
        for b in a + 1 + np.flatnonzero(apart <= SAME_MIDDLE_M):
            if b in gone or length[b] < STEP_M:
                continue
            turn = abs((bearing[a] - bearing[b] + math.pi) % (2 * math.pi) - math.pi)
            if turn <= PARALLEL_RAD or apart[b - a - 1] <= SAME_MIDDLE_M / 2:
                gone.add(int(b) if length[a] >= length[b] else a)
    return {k: edges[k] for i, k in enumerate(keys) if i not in gone}
