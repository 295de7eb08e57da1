"""Reference implementations of contact and lane keeping, one step at a time, without filters or an
index.

Contact is decided in exact rational arithmetic on the very corners that the array evaluators use,
so at touching edges and corners both must agree without any tolerance. Distances and unions are
floating point here as well.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

import numpy as np
import shapely

from alpasim_plugin.core.geometry import (
    interpolate,
    rectangle_corners,
    yaw_from_quat,
    yaw_of,
)
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import (
    Lane,
)
from evaluators.metrics.footprint import origin_of

Point = tuple[Fraction, Fraction]


# --- contact


@dataclass(frozen=True)
class StepContact:
    """What one step looks like: who touches the ego on which side, and the gap to the nearest actor
    (inf: nobody there).
    """

    sides: dict[str, str]  # actor id -> front | rear | lateral
    gap_m: float


def contacts_by_step(rollout, preset):
    """Classify every actor at every step; sharp-cornered footprints only."""
    origin = origin_of(rollout.ego, preset)
    out = []
    for i, t_us in enumerate(rollout.ego.t_us.tolist()):
        ego = ego_corners(rollout, preset, i, origin)
        sides = {}
        gap_m = math.inf
        for actor in rollout.actors.values():
            box = actor_corners(actor, t_us, preset, origin)
            if box is None:
                continue
            if touch(ego, box):
                sides[actor.actor_id] = (
                    "front"
                    if touch(ego[0:2], box)
                    else "rear"
                    if touch(ego[2:4], box)
                    else "lateral"
                )
            gap_m = min(gap_m, 0.0 if touch(ego, box) else polygon_distance(ego, box))
        out.append(StepContact(sides, gap_m))
    return out


def ego_corners(rollout, preset, step, origin):
    """Return the ego's corners ``(4, 2)`` at a step."""
    size = np.array(preset.ego_size_m or (rollout.ego_box.length_m, rollout.ego_box.width_m)) * (
        1.0 - preset.shrink
    )
    return _corners(rollout.ego.xyz[step], rollout.ego.quat[step], size, origin)


def actor_corners(actor, t_us, preset, origin):
    """Return an actor's corners ``(4, 2)`` at a time, None before its first and after its last
    logged time.
    """
    track = actor.track
    if t_us < track.t_us[0] or t_us > track.t_us[-1]:
        return None
    size = np.array([actor.box.length_m, actor.box.width_m]) * (1.0 - preset.shrink)
    exact = np.flatnonzero(track.t_us == t_us)
    if len(exact):
        return _corners(track.xyz[exact[0]], track.quat[exact[0]], size, origin)
    pose = interpolate(track, t_us)
    return np.asarray(
        rectangle_corners(pose[None, :2, 3] - origin[:2], np.array([yaw_of(pose)]), size[None])[0]
    )


def _corners(xyz, quat, size, origin):
    return np.asarray(
        rectangle_corners(
            (xyz[:2] - origin[:2])[None], np.array([yaw_from_quat(quat)]), size[None]
        )[0]
    )


def touch(a, b):
    """Return whether two convex shapes (or a segment and one) share a point: no edge direction of
    either separates them. Exact.
    """
    shapes = [exact(a), exact(b)]
    for shape in shapes:
        for p, q in sides_of(shape):
            normal = (p[1] - q[1], q[0] - p[0])
            spans = [[normal[0] * x + normal[1] * y for x, y in other] for other in shapes]
            if max(spans[0]) < min(spans[1]) or max(spans[1]) < min(spans[0]):
                return False
    return True


def polygon_distance(a, b):
    """Return the distance of two disjoint convex polygons: the least over corners of one and sides
    of the other.
    """
    best = math.inf
    for points, ring in ((a, b), (b, a)):
        for x, y in points.tolist():
            for (x0, y0), (x1, y1) in zip(
                ring.tolist(), np.roll(ring, -1, axis=0).tolist(), strict=True
            ):
                best = min(best, point_to_segment((x, y), (x0, y0), (x1, y1))[0])
    return best


def point_to_segment(p, a, b):
    """Return the distance of a point from a segment in any dimension, and the share of the segment
    at the nearest point.
    """
    along = [y - x for x, y in zip(a, b, strict=True)]
    offset = [y - x for x, y in zip(a, p, strict=True)]
    length2 = sum(d * d for d in along)
    f = (
        min(max(sum(d * o for d, o in zip(along, offset, strict=True)) / length2, 0.0), 1.0)
        if length2 > 0
        else 0.0
    )
    return math.sqrt(sum((o - f * d) ** 2 for d, o in zip(along, offset, strict=True))), f


def exact(shape):
    """Return the points ``(N, 2)`` as fractions."""
    return [(Fraction(x), Fraction(y)) for x, y in shape.tolist()]


def sides_of(shape):
    """Return the sides of a closed ring, or the one segment of two points."""
    return (
        [(shape[0], shape[1])]
        if len(shape) == 2
        else [(shape[i], shape[(i + 1) % len(shape)]) for i in range(len(shape))]
    )


# --- road


@dataclass(frozen=True)
class StepRoad:
    """What one step looks like; ``offroad`` is None where a road edge is needed and the map has
    none.
    """

    near: frozenset[str]
    on_road: bool
    offroad: bool | None
    boundary_gap_m: float


def road_by_step(rollout, scene, preset):
    """Apply the off-road rule step by step (lane query "line", edge query "any")."""
    origin = origin_of(scene.ego_log, preset)
    lanes = {key: shifted(lane, origin) for key, lane in scene.lane_map.lanes.items()}
    edges = [edge - origin for edge in scene.lane_map.road_edges]
    out = []
    for i in range(len(rollout.ego)):
        centre = rollout.ego.xyz[i] - origin
        body = shapely.Polygon(ego_corners(rollout, preset, i, origin))
        near = {
            key: lane
            for key, lane in lanes.items()
            if line_distance(centre, lane.centre) <= preset.lane_radius_m
        }
        areas = [lane_polygon(lane, preset.lane_half_width_m) for lane in near.values()]
        union = shapely.union_all(areas).buffer(
            preset.seam_m / 2 if len(areas) > 1 else 0.0, join_style="mitre"
        )
        inside_union = bool(areas) and bool(union.contains(body))
        on_road = any(area.contains(body) for area in areas) or inside_union
        touching = any(_touches(edge, body, float(centre[2]), preset) for edge in edges)
        out.append(
            StepRoad(
                frozenset(near),
                on_road,
                False if on_road else (touching if edges else None),
                float(union.boundary.distance(body)) if inside_union else 0.0,
            )
        )
    return out


def line_distance(point, line):
    """Return the least distance of a point from the segments of a polyline."""
    if len(line) == 1:
        return float(np.linalg.norm(point - line[0]))
    return min(
        point_to_segment(point.tolist(), a.tolist(), b.tolist())[0] for a, b in pairwise(line)
    )


def shifted(lane, origin):
    """Return a lane relative to an origin."""
    left = None if lane.left is None else lane.left - origin
    right = None if lane.right is None else lane.right - origin
    return Lane(lane.lane_id, lane.centre - origin, left, right, lane.kind)


def _touches(edge, body, z, preset):
    for a, b in pairwise(edge):
        if (
            abs((a[2] + b[2]) / 2 - z) <= preset.edge_height_m
            and shapely.LineString([a[:2], b[:2]]).distance(body) < preset.edge_touch_m
        ):
            return True
    return False
