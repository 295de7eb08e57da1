"""The layers of the semantic map, and their conversion to arrays: straight segments with width and
colour, and flat triangles.

What is painted is the rule of `world.paint`: marking lines and lane edges of known paint, each
once; unknown paint is drawn as nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, Actor, Bool, Box, LaneMap, Paint
from alpasim_plugin.fixers.semantic_map.style import (
    OPENGL,
    AreaKind,
    LightState,
    LineColour,
    MapStyle,
    Pattern,
    Rgb,
)
from alpasim_plugin.gaussians.cloud import require_rigid
from alpasim_plugin.world.paint import painted_lines

POLE_HEIGHT_M = 3.0  # of poles given as one point

_PAINT: Mapping[Paint, tuple[LineColour, tuple[Pattern, ...]]] = {
    "solid_white": ("white", ("solid",)),
    "dashed_white": ("white", ("long_dashed",)),
    "solid_yellow": ("yellow", ("solid",)),
    "dashed_yellow": ("yellow", ("long_dashed",)),
    "double_yellow": ("yellow", ("solid", "solid")),
}


@dataclass(frozen=True)
class LaneLine:
    """A lane line: one pattern, or two for a double line, the left one first as seen along the
    line.
    """

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
    """Layers that `LaneMap` does not hold. ``lane_lines``, where given, replace those derived from
    the lane map.
    """

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
        raise InputError(
            f"actor {missing[0]}: a pose without a box",
            "give the scenario's actors",
        )
    return tuple(ActorBox(pose, known[key].box, known[key].label) for key, pose in poses.items())


def lane_lines(lane_map: LaneMap) -> tuple[LaneLine, ...]:
    """Return the lane lines of a map, each drawn once."""
    return tuple(LaneLine(xyz, *_PAINT[paint]) for xyz, paint in painted_lines(lane_map))


GROUP = 32  # segments that share a bounding sphere
# Depth bias of ground areas, so that lines on them stay visible, and smaller areas on larger ones.
GROUND_BIAS_M = {
    "road_marking": 0.3,
    "crosswalk": 0.4,
    "road_island": 0.5,
    "buffer_zone": 0.5,
    "intersection": 0.6,
}
DOING = "preparing the semantic map"
# Corners of a unit box: bit 2 is +x, bit 1 is +y, bit 0 is +z.
CORNERS = np.array([[(i >> 2 & 1) - 0.5, (i >> 1 & 1) - 0.5, (i & 1) - 0.5] for i in range(8)])
FACES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)  # wound to the left from outside
TRIANGLES = np.concatenate([FACES[:, [0, 1, 2]], FACES[:, [0, 2, 3]]])  # (12, 3)
EDGES = np.array(
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]]
)


@dataclass(frozen=True)
class Segments:
    """Straight pieces of line, relative to the scene's origin."""

    ends: F64  # (S, 2, 3) metres
    style: F64  # (S, 6) width at 1280 px, fade gain, bias towards the camera in metres, r, g, b
    spheres: F64  # (G, 4) centre and radius around each GROUP of segments


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
    style: MapStyle


