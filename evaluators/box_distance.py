"""Distances between rectangles and segments in the plane, as arrays."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import F64, I64, Bool
from evaluators.footprint import Footprints


def nearest_segments(boxes: Footprints, box: I64, segments: F64, segment: I64, counts: Bool) -> I64:
    """Return which pairs ``(K,)`` of box and segment may be the nearest of their box.

    Left out are pairs that are farther apart than the nearest counting pair of the same box, by the circles around and inside the boxes.

    Args:
        boxes: ``(T,)`` with sharp corners.
        box: ``(M,)`` box of each pair.
        segments: ``(4, S)`` x and y of the start, x and y of the end, metres.
        segment: ``(M,)`` segment of each pair.
        counts: ``(M,)`` pairs whose distance bounds that of interest.
    """
    x0, y0, x1, y1 = segments
    along_x, along_y = x1 - x0, y1 - y0
    length2 = along_x * along_x + along_y * along_y
    x, y = boxes.xy[box, 0] - x0[segment], boxes.xy[box, 1] - y0[segment]
    from_centre = _point_to_segment(x, y, along_x[segment], along_y[segment], length2[segment])
    least = np.full(len(boxes.yaw), np.inf)
    np.minimum.at(least, box[counts], from_centre[counts])
    most = np.maximum(least - boxes.inner_radius_m, 0.0) + boxes.radius_m + 1e-6
    return np.flatnonzero(from_centre <= most[box])


def box_to_segments(boxes: Footprints, segments: F64) -> tuple[F64, F64]:
    """Return distances ``(M,)`` of sharp-cornered boxes ``(M,)`` from segments ``(4, M)``, and how far segments reach into boxes.

    Returns:
        The distance in metres, 0 where they touch; and how far inside the box the middle of the segment's part in the box is, -1 where they
        do not touch.
    """
    # Relative to the centre, in the box's own directions: the box is |x| <= half_x, |y| <= half_y.
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    x, y = boxes.xy.T
    x0, y0, x1, y1 = segments[0] - x, segments[1] - y, segments[2] - x, segments[3] - y
    x0, y0, x1, y1 = c * x0 + s * y0, c * y0 - s * x0, c * x1 + s * y1, c * y1 - s * x1
    half_x, half_y = boxes.size[:, 0] / 2, boxes.size[:, 1] / 2
    distance = np.minimum(_outside(x0, y0, half_x, half_y), _outside(x1, y1, half_x, half_y))
    along_x, along_y = x1 - x0, y1 - y0
    length2 = along_x * along_x + along_y * along_y
    for x, y in ((half_x, half_y), (half_x, -half_y), (-half_x, -half_y), (-half_x, half_y)):
        np.minimum(distance, _point_to_segment(x - x0, y - y0, along_x, along_y, length2), out=distance)
    enter, leave = _inside(x0, y0, along_x, along_y, half_x, half_y)
    touches = enter <= leave
    f = (enter + leave) / 2
    depth = np.minimum(half_x - np.abs(x0 + f * along_x), half_y - np.abs(y0 + f * along_y))
    return np.where(touches, 0.0, distance), np.where(touches, depth, -1.0)


def _point_to_segment(x: F64, y: F64, along_x: F64, along_y: F64, length2: F64) -> F64:
    """Return the distances ``(M,)`` of points from segments that start at the origin."""
    f = np.clip((x * along_x + y * along_y) / np.maximum(length2, 1e-300), 0.0, 1.0)
    x, y = x - f * along_x, y - f * along_y
    return np.asarray(np.sqrt(x * x + y * y))


def _outside(x: F64, y: F64, half_x: F64, half_y: F64) -> F64:
    """Return the distances ``(M,)`` of points from boxes, 0 inside."""
    x, y = np.maximum(np.abs(x) - half_x, 0.0), np.maximum(np.abs(y) - half_y, 0.0)
    return np.asarray(np.sqrt(x * x + y * y))


def _inside(x0: F64, y0: F64, along_x: F64, along_y: F64, half_x: F64, half_y: F64) -> tuple[F64, F64]:
    """Return the shares ``(M,)`` at which segments enter and leave boxes; entering after leaving where they miss (Liang and Barsky)."""
    enter, leave = np.zeros(len(x0)), np.ones(len(x0))
    for at, step, half in ((x0, along_x, half_x), (y0, along_y, half_y)):
        flat = step == 0
        with np.errstate(divide="ignore", invalid="ignore"):
            s, t = (-half - at) / step, (half - at) / step
        within = np.abs(at) <= half
        enter = np.maximum(enter, np.where(flat, np.where(within, 0.0, 2.0), np.minimum(s, t)))
        leave = np.minimum(leave, np.where(flat, np.where(within, 1.0, -1.0), np.maximum(s, t)))
    return enter, leave
