"""The border of unions of lanes, without building the unions.

The gap from a footprint to the border of the lanes around it needs only the stretch of border
beside it, and a drive meets a new set of lanes every few metres. So the rings of all lanes are cut
once where they cross each other, and for each piece it is noted which other lanes cover it. The
border of the union of a set of lanes is then what the set owns and does not cover.

Areas are first grown by half the seam, as `road.join` grows the union: edges that two lanes share
up to rounding then overlap by far more than rounding, and whether a piece is covered is decided
with room to spare. Where it is not (a gap exactly as wide as the seam, an edge not much longer than
it), the piece is *doubtful*. An answer that a doubtful piece could change, or that lies so near to
touching that rounding could change it, is marked as not sure; the caller then builds the union. No
answer here is less exact than the union's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.types import F64, I64, Bool
from evaluators.metrics.footprint import Footprints, Geometries, pairs_of, spans


def nearest_segments(boxes: Footprints, box: I64, segments: F64, segment: I64, counts: Bool) -> I64:
    """Return which pairs ``(K,)`` of box and segment may be the nearest of their box.

    Left out are pairs that are farther apart than the nearest counting pair of the same box, by the
    circles around and inside the boxes.

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
    """Return distances ``(M,)`` of sharp-cornered boxes ``(M,)`` from segments ``(4, M)``, and how
    far segments reach into boxes.

    Returns:
        The distance in metres, 0 where they touch; and how far inside the box the middle of the
        segment's part in the box is, -1 where they do not touch.
    """
    # Relative to the centre, in the box's own directions: the box is |x| <= half_x, |y| <= half_y.
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    x, y = boxes.xy.T
    x0 = segments[0] - x
    y0 = segments[1] - y
    x1 = segments[2] - x
    y1 = segments[3] - y
    x0, y0, x1, y1 = c * x0 + s * y0, c * y0 - s * x0, c * x1 + s * y1, c * y1 - s * x1
    half_x, half_y = boxes.size[:, 0] / 2, boxes.size[:, 1] / 2
    distance = np.minimum(_outside(x0, y0, half_x, half_y), _outside(x1, y1, half_x, half_y))
    along_x, along_y = x1 - x0, y1 - y0
    length2 = along_x * along_x + along_y * along_y
    for x, y in ((half_x, half_y), (half_x, -half_y), (-half_x, -half_y), (-half_x, half_y)):
        np.minimum(
            distance, _point_to_segment(x - x0, y - y0, along_x, along_y, length2), out=distance
        )
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


def _inside(
    x0: F64, y0: F64, along_x: F64, along_y: F64, half_x: F64, half_y: F64
) -> tuple[F64, F64]:
    """Return the shares ``(M,)`` at which segments enter and leave boxes; entering after leaving
    where they miss (Liang and Barsky).
    """
    enter, leave = np.zeros(len(x0)), np.ones(len(x0))
    for at, step, half in ((x0, along_x, half_x), (y0, along_y, half_y)):
        flat = step == 0
        with np.errstate(divide="ignore", invalid="ignore"):
            s, t = (-half - at) / step, (half - at) / step
        within = np.abs(at) <= half
        enter = np.maximum(enter, np.where(flat, np.where(within, 0.0, 2.0), np.minimum(s, t)))
        leave = np.minimum(leave, np.where(flat, np.where(within, 1.0, -1.0), np.maximum(s, t)))
    return enter, leave


# Growing lanes one by one and growing their union differ by a few seams beside corners. From this
# far away that moves a gap by under 1 nm.
SURE_M = 3e-3
MITRE = 5.0  # a grown corner reaches at most this many times as far along its edges as they move
CROSSED_M = (
    2e-5  # a border that reaches this far into a footprint does so by far more than those few seams
)
_AT_ONCE = 128  # footprints, so that what they are compared with stays in the processor's cache
# a doubtful piece that is nearer than the nearest sure one by less than this changes nothing
AGREE_M = 1e-9


@dataclass(frozen=True)
class Held:
    """How unions of lanes hold footprints, per step."""

    crossed: Bool  # (T,) the border runs through the footprint: not contained
    gap_m: F64  # (T,) distance to the border, 0 where crossed
    sure: Bool  # (T,) False: the union must decide


