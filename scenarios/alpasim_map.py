"""A lane map as AlpaSim's loader reads it from map tables: the form in which scenes are exported and in which preset ``alpasim`` scores.

Tables hold two rails a lane with the same number of points, and nothing else of its shape: the centre is halfway between the rails, point
by point. So a lane's own centre line is not used where it has both rails, and rails with different numbers of points get points added on
their own segments, which leaves the lane's area as it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.geometry import HALF_WIDTH_M, arc_lengths
from alpasim_plugin.core.types import F64, Lane, LaneMap
from scenarios.vertices import with_vertices

NO_LANES_OF_CARS = ("sidewalk",)  # every other kind counts: without shoulders the distance to the lane boundary is half a metre off


def alpasim_view(lane_map: LaneMap) -> LaneMap:
    """Return a map as AlpaSim's loader would give it after `scenarios.usdz_tables` has written it."""
    kept = {key: lane for key, lane in lane_map.lanes.items() if lane.kind not in NO_LANES_OF_CARS}
    lanes = {}
    for key, lane in kept.items():
        left, right = rails(lane)
        lanes[key] = replace(
            lane, centre=with_vertices((left + right) / 2), left=with_vertices(left), right=with_vertices(right),
            successors=tuple(s for s in lane.successors if s in kept),
            left_neighbour=lane.left_neighbour if lane.left_neighbour in kept else None,
            right_neighbour=lane.right_neighbour if lane.right_neighbour in kept else None,
        )  # fmt: skip
    return replace(lane_map, lanes=lanes, road_edges=tuple(with_vertices(edge) for edge in lane_map.road_edges if len(edge) > 1))


def rails(lane: Lane) -> tuple[F64, F64]:
    """Return the left and the right rail ``(N, 3)`` of a lane, in driving direction, with the same number of points.

    A lane that lacks an edge is its centre widened by `HALF_WIDTH_M` to both sides.
    """
    if lane.left is None or lane.right is None:
        return _beside(lane.centre, HALF_WIDTH_M), _beside(lane.centre, -HALF_WIDTH_M)
    if len(lane.left) == len(lane.right):
        return lane.left, lane.right
    shares = [_shares(edge) for edge in (lane.left, lane.right)]
    union = np.unique(np.concatenate(shares))
    # Two shares that differ by rounding alone would give a segment of no length.
    union = union[np.concatenate([[True], np.diff(union) > 1e-9])]
    union[-1] = 1.0
    return _at(union, shares[0], lane.left), _at(union, shares[1], lane.right)


def _at(wanted: F64, shares: F64, line: F64) -> F64:
    return np.stack([np.interp(wanted, shares, line[:, d]) for d in range(3)], axis=1)


def _shares(line: F64) -> F64:
    """Return how far along a polyline ``(N, 3)`` each vertex lies, 0..1 of its length in the plane."""
    s = arc_lengths(line[:, :2])
    return np.asarray(s / s[-1]) if s[-1] > 0 else np.linspace(0.0, 1.0, len(line))


def _beside(centre: F64, left_m: float) -> F64:
    """Return a polyline ``(N, 3)`` shifted to the left by the mean of the normals of its adjoining segments."""
    along = np.gradient(centre[:, :2], axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    out = centre.copy()
    out[:, :2] += left_m * np.stack([-along[:, 1], along[:, 0]], axis=1)
    return out
