"""The drivable surface of a map as one shape, and the signed margin of footprints to its border.

The surface is the union of all lane areas and drivable areas on the ego's level. Gaps between them
up to the preset's ``seam_m`` wide are closed; the border elsewhere stays where the map has it. The
margin is the least over the footprint's points of the signed distance to the border, positive
inside: inside, the gap to the border; outside, minus how far the point that sticks out most is from
the surface. It is continuous and defined however far from the map the ego is.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.lane_areas import distance_and_rise, touching_pairs
from alpasim_plugin.core.types import F64, I64, Bool
from evaluators.metrics.footprint import Geometries

MARGIN_M = 1e-6  # accuracy of the margin
SLOPE = 0.2  # a road on the ego's level may lie this much higher or lower per metre of distance
TIE_M = 0.5  # of two areas above one another, both count where their heights differ so little
_GRID_M = 1e-7  # shared edges that differ by rounding only are joined on this grid
# a gap is open along less than this share of its outline; what closing adds to bends of the outer
# border is open to more
_MOUTH = 0.35
_N_FEATURES = 6


class Surface:
    """The drivable surface of one map, metres relative to its origin."""

    def __init__(
        self, areas: Geometries, outlines: Sequence[F64], seam_m: float, level_m: float
    ) -> None:
        """Take shapes and their outlines in space.

        Args:
            areas: ``(B,)`` plan-view polygons.
            outlines: B polylines ``(N, 3)`` that give their heights.
            seam_m: Widest gap to close.
            level_m: What lies farther above or below the ground under the ego than this, and `SLOPE`
                per metre of distance, is another road.
        """
        self._areas, self._seam_m, self._level_m = areas, seam_m, level_m
        self._outlines = [
            np.repeat(line, 2, axis=0) if len(line) == 1 else line for line in outlines
        ]
        self._bounds = np.array(
            [(line.min(axis=0), line.max(axis=0)) for line in self._outlines]
        ).reshape(-1, 2, 3)
        self._regions: dict[bytes, Region] = {}

    @property
    def n_areas(self) -> int:
        """Give how many areas it is made of."""
        return len(self._areas)

    @property
    def is_empty(self) -> bool:
        """Return whether nothing here has an area."""
        return bool(np.all(shapely.is_empty(self._areas)))

    def margin_m(self, footprints: Geometries, xyz: F64) -> F64:
        """Return the signed margins ``(T,)`` of footprints ``(T,)`` with the ground under their
        middles ``(T, 3)``, -inf where nothing is on their level.
        """
        level = self.on_level(xyz)
        out = np.full(len(footprints), -np.inf)
        _, first, group = np.unique(
            np.packbits(level, axis=1), axis=0, return_index=True, return_inverse=True
        )
        group = group.reshape(-1)
        for g, representative in enumerate(first):
            if level[representative].any():
                rows = np.flatnonzero(group == g)
                out[rows] = self.region(level[representative]).margin_m(footprints[rows])
        return out

    def on_level(self, xyz: F64) -> Bool:
        """Return which areas ``(T, B)`` are on the level of points ``(T, 3)``: not on a bridge
        above nor on a road below.
        """
        # Near enough even if the whole outline were at its extreme height and at the nearest corner
        # of its bounds.
        low, high = self._bounds[:, 0], self._bounds[:, 1]  # (B, 3)
        outside = np.maximum(
            np.maximum(low[None, :, :2] - xyz[:, None, :2], xyz[:, None, :2] - high[None, :, :2]),
            0.0,
        )
        at_least_m = np.hypot(outside[..., 0], outside[..., 1])  # (T, B)
        most_m = np.maximum(high[None, :, 2] - xyz[:, None, 2], xyz[:, None, 2] - low[None, :, 2])
        out = most_m <= self._level_m + SLOPE * at_least_m
        for b in np.flatnonzero(~out.all(axis=0)):
            rows = np.flatnonzero(~out[:, b])
            away_m, rise_m = distance_and_rise(self._outlines[b], xyz[rows])
            out[rows, b] = rise_m <= self._level_m + SLOPE * away_m
        return self._without_stacked(out, xyz)

    @cached_property
    def _stacked(self) -> I64:
        """Pairs ``(P, 2)`` of areas that lie above one another, and not on one slope."""
        no_pairs = np.zeros((0, 2), dtype=np.int64)
        if not len(self._bounds) or np.ptp(self._bounds[:, :, 2]) <= self._level_m:
            return no_pairs
        pairs, apart_m, away_m = touching_pairs(self._areas, self._outlines, self._seam_m / 2)
        return pairs[apart_m > self._level_m + SLOPE * away_m]

    def _without_stacked(self, level: Bool, xyz: F64) -> Bool:
        """Return ``level (T, B)`` with, of two areas above one another, only the one that is nearer
        in height to a point; both where these differ by less than `TIE_M`, as at the foot of a ramp.
        """
        out = level.copy()
        for pair in self._stacked.tolist():
            rows = np.flatnonzero(level[:, pair].all(axis=1))
            if not len(rows):
                continue
            first_m, second_m = (
                distance_and_rise(self._outlines[number], xyz[rows])[1] for number in pair
            )
            out[rows, pair[0]] &= first_m <= second_m + TIE_M
            out[rows, pair[1]] &= second_m <= first_m + TIE_M
        return out

    def region(self, chosen: Bool) -> Region:
        """Return the joined areas marked in ``(B,)``; kept, as neighbouring steps share them."""
        key = np.packbits(chosen).tobytes()
        if key not in self._regions:
            self._regions[key] = Region(closed_union(self._areas[chosen], self._seam_m))
        return self._regions[key]


class Region:
    """A plan-view shape with its border indexed by segments."""

    def __init__(self, shape: Any) -> None:
        self.shape = shape
        shapely.prepare(shape)
        rings = [
            shapely.get_coordinates(ring)
            for part in shapely.get_parts(shape)
            for ring in shapely.get_rings(part)
        ]
        self._start = np.concatenate([np.zeros((0, 2)), *(ring[:-1] for ring in rings)])
        self._end = np.concatenate([np.zeros((0, 2)), *(ring[1:] for ring in rings)])
        self._tree = shapely.STRtree(
            shapely.linestrings(np.stack([self._start, self._end], axis=1))
        )

    def margin_m(self, footprints: Geometries) -> F64:
        """Return the signed margins ``(T,)`` of polygons, -inf where the shape is empty."""
        out = np.full(len(footprints), -np.inf)
        if not len(self._start):
            return out
        inside = shapely.contains(self.shape, footprints)
        out[inside] = self._nearest(footprints[inside])[1]
        out[~inside] = -self._depth_m(footprints[~inside])
        return out

    def border_distance_m(self, xy: F64) -> F64:
        """Return how far points ``(N, 2)`` are from the border, on either side of it."""
        return self._nearest(shapely.points(xy))[1]

    def _nearest(self, shapes: Geometries) -> tuple[I64, F64]:
        """Return the nearest border segment and its distance per shape; among equally near ones
        any.
        """
        (_, segment), distance = self._tree.query_nearest(
            shapes, return_distance=True, all_matches=False
        )
        return segment, distance

    def _depth_m(self, footprints: Geometries) -> F64:
        """Return how far ``(N,)`` footprints stick out: the greatest distance to the shape among
        their points, to `MARGIN_M`.

        What sticks out is cut into ever smaller pieces. The distance to one border segment is
        convex, and so is the mean of two; over a piece neither exceeds its greatest value at the
        piece's corners, and the distance to the shape exceeds neither. Pieces that cannot hold a
        greater distance than one already found are dropped. Two segments are needed for gaps:
        halfway between two parallel borders no single one bounds the distance well, and no corner
        of a piece need lie there.
        """
        best = np.zeros(len(footprints))
        pieces = shapely.difference(footprints, self.shape)
        owner = np.flatnonzero(~shapely.is_empty(pieces))
        pieces = pieces[owner]
        while len(owner):
            corner, piece = shapely.get_coordinates(pieces, return_index=True)
            nearest, distance = self._nearest(shapely.points(corner))
            np.maximum.at(best, owner[piece], distance)
            # A point of each piece about as far from one border as from another.
            last = np.cumsum(np.bincount(piece)) - 1
            a = np.lexsort((distance, piece))[last]
            other = nearest != nearest[a][piece]
            b = np.lexsort((np.where(other, distance, -1.0), piece))[last]
            lead = []  # by how much the border near a is nearer than the one near b, at a and at b
            for index in (a, b):
                to = [
                    segment_distance(self._start[nearest[k]], self._end[nearest[k]], corner[index])
                    for k in (a, b)
                ]
                lead.append(to[1] - to[0])
            span = lead[0] - lead[1]
            f = np.clip(np.divide(lead[0], span, out=np.zeros_like(span), where=span > 0), 0.0, 1.0)
            point = corner[a] + f[:, None] * (corner[b] - corner[a])
            is_inside = shapely.contains_xy(self.shape, point)
            np.maximum.at(best, owner, np.where(is_inside, 0.0, self.border_distance_m(point)))
            bound = self._bound_m(pieces, corner, piece, nearest, distance)
            rows = np.flatnonzero(bound > best[owner] + MARGIN_M)
            owner, pieces = _quartered(owner[rows], pieces[rows])
        return best

    def _bound_m(
        self, pieces: Geometries, corner: F64, piece: I64, nearest: I64, distance: F64
    ) -> F64:
        """Return for each piece a distance ``(M,)`` that none of its points exceeds."""
        n = np.bincount(piece, minlength=len(pieces))
        begin = np.cumsum(n) - n
        deepest = np.lexsort((distance, piece))[begin + n - 1]
        spread = [begin + (k * n) // 4 for k in range(4)]
        middle, _ = self._nearest(shapely.centroid(pieces))
        features = np.stack(
            [middle, *(nearest[feature] for feature in (deepest, *spread))], axis=1
        )  # (M, _N_FEATURES)
        away = np.stack(
            [
                segment_distance(self._start[numbers], self._end[numbers], corner)
                for numbers in features[piece].T
            ],
            axis=1,
        )
        bound = np.full(len(pieces), np.inf)
        for i, j in combinations_with_replacement(range(_N_FEATURES), 2):
            np.minimum(bound, np.maximum.reduceat((away[:, i] + away[:, j]) / 2, begin), out=bound)
        return bound


@np.errstate(
    divide="ignore", invalid="ignore"
)  # flags that the geometry library raises inside and has dealt with
def closed_union(areas: Geometries, seam_m: float) -> Any:
    """Return the union of areas with the gaps between them up to ``seam_m`` wide filled.

    Filled is what a disc of that diameter cannot reach from outside (morphological closing).
    Closing also rounds off bends of the outer border by small slivers. These are open to the
    outside along much of their outline, unlike gaps, and are left out, so that the outer border is
    the map's own.
    """
    shape = shapely.union_all(areas[~shapely.is_empty(areas)], grid_size=_GRID_M)
    if seam_m <= 0 or shapely.is_empty(shape):
        return shape
    radius_m = (
        0.505 * seam_m
    )  # arcs are drawn as polygons inside the circle; a gap of seam_m must close all the same
    wide = shapely.buffer(shape, radius_m, quad_segs=16)
    added = shapely.get_parts(
        shapely.difference(shapely.buffer(wide, -radius_m, quad_segs=16), shape)
    )
    added = added[shapely.area(added) > 0]
    if not len(added):
        return shape
    # The share of each outline that does not run along the region's border.
    ring, part = shapely.get_coordinates(shapely.get_exterior_ring(added), return_index=True)
    side = np.flatnonzero(part[1:] == part[:-1])
    length = np.linalg.norm(ring[side + 1] - ring[side], axis=1)
    apart = Region(shape).border_distance_m((ring[side + 1] + ring[side]) / 2) > 10 * _GRID_M
    whole = np.bincount(part[side], length, minlength=len(added))
    share = np.bincount(part[side], length * apart, minlength=len(added)) / whole
    gaps = shapely.buffer(added[share < _MOUTH], 5 * _GRID_M, join_style="mitre")
    return shapely.union_all(np.concatenate([[shape], gaps]), grid_size=_GRID_M)


def _quartered(owner: I64, pieces: Geometries) -> tuple[I64, Geometries]:
    """Cut pieces at the middle of their bounds; empty quarters are left out."""
    low_x, low_y, high_x, high_y = shapely.bounds(pieces).reshape(-1, 4).T
    x = (low_x + high_x) / 2
    y = (low_y + high_y) / 2
    quarters = [
        (low_x, low_y, x, y),
        (x, low_y, high_x, y),
        (low_x, y, x, high_y),
        (x, y, high_x, high_y),
    ]
    cut = np.concatenate(
        [shapely.intersection(pieces, shapely.box(*quarter)) for quarter in quarters]
    )
    keep = np.flatnonzero(~shapely.is_empty(cut))
    return np.tile(owner, 4)[keep], cut[keep]


def segment_distance(start: F64, end: F64, points: F64) -> F64:
    """Return distances ``(M,)`` between points ``(M, D)`` and segments ``(M, D)``, ``(M, D)``."""
    # One coordinate after the other: numpy is slow at rows of two or three numbers.
    along = [end[:, axis] - start[:, axis] for axis in range(start.shape[1])]
    offset = [points[:, axis] - start[:, axis] for axis in range(start.shape[1])]
    length2 = sum(a * a for a in along)
    f = sum(a * o for a, o in zip(along, offset, strict=True))
    f = np.clip(np.divide(f, length2, out=np.zeros(len(start)), where=length2 > 0), 0.0, 1.0)
    return np.sqrt(sum((o - f * a) ** 2 for a, o in zip(along, offset, strict=True)))
