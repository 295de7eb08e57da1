"""Which lane markings of the roads through a junction are painted.

Maps give the edges of every way through a junction a marking, as on a road of its own. On a street a
line ends where other traffic drives over it. Lines that nobody else drives over stay, such as those
along the carriageway of a motorway beside a ramp.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import shapely

from alpasim_plugin.core.lane_areas import distance_and_rise, lane_polygon
from alpasim_plugin.core.types import F64, Lane, LaneMarkType
from alpasim_plugin.world.route import LEVEL_M

INSIDE_M = 0.3  # a line that runs so near to the edge of a lane lies on that edge
CROSSED_M = 0.5  # length of a line inside of another lane from which on it is crossed

Side = tuple[str, str]  # a lane, and "left" or "right"


def with_open_junctions(
    lanes: Mapping[str, Lane], junctions: Mapping[str, str], guides: Collection[Side]
) -> dict[str, Lane]:
    """Return lanes without the markings over which other lanes of their junction lead.

    Args:
        lanes: The lanes of a map.
        junctions: Lane to its junction, of those in junctions.
        guides: Sides of lanes whose line the map declares as one that leads through the junction.
    """
    members: dict[str, list[str]] = defaultdict(list)
    for key, junction in junctions.items():
        members[junction].append(key)
    out = dict(lanes)
    for keys in members.values():
        insides = [shapely.buffer(lane_polygon(lanes[key]), -INSIDE_M) for key in keys]
        tree = shapely.STRtree(insides)
        centres = [lanes[key].centre for key in keys]
        for key in keys:
            lane = lanes[key]
            left = _painted(lane.left_mark_type, lane.left, (key, "left"), guides, tree, centres)
            right = _painted(
                lane.right_mark_type, lane.right, (key, "right"), guides, tree, centres
            )
            out[key] = replace(lane, left_mark_type=left, right_mark_type=right)
    return out


def _painted(
    mark_type: LaneMarkType,
    edge: F64 | None,
    side: Side,
    guides: Collection[Side],
    insides: shapely.STRtree,
    centres: Sequence[F64],
) -> LaneMarkType:
    """Return the marking of an edge ``(N, 3)``: none where lanes lead over it at its height."""
    if edge is None or mark_type == "none" or side in guides:
        return mark_type
    line: Any = shapely.linestrings(edge)
    rows = insides.query(line, predicate="intersects")
    parts = shapely.intersection(line, insides.geometries.take(rows))
    for row, part in zip(rows.tolist(), parts, strict=True):
        if shapely.length(part) > CROSSED_M:
            middle = shapely.get_coordinates(part, include_z=True).mean(axis=0)
            if distance_and_rise(centres[row], middle[None])[1][0] <= LEVEL_M:
                return "none"
    return mark_type