@dataclass(frozen=True)
class _Edges:
    """Edges of rings with the area on their left, one ring after the other."""

    raw: F64  # (4, E) x and y of the start, x and y of the end, as in the map; metres
    grown: F64  # (4, E) the same of the grown ring
    body: I64  # (E,) polygon that the edge belongs to; polygons come in order
    doubtful: Bool  # (E,) too short, or too sharp a corner, for growing it by itself


class Borders:
    """Rings of lane areas cut into P pieces, each with the lanes that cover it."""

    def __init__(self, areas: Geometries, lanes: I64, sets: Bool, seam_m: float) -> None:
        """Cut the rings.

        Args:
            areas: ``(N,)`` valid polygons or multipolygons, metres near their origin.
            lanes: ``(N,)`` the lanes they belong to, among L.
            sets: ``(G, L)`` the sets of these lanes whose unions will be asked for.
            seam_m: Gaps up to this wide between lanes are closed; positive.
        """
        self._together = _together(sets)
        parts, of = shapely.get_parts(areas, return_index=True)
        keep = ~shapely.is_empty(parts)
        self._parts, self._lane = shapely.orient_polygons(parts[keep]), lanes[of[keep]]
        shapely.prepare(self._parts)
        self._grow_m = seam_m / 2
        edges = _edges(self._parts, self._grow_m)
        met = self._together[np.ix_(self._lane, self._lane)]
        np.fill_diagonal(met, False)
        edge, other = _shared(edges)
        shared = np.zeros(
            (len(edges.body), len(self._parts)), dtype=np.bool_
        )  # the whole edge is inside that grown body
        shared[edge, other] = True
        of, begin, end, by = _cut(edges, met, shared, 4 * self._grow_m)
        at = _stretch(edges.grown[:, of], begin, end)
        keep = np.hypot(at[2] - at[0], at[3] - at[1]) > AGREE_M
        of, self._grown = of[keep], at[:, keep]  # (P,), (4, P)
        self._segments = np.concatenate(
            [self._grown, _stretch(edges.raw[:, of], begin[keep], end[keep])], axis=1
        )  # (4, 2 P)
        self._owner = self._lane[edges.body[of]]
        self._doubtful = edges.doubtful[of].copy()
        piece, body = self._covers(edges, of, met, shared, by)
        order = np.argsort(piece, kind="stable")
        piece, lane = piece[order], self._lane[body[order]]
        rank = np.arange(len(piece)) - np.searchsorted(piece, piece)
        self._cover = [
            (piece[rank == k], lane[rank == k]) for k in range(int(rank.max(initial=-1)) + 1)
        ]
        self._doubtful = np.concatenate(
            [self._doubtful, np.zeros_like(self._doubtful)]
        )  # as in the map, nothing is in doubt

    def know(self, sets: Bool) -> bool:
        """Return whether the unions of all these sets ``(G, L)`` can be asked for."""
        return bool(self._together[_together(sets)].all())

    def held(self, sets: Bool, group: I64, footprints: Footprints) -> Held:
        """Test sharp-cornered footprints ``(T,)`` against unions; a set of one lane is that lane,
        not grown.

        Args:
            sets: ``(G, L)`` sets of lanes.
            group: ``(T,)`` the set of each footprint.
            footprints: The bodies.
        """
        n_pieces = len(self._owner)
        grown = sets.sum(axis=1) > 1
        member = np.ascontiguousarray(sets.T)  # (L, G)
        border = member[self._owner]  # (P, G)
        for piece, lane in self._cover:
            border[piece] &= ~(member[lane] & grown)
        of_piece, of_set = pairs_of(border)
        order = np.argsort(of_set, kind="stable")
        of_set, of_piece = of_set[order], of_piece[order]
        first = np.searchsorted(of_set, np.arange(len(sets) + 1))
        begin, end = first[:-1][group], first[1:][group]  # of each footprint's pieces of border
        step, piece = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        for start in range(0, len(group), _AT_ONCE):
            some, index = spans(begin[start : start + _AT_ONCE], end[start : start + _AT_ONCE])
            some, index = some + start, of_piece[index]
            segment = np.where(grown[group[some]], index, index + n_pieces)
            pair = nearest_segments(
                footprints, some, self._segments, segment, ~self._doubtful[segment]
            )
            step, piece = np.concatenate([step, some[pair]]), np.concatenate([piece, segment[pair]])
        distance_m, depth_m = box_to_segments(footprints.take(step), self._segments[:, piece])
        sure = ~self._doubtful[piece]
        gap_m, doubt_m = np.full(len(group), np.inf), np.full(len(group), np.inf)
        np.minimum.at(gap_m, step[sure], distance_m[sure])
        np.minimum.at(doubt_m, step[~sure], distance_m[~sure])
        crossed = np.zeros(len(group), dtype=np.bool_)
        crossed[step[sure & (depth_m >= CROSSED_M)]] = True
        clear = (gap_m >= SURE_M) & (doubt_m >= gap_m - AGREE_M)
        return Held(
            crossed,
            np.where(crossed, 0.0, gap_m),
            (crossed | clear | ~grown[group]) & (end > begin),
        )

    def _covers(self, edges: _Edges, of: I64, met: Bool, shared: Bool, by: Bool) -> tuple[I64, I64]:
        """Return pairs ``(C,)`` of piece and body: the piece lies inside the grown body; marks the
        pieces that may or may not.
        """
        x, y = (self._grown[:2] + self._grown[2:]) / 2
        low_x, low_y, high_x, high_y = shapely.bounds(self._parts).T + 6 * self._grow_m * np.array(
            [[-1], [-1], [1], [1]]
        )
        a, b = pairs_of(met)
        first = np.searchsorted(a, np.arange(len(met) + 1))
        own = edges.body[of]
        piece, at = spans(first[own], first[own + 1])
        body = b[at]
        px = x[piece]
        py = y[piece]
        beside = (
            (px >= low_x[body])
            & (px <= high_x[body])
            & (py >= low_y[body])
            & (py <= high_y[body])
            & ~shared[of[piece], body]
        )
        piece, body = piece[beside], body[beside]
        plain = ~np.bincount(edges.body, edges.doubtful, len(self._parts)).astype(
            np.bool_
        )  # bodies that could be grown
        shapes, rings = self._parts.copy(), np.full(len(plain), None, dtype=object)
        mine = plain[edges.body]
        if plain.any():
            _, of_ring = np.unique(edges.body[mine], return_inverse=True)
            rings[plain] = shapely.linearrings(edges.grown[:2, mine].T, indices=of_ring)
            shapes[plain] = shapely.polygons(rings[plain])
            shapely.prepare(shapes)
            shapely.prepare(rings)
        inside = shapely.contains_xy(shapes[body], x[piece], y[piece])
        self._doubtful[piece[~inside & ~plain[body] & by[of[piece], body]]] = True
        beside = np.flatnonzero(by[of[piece], body] & plain[body])
        points = shapely.points(x[piece[beside]], y[piece[beside]])
        exact_m = 1e-10 + 256 * np.spacing(np.abs(self._grown).max(initial=1.0))
        beside = beside[shapely.dwithin(rings[body[beside]], points, exact_m)]
        if len(beside):  # on the other's border, up to rounding
            against = _against(edges, body[beside], self._grown[:, piece[beside]])
            inside[beside] = False
            self._doubtful[piece[beside[against]]] = True
        whole = pairs_of(shared[of])
        return np.concatenate([whole[0], piece[inside]]), np.concatenate([whole[1], body[inside]])


