"""The layers of the semantic map, and their conversion to arrays: straight segments with width and
colour, and flat triangles.

Which lines are lane markings is the rule of `world.markings`: marking lines and lane edges of a
known kind, each once; unknown lane markings are not drawn.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import left_of, resample
from alpasim_plugin.core.types import F64, Actor, Bool, Box, LaneMap, LaneMarkType
from alpasim_plugin.fixers.semantic_map.style import (
    COLOURS,
    DASH_M,
    DOUBLE_OFFSET_M,
    GAP_M,
    LINE_PX,
    POLE_PX,
)
from alpasim_plugin.gaussians.cloud import require_rigid
from alpasim_plugin.world.markings import marking_lines

POLE_HEIGHT_M = 3.0  # of poles given as one point
# Depth bias of a crosswalk, so that lines on it stay visible.
CROSSWALK_BIAS_M = -0.4
# Corners of a unit box: bit 2 is +x, bit 1 is +y, bit 0 is +z.
CORNERS = np.array([[(i >> 2 & 1) - 0.5, (i >> 1 & 1) - 0.5, (i & 1) - 0.5] for i in range(8)])
# Wound to the left from outside
FACES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
TRIANGLES = np.concatenate([FACES[:, [0, 1, 2]], FACES[:, [0, 2, 3]]])  # (12, 3)
EDGES = np.array(
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]]
)

Polyline = tuple[str, float, F64]  # colour, width at 1280 px, (N, 3) metres


@dataclass(frozen=True)
class ActorBox:
    """A road user at one instant."""

    T_world_box: F64  # (4, 4) pose of the box centre
    box: Box
    label: str  # see `style.box_class`


def actor_boxes(poses: Mapping[str, F64], actors: Sequence[Actor]) -> tuple[ActorBox, ...]:
    """Join the poses of a render request with sizes and labels, in the order of the poses.

    Raises:
        InputError: A pose belongs to no actor.
    """
    actors_by_id = {actor.actor_id: actor for actor in actors}
    missing = [key for key in poses if key not in actors_by_id]
    if missing:
        raise InputError(
            f"actor {missing[0]}: a pose without a box",
            "give the scenario's actors",
        )
    return tuple(
        ActorBox(pose, actors_by_id[key].box, actors_by_id[key].label)
        for key, pose in poses.items()
    )


@dataclass(frozen=True)
class Segments:
    """Straight pieces of line, relative to the scene's origin."""

    ends: F64  # (S, 2, 3) metres
    style: F64  # (S, 5) width at 1280 px, bias towards the camera in metres, r, g, b


@dataclass(frozen=True)
class Triangles:
    """Flat triangles, relative to the scene's origin."""

    corners: F64  # (T, 3, 3) metres
    # (T,) whether it is the face of a solid, wound to the left from outside, culled where it faces
    # away
    closed: Bool
    shade: F64  # (T, 3) position between front colour (0) and back colour (1) at the corners
    style: F64  # (T, 7) bias towards the camera in metres, front r, g, b, back r, g, b


@dataclass(frozen=True, eq=False)
class PreparedMap:
    """The static part of a scene, ready to be drawn from any camera."""

    origin: F64  # (3,) metres, world
    segments: Segments
    triangles: Triangles


def prepare_map(lane_map: LaneMap) -> PreparedMap:
    """Prepare a scene's map for drawing.

    Args:
        lane_map: Coordinates may be UTM-sized: everything is stored relative to the middle of the
            map.

    Raises:
        InputError: A coordinate that is not finite, an area without three corners, or a pose that
            is not rigid.
    """
    markings = marking_lines(lane_map)
    lines = [("road_boundary", LINE_PX, line) for line in lane_map.road_edges]
    lines += [("stop_line", LINE_PX, line) for line in lane_map.stop_lines]
    lines += [("pole", POLE_PX, _pole(line)) for line in lane_map.poles]
    outlines = [("lane line", line) for line, _ in markings]
    outlines += [(name, line) for name, _, line in lines]
    outlines += [("crosswalk", ring) for ring in lane_map.crosswalks]
    for name, outline in outlines:
        _check_outline(name, outline)
    for pose, box in lane_map.signs:
        _check_sign(pose, box)
    points = [outline for _, outline in outlines] + [
        pose[None, :3, 3] for pose, _ in lane_map.signs
    ]
    everywhere = np.concatenate([np.zeros((0, 3)), *points])
    origin = np.zeros(3)
    if len(everywhere):  # in whole metres, so that subtracting it loses nothing
        origin = np.round((everywhere.min(axis=0) + everywhere.max(axis=0)) / 2)
    pieces = [
        piece for line, mark_type in markings for piece in _marking_pieces(line - origin, mark_type)
    ]
    pieces += [(name, width_px, line - origin) for name, width_px, line in lines]
    rings = [triangulate("crosswalk", ring - origin) for ring in lane_map.crosswalks]
    signs = [
        ((CORNERS * np.array(box.size_m)) @ pose[:3, :3].T + (pose[:3, 3] - origin))[TRIANGLES]
        for pose, box in lane_map.signs
    ]
    return PreparedMap(origin, _segments(pieces), _filled(rings, signs))


