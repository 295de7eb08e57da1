"""Road paint as short straight strokes, from lane edges, marking lines, crosswalks and stop lines.

Where a map does not give the paint of a lane's edge, a default rule applies: an edge shared by two lanes of one direction is a dashed
white line, one between opposing lanes a double yellow one, an outer edge a solid white line; inside intersections nothing is painted.
In maps with marking lines of their own, lane edges of unknown paint stay unpainted.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F64, I64, Paint
from alpasim_plugin.gaussians.scene.site import CELL_M, Site, left_of, unit

LINE_M, GAP_M = 3.0, 9.0  # dash pattern
LINE_WIDTH_M = 0.14
DOUBLE_OFFSET_M = 0.16
STEP_M = 0.75  # length of a stroke of a line; a quarter of a dash
BAR_M = 0.45  # zebra bar and the gap beside it
STOP_LINE_M = 0.4
INSET_M = 0.2  # paint on an outer edge lies this far inside the lane
SAME_EDGE_M = 0.45  # edges of two lanes nearer than this are one edge
SAMPLE_M = 2.0
WHITE, YELLOW = 0, 1


class Strokes(NamedTuple):
    """Straight pieces of paint in ground coordinates."""

    start: F64  # (M, 2) metres
    end: F64  # (M, 2)
    width_m: F64  # (M,)
    colour: I64  # (M,) WHITE or YELLOW


@dataclass(frozen=True)
class _Edge:
    """One edge of one lane, ground coordinates, in driving direction."""

    lane_id: str
    side: int  # +1 left, -1 right
    line: F64  # (N, 2)
    paint: Paint
    in_junction: bool


def paint_strokes(site: Site) -> Strokes:
    """Return all paint near the site's path."""
    lane_map = site.scenario.lane_map
    high = site.low + np.array(site.road.shape[::-1]) * CELL_M
    lines = [edge for edge in _painted_edges(site) if np.all(edge[0].max(axis=0) > site.low) and np.all(edge[0].min(axis=0) < high)]
    pieces = [_line_strokes(line, paint, phase) for line, paint, phase in _with_phase(lines)]
    pieces += [_zebra(site.frame.to_ground(ring)) for ring in lane_map.crosswalks]
    for stop in lane_map.stop_lines:
        line = site.frame.to_ground(stop)
        if len(line) > 1:
            pieces.append(_strokes(line[:-1], line[1:], STOP_LINE_M, WHITE))
    pieces = [p for p in pieces if len(p.start)]
    if not pieces:
        return Strokes(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.int64))
    start, end = np.concatenate([p.start for p in pieces]), np.concatenate([p.end for p in pieces])
    width_m, colour = np.concatenate([p.width_m for p in pieces]), np.concatenate([p.colour for p in pieces])
    inside = np.all((start > site.low) & (start < high), axis=1)
    return Strokes(start[inside], end[inside], width_m[inside], colour[inside])


def _painted_edges(site: Site) -> list[tuple[F64, Paint]]:
    """Choose edges and lines so that no place is painted twice."""
    lane_map = site.scenario.lane_map
    edges: list[_Edge] = []
    for marking in lane_map.markings:
        if len(marking.xyz) > 1:
            paint: Paint = "solid_white" if marking.paint == "unknown" else marking.paint
            edges.append(_Edge("", 0, site.frame.to_ground(marking.xyz), paint, False))
    for lane in (lane_map.lanes[k] for k in sorted(lane_map.lanes)):
        for side, line, paint in ((1, lane.left, lane.left_paint), (-1, lane.right, lane.right_paint)):
            if line is not None and len(line) > 1 and lane.kind != "parking":
                edges.append(_Edge(lane.lane_id, side, site.frame.to_ground(line), paint, lane.is_intersection))
    edges = [e for e in edges if arc_lengths(e.line)[-1] > 0.5]
    if not edges:
        return []
    owner, points, headings = _sample(edges)
    near = scipy.spatial.KDTree(points).query_ball_point(points, SAME_EDGE_M)
    samples_of = [np.flatnonzero(owner == i) for i in range(len(edges))]
    accepted = np.zeros(len(edges), dtype=bool)
    chosen: list[tuple[F64, Paint]] = []
    believes_markings = bool(lane_map.markings)
    for i in sorted(range(len(edges)), key=lambda i: (_rank(edges[i].paint), i)):
        edge, mine = edges[i], samples_of[i]
        covered = np.mean([any(accepted[owner[j]] and abs(headings[j] @ headings[k]) > 0.8 for j in near[k]) for k in mine])
        if covered > 0.6:
            continue
        accepted[i] = not (edge.paint == "unknown" and edge.in_junction)
        if edge.paint == "none" or (edge.paint == "unknown" and (edge.in_junction or believes_markings)):
            continue
        if edge.paint != "unknown":
            chosen.append((edge.line, edge.paint))
        else:
            beside = [(edges[owner[j]], float(headings[k] @ headings[j])) for k in mine for j in near[k] if owner[j] != i]
            chosen.append(_guess(edge, beside, len(mine)))
    return chosen