def _together(sets: Bool) -> Bool:
    """Return which pairs of lanes ``(L, L)`` are in a common set, each with itself among them."""
    of, lane = pairs_of(sets)
    first = np.searchsorted(of, np.arange(len(sets) + 1))
    row, member = spans(first[of], first[of + 1])
    out = np.zeros((sets.shape[1], sets.shape[1]), dtype=np.bool_)
    out[lane[row], lane[member]] = True
    return out


def _edges(parts: Geometries, grow_m: float) -> _Edges:
    """Return the edges of polygons ``(B,)`` that lie on the left of their rings, with their grown
    counterparts.

    A vertex moves to where its two edges meet when each is moved outwards. The tips of sharp
    corners are cut off.
    """
    rings, body = shapely.get_rings(parts, return_index=True)
    at, ring = shapely.get_coordinates(rings, return_index=True)
    fresh = np.ones(len(at), dtype=np.bool_)
    fresh[1:] = (ring[1:] != ring[:-1]) | (at[1:] != at[:-1]).any(axis=1)
    at, ring = at[fresh], ring[fresh]
    edge = np.flatnonzero(ring[1:] == ring[:-1])  # the closing vertex starts none
    start = at[edge]
    end = at[edge + 1]
    ring = ring[edge]
    along = end - start
    length = np.hypot(along[:, 0], along[:, 1])
    normal_x, normal_y = along[:, 1] / length, -along[:, 0] / length
    first = np.searchsorted(ring, np.arange(len(rings)))
    before = np.arange(len(ring)) - 1
    before[first] = np.concatenate([first[1:], [len(ring)]]) - 1
    halved = np.maximum(1.0 + normal_x * normal_x[before] + normal_y * normal_y[before], 1e-12)
    # Along each of the two edges at a vertex, from the vertex to where the moved edges meet.
    reach = grow_m * (normal_x[before] * normal_y - normal_y[before] * normal_x) / halved
    spike = reach > MITRE * grow_m
    reach = np.minimum(reach, MITRE * grow_m)
    after = np.empty_like(before)
    after[before] = np.arange(len(before))
    way_x, way_y = along[:, 0] / length, along[:, 1] / length
    raw = np.concatenate([start, end], axis=1).T
    back, ahead = -reach, reach[after]
    outward = grow_m * np.stack([normal_x, normal_y, normal_x, normal_y])
    grown = raw + outward + np.stack([back * way_x, back * way_y, ahead * way_x, ahead * way_y])
    reach = np.abs(reach)
    n_rings = np.bincount(body, minlength=len(parts))
    # Rings of one polygon may touch, and cover each other when grown.
    doubtful = (np.maximum(reach, reach[after]) > 0.25 * length) | (n_rings[body[ring]] > 1)
    owner = body[ring]
    if spike.any():  # an edge more, across the blunt tip
        tip = np.flatnonzero(spike)
        raw = np.concatenate([raw, raw[:, tip][[0, 1, 0, 1]]], axis=1)
        grown = np.concatenate(
            [grown, np.concatenate([grown[2:, before[tip]], grown[:2, tip]])], axis=1
        )
        order = np.argsort(np.concatenate([np.arange(len(owner)), tip - 0.5]))
        raw, grown = raw[:, order], grown[:, order]
        owner, doubtful = (
            np.concatenate([owner, owner[tip]])[order],
            np.concatenate([doubtful, doubtful[tip]])[order],
        )
    return _Edges(raw, grown, owner, doubtful)