def _filled(rings: Sequence[F64], signs: Sequence[F64]) -> Triangles:
    """Return the triangles of crosswalks and of signs with their colours."""
    on_ground = np.concatenate([np.zeros((0, 3, 3)), *rings])
    triangles = np.concatenate([on_ground, *signs])
    style = np.empty((len(triangles), 7))
    style[: len(on_ground)] = (CROSSWALK_BIAS_M, *COLOURS["crosswalk"], *COLOURS["crosswalk"])
    style[len(on_ground) :] = (0.0, *COLOURS["sign"], *COLOURS["sign"])
    is_closed = np.zeros(len(triangles), dtype=bool)
    return Triangles(triangles, is_closed, np.zeros((len(triangles), 3)), style)


def _check_outline(name: str, outline: F64) -> None:
    """Refuse a line or an area whose points are not finite ``(N, 3)``."""
    if outline.ndim != 2 or outline.shape[1] != 3:
        raise InputError(
            f"{name}: an array of shape {outline.shape}", "give points (N, 3), metres, world"
        )
    if not np.isfinite(outline).all():
        bad_point = int(np.flatnonzero(~np.isfinite(outline).all(axis=1))[0])
        raise InputError(
            f"{name}: point {bad_point} is {outline[bad_point].tolist()}",
            "repair or drop this line",
        )


def _check_sign(pose: F64, box: Box) -> None:
    """Refuse a sign whose pose is not rigid or whose size cannot be."""
    require_rigid(pose, "sign")
    if not np.isfinite(box.size_m).all() or min(box.size_m) < 0:
        raise InputError(
            f"sign: a box of {box.size_m} m", "give finite sizes, length, width and height"
        )


def _pole(line: F64) -> F64:
    """Make a vertical line of a pole given as one point."""
    if len(line) == 1:
        return np.concatenate([line, line + np.array([0.0, 0.0, POLE_HEIGHT_M])])
    return line


def _marking_pieces(line: F64, mark_type: LaneMarkType) -> list[Polyline]:
    """Return what is drawn of a lane line: two lines for a double one, the dashes of a dashed one."""
    pattern, _, colour = mark_type.partition("_")
    pieces = [line]
    if len(line) < 2:
        pieces = []
    elif pattern == "double":
        pieces = [_offset_left(line, DOUBLE_OFFSET_M), _offset_left(line, -DOUBLE_OFFSET_M)]
    elif pattern == "dashed":
        pieces = cut_dashes(line, DASH_M, GAP_M)
    return [(f"line_{colour}", LINE_PX, piece) for piece in pieces]


def cut_dashes(line: F64, dash_m: float, gap_m: float) -> list[F64]:
    """Return the dashes of a polyline ``(N, 3)``.

    They start at the first point, are measured along the line in space, and bend with it.
    """
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(s) > 0])
    s = s[keep]
    line = line[keep]
    dashes = []
    for start in np.arange(np.ceil(s[-1] / (dash_m + gap_m))) * (dash_m + gap_m):
        end = min(start + dash_m, s[-1])
        inner = np.concatenate([[start], s[(s > start) & (s < end)], [end]])
        dashes.append(resample(line, inner, s))
    return dashes


def _offset_left(line: F64, left_m: float) -> F64:
    """Offset a polyline to the left in plan view; corners keep the distance up to a miter of 2."""
    step = np.diff(line[:, :2], axis=0)
    length = np.linalg.norm(step, axis=1)
    keep = length > 1e-9
    if not keep.any():
        return line
    line = line[np.concatenate([[True], keep])]
    direction = step[keep] / length[keep, None]
    normal = left_of(direction)
    miter = np.concatenate([normal[:1], normal[:-1] + normal[1:], normal[-1:]])
    miter /= np.maximum(np.linalg.norm(miter, axis=1), 1e-9)[:, None]
    cosine = np.maximum(
        np.concatenate([[1.0], np.sum(miter[1:-1] * normal[1:], axis=1), [1.0]]), 0.5
    )
    out = line.copy()
    out[:, :2] += miter * (left_m / cosine)[:, None]
    return out


def _segments(lines: Sequence[Polyline]) -> Segments:
    ends = [np.zeros((0, 2, 3))]
    style = [np.zeros((0, 5))]
    for colour, width_px, line in lines:
        if len(line) > 1:
            ends.append(np.stack([line[:-1], line[1:]], axis=1))
            style.append(np.tile((width_px, 0.0, *COLOURS[colour]), (len(line) - 1, 1)))
    return Segments(np.concatenate(ends), np.concatenate(style))


def triangulate(name: str, ring: F64) -> F64:
    """Return the triangles ``(T, 3, 3)`` that fill a ring ``(N, 3)`` in plan view; concave outlines
    stay concave.

    The triangulation is the constrained Delaunay one. Of a ring that crosses itself, each lobe is
    filled.

    Raises:
        InputError: Fewer than three corners.
    """
    if len(ring) > 1 and np.array_equal(ring[0], ring[-1]):
        ring = ring[:-1]
    if len(ring) < 3:
        raise InputError(f"{name}: an outline of {len(ring)} points", "give at least three corners")
    outline = shapely.make_valid(shapely.Polygon(ring))
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(outline))
    # Closed: the last corner repeats the first
    corners = shapely.get_coordinates(parts, include_z=True).reshape(-1, 4, 3)
    return corners[:, :3]