def prepare_map(
    lane_map: LaneMap, extras: MapExtras | None = None, style: MapStyle = OPENGL
) -> PreparedMap:
    """Prepare a scene's map for drawing.

    Args:
        lane_map: Coordinates may be UTM-sized: everything is stored relative to the middle of the
            map.
        extras: Layers that the lane map does not hold.
        style: Colours, widths, patterns.

    Raises:
        InputError: A coordinate that is not finite, an area without three corners, or a pose that
            is not rigid.
    """
    extras = extras or MapExtras()
    lines = lane_lines(lane_map) if extras.lane_lines is None else extras.lane_lines
    areas = [("crosswalk", ring) for ring in lane_map.crosswalks] + [
        (area.kind, area.ring) for area in extras.areas
    ]
    boxes = [("sign", pose, box) for pose, box in lane_map.signs]
    boxes += [(f"light_{light.state}", light.T_world_box, light.box) for light in extras.lights]
    poles = [_pole(line) for line in lane_map.poles]
    plain: list[tuple[str, float, Sequence[F64]]] = [
        ("road_boundary", style.line_px, lane_map.road_edges),
        ("stop_line", style.line_px, lane_map.stop_lines),
        ("pole", style.pole_px, poles),
    ]

    everything = (
        [("lane line", line.xyz) for line in lines]
        + areas
        + [(name, line) for name, _, group in plain for line in group]
    )
    for name, xyz in everything:
        _require_points(name, xyz)
    for name, pose, box in boxes:
        require_box(name, pose, box)
    points = [xyz for _, xyz in everything if len(xyz)] + [
        pose[None, :3, 3] for _, pose, _ in boxes
    ]
    origin = _middle(np.concatenate(points)) if points else np.zeros(3)

    pieces: list[tuple[F64, float, float, Rgb]] = []  # polyline, width, gain, colour
    gain = style.line_width_gain
    for line in lines:
        pieces += _lane_line(LaneLine(line.xyz - origin, line.colour, line.patterns), style)
    for name, width_px, group in plain:
        pieces += [
            (line - origin, width_px, 1.0 if name == "pole" else gain, style.colours[name])
            for line in group
        ]
    corners = [triangulate(name, ring - origin) for name, ring in areas]
    colours = [
        _flat(-GROUND_BIAS_M[name], style.colours[name], len(c))
        for (name, _), c in zip(areas, corners, strict=True)
    ]
    for name, pose, box in boxes:
        corners.append(box_corners(pose, box, origin)[TRIANGLES])
        colours.append(_flat(0.0, style.colours[name], len(TRIANGLES)))
    triangles = np.concatenate([np.zeros((0, 3, 3)), *corners])
    open_ = np.zeros(len(triangles), dtype=bool)
    filled = Triangles(
        triangles,
        open_,
        np.zeros((len(triangles), 3)),
        np.concatenate([np.zeros((0, 7)), *colours]),
    )
    return PreparedMap(origin, _segments(pieces), filled, style)


def box_corners(pose: F64, box: Box, origin: F64) -> F64:
    """Return the eight corners ``(8, 3)`` of a box relative to ``origin``."""
    sizes = np.array([box.length_m, box.width_m, box.height_m])
    return np.asarray((CORNERS * sizes) @ pose[:3, :3].T + (pose[:3, 3] - origin))


def require_box(name: str, pose: F64, box: Box) -> None:
    """Raise `InputError` unless a box has a rigid pose and finite sizes that are not negative."""
    require_rigid(pose, name)
    sizes = (box.length_m, box.width_m, box.height_m)
    if not np.isfinite(sizes).all() or min(sizes) < 0:
        raise InputError(
            f"{name}: a box of {sizes} m", "give finite sizes, length, width and height"
        )


def _middle(points: F64) -> F64:
    """Return the middle of the points' extent in whole metres, so that subtracting it loses
    nothing.
    """
    return np.asarray(np.round((points.min(axis=0) + points.max(axis=0)) / 2))


def _flat(bias_m: float, colour: Rgb, n: int) -> F64:
    """Return ``(n, 7)`` rows of one colour from front to back."""
    return np.tile(np.array((bias_m, *colour, *colour), dtype=np.float64), (n, 1))


def _require_points(name: str, xyz: F64) -> None:
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError(
            f"{name}: an array of shape {xyz.shape}", "give points (N, 3), metres, world"
        )
    if not np.isfinite(xyz).all():
        at = int(np.flatnonzero(~np.isfinite(xyz).all(axis=1))[0])
        raise InputError(f"{name}: point {at} is {xyz[at].tolist()}", "repair or drop this line")


def _pole(line: F64) -> F64:
    """Make a vertical line of a pole given as one point."""
    return (
        np.concatenate([line, line + np.array([0.0, 0.0, POLE_HEIGHT_M])])
        if len(line) == 1
        else line
    )