def _shared(edges: _Edges) -> tuple[I64, I64]:
    """Return pairs of edge and body where the body has the very same edge the other way round, and
    so lies on its other side.
    """
    x0, y0, x1, y1 = edges.raw
    turned = (x0 > x1) | ((x0 == x1) & (y0 > y1))
    key = np.where(turned, edges.raw[[2, 3, 0, 1]], edges.raw)
    # Equal edges have equal sums; that others might too is checked below.
    order = np.argsort(
        key[0] + np.pi * key[1] + np.e * key[2] + np.sqrt(2.0) * key[3], kind="stable"
    )
    key = key[:, order]
    edge, other = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for apart in range(1, key.shape[1]):
        same = np.flatnonzero((key[:, apart:] == key[:, :-apart]).all(axis=0))
        if not len(same):
            break
        a, b = order[same], order[same + apart]
        opposite = (turned[a] != turned[b]) & (edges.body[a] != edges.body[b])
        edge += [a[opposite], b[opposite]]
        other += [edges.body[b[opposite]], edges.body[a[opposite]]]
    return np.concatenate(edge), np.concatenate(other)


def _cut(edges: _Edges, met: Bool, shared: Bool, slack_m: float) -> tuple[I64, F64, F64, Bool]:
    """Cut grown edges where they cross those of other bodies.

    Returns:
        Of each piece the edge and the shares of it where it begins and ends; and ``(E, B)`` whether
        an edge may come within ``slack_m`` of the ring of a body.
    """
    x0, y0, x1, y1 = edges.grown
    low_x = np.minimum(x0, x1)
    low_y = np.minimum(y0, y1)
    high_x = np.maximum(x0, x1)
    high_y = np.maximum(y0, y1)
    corners = np.stack(
        [low_x - slack_m, low_y - slack_m, high_x + slack_m, high_y + slack_m], axis=1
    )
    boxes = shapely.linestrings(
        corners.reshape(-1, 2, 2)
    )  # diagonals: the tree looks at bounds only, and lines are quicker to build
    e, f = shapely.STRtree(boxes).query(boxes)
    other = edges.body[f]
    wanted = met[edges.body[e], other] & ~shared[e, other]
    e, f = e[wanted], f[wanted]
    by = np.zeros_like(shared)
    by[e, edges.body[f]] = True
    along_x, along_y = x1 - x0, y1 - y0
    length = np.hypot(along_x, along_y)
    cross = along_x[e] * along_y[f] - along_y[e] * along_x[f]
    # Parallel edges need no cut of their own: where one ends, its neighbour in the ring makes it. A
    # cut too many does no harm.
    slant = np.abs(cross) > 1e-12 * length[e] * length[f]
    e = e[slant]
    f = f[slant]
    cross = cross[slant]
    to_x, to_y = x0[f] - x0[e], y0[f] - y0[e]
    t = (to_x * along_y[f] - to_y * along_x[f]) / cross
    u = (to_x * along_y[e] - to_y * along_x[e]) / cross
    slack = 1e-6 / length[f]
    hit = (t > 0) & (t < 1) & (u >= -slack) & (u <= 1 + slack)
    n = len(edges.body)
    edge, begin = np.concatenate([np.arange(n), e[hit]]), np.concatenate([np.zeros(n), t[hit]])
    order = np.lexsort((begin, edge))
    edge, begin = edge[order], begin[order]
    final = np.concatenate([edge[1:] != edge[:-1], [True]])
    return edge, begin, np.where(final, 1.0, np.concatenate([begin[1:], [1.0]])), by


