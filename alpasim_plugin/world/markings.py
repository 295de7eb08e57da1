"""Which lines of a map are lane markings: one rule, which the built world, the semantic map
and the learned metrics share.

A line is a lane marking where the map says so: its marking lines, and the edges of lanes whose markings
it knows. A line that nobody has seen is not drawn. Where the road itself is built, its lane
markings are a choice, and `with_default_markings` makes it before anything is drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F64, I64, Lane, LaneMap, LaneMarkType

SAME_EDGE_M = 0.45  # edges of two lanes nearer than this are one edge
SAMPLE_M = 2.0
SHORTEST_M = 0.5
COVERED = 0.6  # share of an edge's samples beside which another edge runs
ALONG = 0.8  # cosine between two edges that run together


@dataclass(frozen=True)
class _Edge:
    """One edge of one lane in driving direction, or a marking line."""

    lane_id: str
    side: int  # +1 left, -1 right, 0 a marking line
    line: F64  # (N, 3) metres, world
    mark_type: LaneMarkType
    in_junction: bool


class _Edges:
    """All edges of a map, with samples along them; ends are left out, for there other lanes
    begin.
    """

    def __init__(self, lane_map: LaneMap) -> None:
        self.all = [
            edge
            for edge in _edges_of(lane_map)
            if len(edge.line) > 1 and arc_lengths(edge.line)[-1] > SHORTEST_M
        ]
        owner = [np.zeros(0, dtype=np.int64)]
        points = [np.zeros((0, 2))]
        headings = [np.zeros((0, 2))]
        for i, edge in enumerate(self.all):
            length = float(arc_lengths(edge.line)[-1])
            n = max(3, int(length / SAMPLE_M))
            s = (np.arange(n) + 0.5) / n * length
            a = resample(edge.line[:, :2], s - 0.1)
            b = resample(edge.line[:, :2], s + 0.1)
            owner.append(np.full(n, i))
            points.append((a + b) / 2)
            headings.append((b - a) / np.maximum(np.linalg.norm(b - a, axis=1), 1e-12)[:, None])
        self.owner: I64 = np.concatenate(owner)
        self.headings: F64 = np.concatenate(headings)
        samples = shapely.points(np.concatenate(points))
        sample, near = shapely.STRtree(samples).query(
            samples, predicate="dwithin", distance=SAME_EDGE_M
        )
        order = np.argsort(sample, kind="stable")
        self.near = np.split(
            near[order], np.searchsorted(sample[order], np.arange(1, len(samples)))
        )

    def beside(self, i: int) -> list[list[tuple[int, float]]]:
        """Return for every sample of edge ``i`` the other edges there, each with the cosine between
        the two headings.
        """
        return [
            [
                (int(self.owner[j]), float(self.headings[k] @ self.headings[j]))
                for j in self.near[k]
                if self.owner[j] != i
            ]
            for k in np.flatnonzero(self.owner == i)
        ]


def marking_lines(lane_map: LaneMap) -> list[tuple[F64, LaneMarkType]]:
    """Return the lane markings along lanes, each place once.

    Returns:
        Lines ``(N, 3)``, metres, world, with their kind of line, which is neither ``none`` nor
        ``unknown``: marking lines first, then lane edges; an edge along which an earlier line runs
        is left out.
    """
    edges = _Edges(lane_map)
    taken: set[int] = set()
    for i, edge in enumerate(edges.all):
        if edge.mark_type in ("none", "unknown"):
            continue
        samples = edges.beside(i)
        covered = np.mean(
            [any(j in taken and abs(cosine) > ALONG for j, cosine in here) for here in samples]
        )
        if covered <= COVERED:
            taken.add(i)
    return [(edges.all[i].line, edges.all[i].mark_type) for i in sorted(taken)]


def with_default_markings(
    lane_map: LaneMap, centre_line: LaneMarkType = "double_yellow"
) -> LaneMap:
    """Return a map whose unknown lane markings are chosen, for a road that is built from it.

    An edge shared by two lanes of one direction is a dashed white line, one between opposing lanes
    a ``centre_line``, an outer edge a solid white line; inside intersections there is none.
    In maps with marking lines of their own, lane edges of unknown markings stay as they are, and
    unknown marking lines are solid white.
    """
    if lane_map.markings:
        markings = tuple(
            replace(m, mark_type="solid_white") if m.mark_type == "unknown" else m
            for m in lane_map.markings
        )
        return replace(lane_map, markings=markings)
    edges = _Edges(lane_map)
    chosen: dict[tuple[str, int], LaneMarkType] = {}
    for i, edge in enumerate(edges.all):
        if edge.mark_type == "unknown":
            chosen[edge.lane_id, edge.side] = _default(edges, i, centre_line)
    lanes = {name: _marked(lane, chosen) for name, lane in lane_map.lanes.items()}
    return replace(lane_map, lanes=lanes)


def _default(edges: _Edges, i: int, centre_line: LaneMarkType) -> LaneMarkType:
    """Return the marking of an unknown edge: none inside intersections, that of a known one along it,
    else what its neighbours suggest.
    """
    if edges.all[i].in_junction:
        return "none"
    samples = edges.beside(i)
    marked = [edge.mark_type for edge in edges.all if edge.mark_type not in ("none", "unknown")]
    for mark_type in ("none", *dict.fromkeys(marked)):
        if _share_along(edges, samples, mark_type) > COVERED:
            return mark_type
    beside = [(edges.all[j], cosine) for neighbours in samples for j, cosine in neighbours]
    shared = sum(other.side == -edges.all[i].side and cosine > ALONG for other, cosine in beside)
    opposing = sum(other.side == edges.all[i].side and cosine < -ALONG for other, cosine in beside)
    if max(shared, opposing) < 0.4 * len(samples):
        return "solid_white"
    return "dashed_white" if shared >= opposing else centre_line


def _share_along(
    edges: _Edges, samples: Sequence[Sequence[tuple[int, float]]], mark_type: LaneMarkType
) -> float:
    """Return the share of an edge's samples along which an edge of a marking lies."""
    is_marked = [
        any(edges.all[j].mark_type == mark_type and abs(cosine) > ALONG for j, cosine in neighbours)
        for neighbours in samples
    ]
    return float(np.mean(is_marked))


def _edges_of(lane_map: LaneMap) -> list[_Edge]:
    out = [_Edge("", 0, marking.xyz, marking.mark_type, False) for marking in lane_map.markings]
    for lane in (lane_map.lanes[k] for k in sorted(lane_map.lanes)):
        for side, line, mark_type in (
            (1, lane.left, lane.left_mark_type),
            (-1, lane.right, lane.right_mark_type),
        ):
            if line is not None and lane.kind != "parking":
                out.append(_Edge(lane.lane_id, side, line, mark_type, lane.is_intersection))
    return out


def _marked(lane: Lane, chosen: dict[tuple[str, int], LaneMarkType]) -> Lane:
    left = chosen.get((lane.lane_id, 1), lane.left_mark_type)
    return replace(
        lane,
        left_mark_type=left,
        right_mark_type=chosen.get((lane.lane_id, -1), lane.right_mark_type),
    )