def _lane_line(line: LaneLine, style: MapStyle) -> list[tuple[F64, float, float, Rgb]]:
    """Cut a lane line into the pieces that are painted."""
    if len(line.xyz) < 2:
        return []
    if not style.typed_lines:
        return [(line.xyz, style.line_px, style.line_width_gain, style.colours["line_untyped"])]
    colour = style.colours[f"line_{line.colour}"]
    offsets = (0.0,) if len(line.patterns) == 1 else (style.double_offset_m, -style.double_offset_m)
    out: list[tuple[F64, float, float, Rgb]] = []
    for pattern, left_m in zip(line.patterns, offsets, strict=True):
        shifted = _offset_left(line.xyz, left_m) if left_m else line.xyz
        width_px = style.line_px * (style.other_factor if pattern == "other" else 1.0)
        out += [
            (piece, width_px, style.line_width_gain, colour)
            for piece in cut_dashes(shifted, style.patterns[pattern])
        ]
    return out


def cut_dashes(line: F64, pattern: Sequence[tuple[float, float]]) -> list[F64]:
    """Return the painted pieces of a polyline ``(N, 3)``; an empty pattern paints all of it.

    Dashes start at the first point, are measured along the line in space, and bend with it.
    """
    if not pattern:
        return [line]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(s) > 0])
    s, line = s[keep], line[keep]
    if len(s) < 2:
        return []
    period = sum(on + off for on, off in pattern)
    first = np.cumsum([0.0, *(on + off for on, off in pattern)])[:-1]
    starts = (np.arange(int(np.ceil(s[-1] / period)))[:, None] * period + first).ravel()
    ends = np.minimum(
        starts + np.tile([on for on, _ in pattern], len(starts) // len(pattern)), s[-1]
    )
    out = []
    for a, b in zip(starts, ends, strict=True):
        if b > a:
            inner = np.concatenate([[a], s[(s > a) & (s < b)], [b]])
            out.append(np.stack([np.interp(inner, s, line[:, k]) for k in range(3)], axis=1))
    return out


def _offset_left(line: F64, left_m: float) -> F64:
    """Offset a polyline to the left in plan view; corners keep the distance up to a miter of 2."""
    step = np.diff(line[:, :2], axis=0)
    length = np.linalg.norm(step, axis=1)
    keep = length > 1e-9
    if not keep.any():
        return line
    line = line[np.concatenate([[True], keep])]
    direction = step[keep] / length[keep, None]
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    both = np.concatenate([normal[:1], normal[:-1] + normal[1:], normal[-1:]])
    both /= np.maximum(np.linalg.norm(both, axis=1), 1e-9)[:, None]
    cosine = np.maximum(
        np.concatenate([[1.0], np.sum(both[1:-1] * normal[1:], axis=1), [1.0]]), 0.5
    )
    out = line.copy()
    out[:, :2] += both * (left_m / cosine)[:, None]
    return out


def _segments(pieces: Sequence[tuple[F64, float, float, Rgb]]) -> Segments:
    pieces = [p for p in pieces if len(p[0]) > 1]
    ends = [np.stack([line[:-1], line[1:]], axis=1) for line, _, _, _ in pieces]
    style = [
        np.tile(np.array((width, gain, 0.0, *rgb)), (len(line) - 1, 1))
        for line, width, gain, rgb in pieces
    ]
    joined = np.concatenate([np.zeros((0, 2, 3)), *ends])
    return Segments(joined, np.concatenate([np.zeros((0, 6)), *style]), _spheres(joined))


def _spheres(ends: F64) -> F64:
    out = np.zeros((-(-len(ends) // GROUP), 4))
    for g in range(len(out)):
        points = ends[g * GROUP : (g + 1) * GROUP].reshape(-1, 3)
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        out[g] = (*centre, np.linalg.norm(points - centre, axis=1).max())
    return out


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
    corners = shapely.get_coordinates(parts, include_z=True).reshape(
        -1, 4, 3
    )  # closed: the last corner repeats the first
    return np.asarray(corners[:, :3])