def _stretch(edge: F64, begin: F64, end: F64) -> F64:
    """Return the parts ``(4, M)`` of edges ``(4, M)`` between two shares of their length."""
    x0, y0, x1, y1 = edge
    return np.stack(
        [x0 + begin * (x1 - x0), y0 + begin * (y1 - y0), x0 + end * (x1 - x0), y0 + end * (y1 - y0)]
    )


def _against(edges: _Edges, body: I64, piece: F64) -> Bool:
    """Return which pieces ``(4, M)``, whose middles are on the borders of bodies ``(M,)``, have
    their area on the other side than the body.

    Where both have it on the same side, both are the border. Where not, they may or may not close
    the seam between them.
    """
    first = np.searchsorted(edges.body, np.arange(edges.body[-1] + 2))
    row, edge = spans(first[body], first[body + 1])
    begin = np.searchsorted(row, np.arange(len(body)))
    x, y = ((piece[:2] + piece[2:]) / 2)[:, row]
    x0, y0, x1, y1 = edges.grown[:, edge]
    along_x = x1 - x0
    along_y = y1 - y0
    to_x = x - x0
    to_y = y - y0
    f = np.clip((to_x * along_x + to_y * along_y) / (along_x**2 + along_y**2), 0.0, 1.0)
    away = np.hypot(to_x - f * along_x, to_y - f * along_y)
    nearest = edge[np.lexsort((away, row))[begin]]
    (ax, ay), (bx, by) = (one[2:] - one[:2] for one in (piece, edges.grown[:, nearest]))
    return np.asarray(ax * bx + ay * by < 0.99 * np.hypot(ax, ay) * np.hypot(bx, by))