def _rank(paint: Paint) -> int:
    return {"none": 1, "unknown": 2}.get(paint, 0)


def _sample(edges: list[_Edge]) -> tuple[I64, F64, F64]:
    """Return (edge index, point, unit heading) of samples along all edges, their ends left out."""
    owner, points, headings = [], [], []
    for i, edge in enumerate(edges):
        length = arc_lengths(edge.line)[-1]
        n = max(3, int(length / SAMPLE_M))
        s = (np.arange(n) + 0.5) / n * length
        a, b = resample(edge.line, s - 0.1), resample(edge.line, s + 0.1)
        owner.append(np.full(n, i))
        points.append((a + b) / 2)
        headings.append(unit(b - a))
    return np.concatenate(owner), np.concatenate(points), np.concatenate(headings)


def _guess(edge: _Edge, neighbours: list[tuple[_Edge, float]], n: int) -> tuple[F64, Paint]:
    """Choose the paint of an edge with n samples from the edges on it: (edge, cosine of the two headings) per matching sample."""
    shared = sum(other.side == -edge.side and cosine > 0.8 for other, cosine in neighbours)
    opposing = sum(other.side == edge.side and cosine < -0.8 for other, cosine in neighbours)
    if max(shared, opposing) < 0.4 * n:
        d = np.gradient(edge.line, axis=0)
        inward = -left_of(unit(d)) * edge.side
        return edge.line + INSET_M * inward, "solid_white"
    return edge.line, "dashed_white" if shared >= opposing else "double_yellow"


def _with_phase(lines: list[tuple[F64, Paint]]) -> list[tuple[F64, Paint, float]]:
    """Give each line the distance painted before it, so that dashes run on from lane to lane."""
    starts: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, (line, _) in enumerate(lines):
        starts[_key(line[0])].append(i)
    before = [-1] * len(lines)
    for i, (line, paint) in enumerate(lines):
        x, y = _key(line[-1])
        for j in (j for dx in (-1, 0, 1) for dy in (-1, 0, 1) for j in starts.get((x + dx, y + dy), [])):
            if j != i and before[j] < 0 and lines[j][1] == paint and np.linalg.norm(lines[j][0][0] - line[-1]) < 0.7:
                before[j] = i
    phase: dict[int, float] = {}

    def follow(i: int) -> float:
        chain = []
        while i not in phase and i not in chain and before[i] >= 0:
            chain.append(i)
            i = before[i]
        phase.setdefault(i, 0.0)
        for j in reversed(chain):
            if j not in phase:
                phase[j] = phase[before[j]] + float(arc_lengths(lines[before[j]][0])[-1])
        return 0.0

    for i in range(len(lines)):
        follow(i)
    return [(line, paint, phase[i]) for i, (line, paint) in enumerate(lines)]


def _key(point: F64) -> tuple[int, int]:
    return int(np.floor(point[0])), int(np.floor(point[1]))


def _line_strokes(line: F64, paint: Paint, phase_m: float) -> Strokes:
    colour = YELLOW if "yellow" in paint else WHITE
    length = float(arc_lengths(line)[-1])
    if paint.startswith("dashed"):
        period = LINE_M + GAP_M
        first = np.floor(phase_m / period)
        dashes = np.arange(first, np.ceil((phase_m + length) / period))[:, None] * period - phase_m
        s0 = (dashes + np.arange(0.0, LINE_M, STEP_M)[None, :]).ravel()
    else:
        s0 = np.arange(0.0, length, STEP_M)
    s1 = np.clip(s0 + STEP_M, 0.0, length)
    s0 = np.clip(s0, 0.0, length)
    keep = s1 - s0 > 0.05
    a, b = resample(line, s0[keep]), resample(line, s1[keep])
    if paint != "double_yellow":
        return _strokes(a, b, LINE_WIDTH_M, colour)
    side = DOUBLE_OFFSET_M * left_of(unit(b - a))
    return _strokes(np.concatenate([a + side, a - side]), np.concatenate([b + side, b - side]), 0.11, colour)


def _zebra(ring: F64) -> Strokes:
    """Lay bars across the walking direction of a crosswalk, the long axis of its ring."""
    (cx, cy), (w, h), angle = cv2.minAreaRect(ring.astype(np.float32))
    axis = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    across = np.array([-axis[1], axis[0]])
    if w < h:
        axis, across, w, h = across, axis, h, w
    n = max(1, int((w - 0.3) / (2 * BAR_M)))
    at = (np.arange(n) - (n - 1) / 2) * 2 * BAR_M
    centre = np.array([cx, cy]) + at[:, None] * axis
    half = max(0.5 * h - 0.15, 0.3)
    return _strokes(centre - half * across, centre + half * across, BAR_M, WHITE)


def _strokes(start: F64, end: F64, width_m: float, colour: int) -> Strokes:
    n = len(start)
    ends = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    return Strokes(*ends, np.full(n, width_m), np.full(n, colour, dtype=np.int64))
