"""Layers of the semantic map: those of a lane map, and those that a lane map does not hold.

A line is drawn once. Marking lines of the map replace lane edges; without them the painted edges of lanes are drawn, an edge shared by
neighbours once. Edges of unknown paint are drawn as untyped lane boundaries, except inside
intersections, where such edges are virtual; edges known to be unpainted are not drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F64, Actor, Box, LaneMap, Paint
from alpasim_plugin.semantic_map.style import AreaKind, LightState, LineColour, Pattern

POLE_HEIGHT_M = 3.0  # of poles given as one point
SAME_EDGE_M = 0.45  # edges of two lanes nearer than this are one edge
SAMPLE_M = 2.0

_PAINT: Mapping[Paint, tuple[LineColour, tuple[Pattern, ...]]] = {
    "solid_white": ("white", ("solid",)),
    "dashed_white": ("white", ("long_dashed",)),
    "solid_yellow": ("yellow", ("solid",)),
    "dashed_yellow": ("yellow", ("long_dashed",)),
    "double_yellow": ("yellow", ("solid", "solid")),
    "unknown": ("untyped", ("solid",)),
}


@dataclass(frozen=True)
class LaneLine:
    """A lane line: one pattern, or two for a double line, the left one first as seen along the line."""

    xyz: F64  # (N, 3) metres, world
    colour: LineColour = "untyped"
    patterns: tuple[Pattern, ...] = ("solid",)


@dataclass(frozen=True)
class TrafficLight:
    """A traffic light's housing and its state."""

    T_world_box: F64  # (4, 4)
    box: Box
    state: LightState = "unknown"


@dataclass(frozen=True)
class Area:
    """A filled patch of ground; concave outlines stay concave."""

    ring: F64  # (N, 3) metres, world; closed or not
    kind: AreaKind = "road_marking"


@dataclass(frozen=True)
class ActorBox:
    """A road user at one instant."""

    T_world_box: F64  # (4, 4) pose of the box centre
    box: Box
    label: str  # see `style.box_class`


@dataclass(frozen=True)
class MapExtras:
    """Layers that `LaneMap` does not hold. ``lane_lines``, where given, replace those derived from the lane map."""

    lane_lines: tuple[LaneLine, ...] | None = None
    areas: tuple[Area, ...] = ()
    lights: tuple[TrafficLight, ...] = ()


def actor_boxes(poses: Mapping[str, F64], actors: Sequence[Actor]) -> tuple[ActorBox, ...]:
    """Join the poses of a render request with sizes and labels, in the order of the poses.

    Raises:
        InputError: A pose belongs to no actor.
    """
    known = {actor.actor_id: actor for actor in actors}
    missing = [key for key in poses if key not in known]
    if missing:
        raise InputError("drawing the semantic map", f"actor {missing[0]}", "a pose without a box", "give the scenario's actors")
    return tuple(ActorBox(pose, known[key].box, known[key].label) for key, pose in poses.items())


def lane_lines(lane_map: LaneMap) -> tuple[LaneLine, ...]:
    """Return the lane lines of a map, each drawn once."""
    painted: list[tuple[F64, Paint]]
    if lane_map.markings:
        painted = [(m.xyz, m.paint) for m in lane_map.markings if len(m.xyz) > 1 and m.paint != "none"]
    else:
        painted = _edges_once(lane_map)
    return tuple(LaneLine(xyz, *_PAINT[paint]) for xyz, paint in painted)


def _edges_once(lane_map: LaneMap) -> list[tuple[F64, Paint]]:
    """Return lane edges with paint; of edges that run together the one whose paint is known, else the first."""
    edges: list[tuple[F64, Paint, bool]] = []
    for lane in (lane_map.lanes[k] for k in sorted(lane_map.lanes)):
        for line, paint in ((lane.left, lane.left_paint), (lane.right, lane.right_paint)):
            if line is not None and len(line) > 1 and arc_lengths(line)[-1] > 0.1:
                edges.append((line, paint, lane.is_intersection))
    if not edges:
        return []
    points, headings, owner = _samples([line for line, _, _ in edges])
    near = scipy.spatial.KDTree(points).query_ball_point(points, SAME_EDGE_M)
    samples_of = np.split(np.arange(len(owner)), np.flatnonzero(np.diff(owner)) + 1)
    taken = np.zeros(len(edges), dtype=bool)
    chosen: list[tuple[F64, Paint]] = []
    for i in sorted(range(len(edges)), key=lambda i: (edges[i][1] == "unknown", i)):
        line, paint, in_junction = edges[i]
        covered = sum(any(taken[owner[j]] and abs(headings[j] @ headings[k]) > 0.8 for j in near[k]) for k in samples_of[i])
        virtual = paint == "unknown" and in_junction
        if covered > 0.6 * len(samples_of[i]) or virtual:
            continue
        taken[i] = True
        if paint != "none":
            chosen.append((line, paint))
    return chosen


def _samples(lines: Sequence[F64]) -> tuple[F64, F64, F64]:
    """Return points ``(M, 2)``, unit directions ``(M, 2)`` and owners ``(M,)`` of samples along lines."""
    points, headings, owner = [], [], []
    for i, line in enumerate(lines):
        length = float(arc_lengths(line)[-1])
        s = np.linspace(0.0, length, max(2, int(np.ceil(length / SAMPLE_M)) + 1))
        at = resample(line[:, :2], s)
        direction = np.gradient(at, axis=0)
        points.append(at)
        headings.append(direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-12)[:, None])
        owner.append(np.full(len(s), i))
    return np.concatenate(points), np.concatenate(headings), np.concatenate(owner)
