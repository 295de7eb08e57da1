"""Lines of lane maps: lanes' edges and order, and a map as AlpaSim's loader reads it.

AlpaSim's rules look for lane centres and road edges by vertex, so the places of vertices matter.
Its map tables hold two rails a lane with the same number of points, and nothing else of its shape:
the centre is halfway between the rails, point by point. So a lane's own centre line is not used
where it has both rails, and rails with different numbers of points get points added on their own
segments, which leaves the lane's area as it is. The view so made is the form in which scenes are
exported and in which preset ``alpasim`` scores.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.geometry import arc_lengths, left_of, matrix_from_quat, unit
from alpasim_plugin.core.lane_areas import HALF_WIDTH_M
from alpasim_plugin.core.types import F64, HeightField, Lane, LaneMap, Trajectory
from alpasim_plugin.world.ground import flat, from_points, height_at
from alpasim_plugin.world.path import polyline_path, thinned
from scenarios.map_borders import lane_borders, lane_edges

MAX_STEP_M = 2.0

# Every other kind counts: without shoulders the distance to the lane boundary is half a metre off.
NO_LANES_OF_CARS = ("sidewalk",)
MEET_M = 0.1  # linked lanes whose ends lie farther apart do not meet

# Of the corridor.
LANE_M = 3.5  # width
BEFORE_M = 8.0  # how far it goes on before the path
BEYOND_M = 15.0  # how far it goes on beyond the path
VERTEX_M = 1.0  # between vertices


def ground_of(lane_map: LaneMap, drive: F64) -> HeightField:
    """Return the ground under a map: level where its lanes are at height 0, else fitted to their
    edges around a drive ``(T, 3)``.
    """
    points = np.concatenate(lane_edges(lane_map.lanes))
    if np.ptp(points[:, 2]) == 0 and points[0, 2] == 0:
        return flat(0.0)
    return from_points(points, drive=drive)


def bordered(lanes: Mapping[str, Lane], beside: LaneMap) -> LaneMap:
    """Return a map with lanes and the border of their surface added."""
    return replace(beside, lanes=lanes, road_edges=lane_borders(lanes))


def corridor(ego: Trajectory, field: HeightField) -> LaneMap:
    """Return the driven path as one lane of usual width, without markings: nothing says where lines
    were.
    """
    line = ego.xyz[thinned(ego.xyz, 0.5), :2]
    if len(line) == 1:
        line = np.stack([line[0], line[0] + matrix_from_quat(ego.quat[0])[:2, 0]])
    first = line[1] - line[0]
    last = line[-1] - line[-2]
    before = line[0] - unit(first) * BEFORE_M
    beyond = line[-1] + unit(last) * BEYOND_M
    path = polyline_path(np.concatenate([[before], line, [beyond]]))
    s = np.linspace(0.0, path.length_m, max(2, int(path.length_m / VERTEX_M) + 1))
    centre, left, right = (
        laid(path.at(s, side * LANE_M / 2)[0], field) for side in (0.0, 1.0, -1.0)
    )
    lane = Lane("corridor", centre, left, right, left_mark_type="none", right_mark_type="none")
    return LaneMap({"corridor": lane})


def laid(line: F64, field: HeightField) -> F64:
    """Return a line ``(N, 2+)`` on the ground ``(N, 3)``."""
    return np.column_stack([line[:, :2], height_at(field, line)])


def predecessors(lanes: Mapping[str, Lane]) -> dict[str, list[str]]:
    """Return the lanes that each lane of a map follows."""
    before: dict[str, list[str]] = {key: [] for key in lanes}
    for key, lane in lanes.items():
        for successor in lane.successors:
            if successor in before:
                before[successor].append(key)
    return before


def gaps_m(lanes: Mapping[str, Lane]) -> dict[tuple[str, str], float]:
    """Return how far the ends of linked lanes lie apart, metres: the larger distance of the two
    edges, of lanes without edges that of their centres.
    """
    gaps = {}
    for key, lane in lanes.items():
        for successor in lane.successors:
            if successor in lanes:
                lines = zip(_ending_lines(lane), _ending_lines(lanes[successor]), strict=True)
                away = [np.linalg.norm(before[-1] - after[0]) for before, after in lines]
                gaps[key, successor] = float(max(away))
    return gaps


def link_notes(lanes: Mapping[str, Lane]) -> tuple[str, ...]:
    """Return a note that names the linked lanes which do not meet, the widest gap first; nothing
    where all do.
    """
    gaps = {link: gap for link, gap in gaps_m(lanes).items() if gap > MEET_M}
    if not gaps:
        return ()
    widest_first = sorted(gaps, key=lambda link: (-gaps[link], link))
    listed = some_of(
        [
            f"{lane_id} to {other_id} ({gaps[lane_id, other_id]:.2f} m)"
            for lane_id, other_id in widest_first
        ]
    )
    return (f"{len(gaps)} links join lanes that lie more than {MEET_M:g} m apart: {listed}",)


def _ending_lines(lane: Lane) -> tuple[F64, F64]:
    """Return the lines of a lane that meet those of a linked one."""
    if lane.left is None or lane.right is None:
        return lane.centre, lane.centre
    return lane.left, lane.right


def same_way(lane: Lane, lanes: Mapping[str, Lane], name: str | None) -> str | None:
    """Return the name of a neighbour; None for one that is not there, or is driven the other way."""
    if name is None or name not in lanes:
        return None
    neighbour = lanes[name]
    direction = (lane.centre[-1] - lane.centre[0])[:2]
    neighbour_direction = (neighbour.centre[-1] - neighbour.centre[0])[:2]
    return name if direction @ neighbour_direction > 0 else None


def is_left_of(line: F64, other: F64) -> bool:
    """Return whether ``line`` ``(N, 2+)`` runs on the left of ``other``.

    The ring of ``line`` and the reversed ``other`` is clockwise then.
    """
    x, y = np.concatenate([line[:, :2], other[::-1, :2]]).T
    return bool(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) < 0)


def with_vertices(line: F64) -> F64:
    """Put ``floor(length / 2 m)`` equally spaced points into every segment of a polyline ``(N,
    3)``; lengths are measured in 3-D.

    Unlike `alpasim_plugin.core.geometry.densify` it also splits a segment of exactly 2 m. Vertices
    stay as they are, and a new point is ``start + step * k`` with ``step = segment / pieces``,
    rounded in that order: neighbouring lanes share edges but not vertices, and rounding decides
    whether their union has a crack there, which a distance to its border sees.
    """
    segments = np.diff(line, axis=0)
    pieces = (np.linalg.norm(segments, axis=1) // MAX_STEP_M).astype(np.int64) + 1
    if not len(pieces) or int(pieces.max()) == 1:
        return line
    segment = np.repeat(np.arange(len(pieces)), pieces)
    nth = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 1
    points = line[segment] + (segments / pieces[:, None])[segment] * nth[:, None]
    points[nth == pieces[segment]] = line[1:]
    return np.concatenate([line[:1], points])


def alpasim_view(lane_map: LaneMap) -> LaneMap:
    """Return a map as AlpaSim's loader would give it after `scenarios.usdz_tables` has written
    it.
    """
    kept = {key: lane for key, lane in lane_map.lanes.items() if lane.kind not in NO_LANES_OF_CARS}
    lanes = {}
    for key, lane in kept.items():
        left, right = rails(lane)
        lanes[key] = replace(
            lane,
            centre=with_vertices((left + right) / 2),
            left=with_vertices(left),
            right=with_vertices(right),
            successors=tuple(s for s in lane.successors if s in kept),
            left_neighbour=lane.left_neighbour if lane.left_neighbour in kept else None,
            right_neighbour=lane.right_neighbour if lane.right_neighbour in kept else None,
        )
    return replace(
        lane_map,
        lanes=lanes,
        road_edges=tuple(with_vertices(edge) for edge in lane_map.road_edges if len(edge) > 1),
    )


def rails(lane: Lane) -> tuple[F64, F64]:
    """Return the left and the right rail ``(N, 3)`` of a lane, in driving direction, with the same
    number of points.

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
    return np.column_stack([np.interp(wanted, shares, line[:, axis]) for axis in range(3)])


def _shares(line: F64) -> F64:
    """Return how far along a polyline ``(N, 3)`` each vertex lies, 0..1 of its length in the
    plane.
    """
    s = arc_lengths(line[:, :2])
    return s / s[-1] if s[-1] > 0 else np.linspace(0.0, 1.0, len(line))


def _beside(centre: F64, left_m: float) -> F64:
    """Return a polyline ``(N, 3)`` shifted to the left by the mean of the normals of its adjoining
    segments.
    """
    along = np.gradient(centre[:, :2], axis=0)
    along = unit(along)
    out = centre.copy()
    out[:, :2] += left_m * left_of(along)
    return out
