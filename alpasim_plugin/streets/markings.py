"""Lane markings as short strokes, from lane edges, marking lines, crosswalks and stop lines.

Which lines are lane markings is the rule of `world.markings`.
"""

from typing import NamedTuple

import cv2
import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, direction_of, left_of, resample, unit
from alpasim_plugin.core.types import F64, I64, LaneMarkType
from alpasim_plugin.streets.site import CELL_M, Site
from alpasim_plugin.world.markings import marking_lines

# Dash pattern
LINE_M = 3.0
GAP_M = 9.0
LINE_WIDTH_M = 0.14
DOUBLE_OFFSET_M = 0.16
STEP_M = 0.75  # length of a stroke of a line; a quarter of a dash
BAR_M = 0.45  # zebra bar and the gap beside it
STOP_LINE_M = 0.4
JOINED_M = 0.7  # a line that begins this near to the end of another goes on with its dashes
WHITE = 0
YELLOW = 1


class Strokes(NamedTuple):
    """Straight pieces of lane markings in ground coordinates."""

    start: F64  # (M, 2) metres
    end: F64  # (M, 2)
    width_m: F64  # (M,)
    colour: I64  # (M,) WHITE or YELLOW


def marking_strokes(site: Site) -> Strokes:
    """Return all lane markings near the site's path."""
    lane_map = site.scenario.lane_map
    high = site.low + np.array(site.road.shape[::-1]) * CELL_M
    edges = [(site.frame.to_ground(line), mark_type) for line, mark_type in marking_lines(lane_map)]
    lines = [
        edge
        for edge in edges
        if np.all(edge[0].max(axis=0) > site.low) and np.all(edge[0].min(axis=0) < high)
    ]
    pieces = [
        _line_strokes(line, mark_type, phase) for line, mark_type, phase in _with_phase(lines)
    ]
    pieces += [_zebra(site.frame.to_ground(ring)) for ring in lane_map.crosswalks]
    for stop in lane_map.stop_lines:
        line = site.frame.to_ground(stop)
        if len(line) > 1:
            pieces.append(_strokes(line[:-1], line[1:], STOP_LINE_M, WHITE))
    pieces = [piece for piece in pieces if len(piece.start)]
    if not pieces:
        return Strokes(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.int64))
    joined = Strokes(*(np.concatenate(column) for column in zip(*pieces, strict=True)))
    inside = np.all((joined.start > site.low) & (joined.start < high), axis=1)
    return Strokes._make(column[inside] for column in joined)


def _with_phase(lines: list[tuple[F64, LaneMarkType]]) -> list[tuple[F64, LaneMarkType, float]]:
    """Give each line the length of the markings before it, so that dashes run on from lane to lane."""
    if not lines:
        return []
    start = np.array([line[0] for line, _ in lines])
    following: list[list[int]] = [[] for _ in lines]
    has_one_before = [False] * len(lines)
    for i, (line, mark_type) in enumerate(lines):
        distance2 = np.sum((start - line[-1]) ** 2, axis=1)
        for j in np.flatnonzero(distance2 <= JOINED_M**2).tolist():
            if j != i and not has_one_before[j] and lines[j][1] == mark_type:
                following[i].append(j)
                has_one_before[j] = True
    phase = {}
    # Lines that nothing leads to begin; what is left then runs in a circle.
    for first in sorted(range(len(lines)), key=lambda i: has_one_before[i]):
        waiting = [(first, 0.0)]
        while waiting:
            i, begin_m = waiting.pop()
            if i not in phase:
                phase[i] = begin_m
                end_m = begin_m + float(arc_lengths(lines[i][0])[-1])
                waiting += [(j, end_m) for j in following[i]]
    return [(line, mark_type, phase[i]) for i, (line, mark_type) in enumerate(lines)]


def _line_strokes(line: F64, mark_type: LaneMarkType, phase_m: float) -> Strokes:
    colour = YELLOW if "yellow" in mark_type else WHITE
    length = float(arc_lengths(line)[-1])
    if mark_type.startswith("dashed"):
        period = LINE_M + GAP_M
        first = np.floor(phase_m / period)
        dashes = np.arange(first, np.ceil((phase_m + length) / period))[:, None] * period - phase_m
        s0 = (dashes + np.arange(0.0, LINE_M, STEP_M)[None, :]).ravel()
    else:
        s0 = np.arange(0.0, length, STEP_M)
    s1 = np.clip(s0 + STEP_M, 0.0, length)
    s0 = np.clip(s0, 0.0, length)
    keep = s1 - s0 > 0.05
    a = resample(line, s0[keep])
    b = resample(line, s1[keep])
    if mark_type != "double_yellow":
        return _strokes(a, b, LINE_WIDTH_M, colour)
    side = DOUBLE_OFFSET_M * left_of(unit(b - a))
    return _strokes(
        np.concatenate([a + side, a - side]), np.concatenate([b + side, b - side]), 0.11, colour
    )


def _zebra(ring: F64) -> Strokes:
    """Lay bars across the walking direction of a crosswalk, the long axis of its ring."""
    (cx, cy), (w, h), angle = cv2.minAreaRect(ring.astype(np.float32))
    axis = direction_of(np.radians(angle))
    across = left_of(axis)
    if w < h:
        axis, across, w, h = across, axis, h, w
    n = max(1, int((w - 0.3) / (2 * BAR_M)))
    offsets_m = (np.arange(n) - (n - 1) / 2) * 2 * BAR_M
    centre = np.array([cx, cy]) + offsets_m[:, None] * axis
    half = max(0.5 * h - 0.15, 0.3)
    return _strokes(centre - half * across, centre + half * across, BAR_M, WHITE)


def _strokes(start: F64, end: F64, width_m: float, colour: int) -> Strokes:
    n = len(start)
    return Strokes(start, end, np.full(n, width_m), np.full(n, colour))
