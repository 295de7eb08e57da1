"""Where the posts of traffic lights stand: beside the carriageway. Lamps that the map has over lanes
hang there from a mast.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.lane_areas import distance_and_rise, lane_polygon
from alpasim_plugin.core.types import F64, Lane

BESIDE_M = 0.6  # of a post from the carriageway
LOWEST_M = 3.0  # of the middle of the lamps above the ground, beside lanes ...
LOWEST_OVER_LANES_M = 5.5  # ... and over them
ARM_M = 0.8  # of a mast above the middle of the lamps
SHORTEST_ARM_M = 1.5  # a post that would need a shorter one stands beside the lanes with its lamps
AROUND_M = 40.0  # lanes in this distance make the carriageway
LEVEL_M = 4.0  # lanes that are farther away in height belong to another road
SEAM_M = 1.5  # gaps between lanes narrower than twice this are part of the carriageway


@dataclass(frozen=True)
class Post:
    """The post of a traffic light.

    Attributes:
        line: ``(N, 3)`` metres, world: from its foot to its top; a mast goes on to the lamps.
        lamps: ``(3,)`` metres, world: the middle of the lamps.
    """

    line: F64
    lamps: F64


class Carriageway:
    """The surface of lanes, looked up around a place.

    Args:
        lanes: All lanes of a map.
    """

    def __init__(self, lanes: Mapping[str, Lane]) -> None:
        self._lanes = tuple(lanes.values())

    @cached_property
    def _areas(self) -> shapely.STRtree:
        return shapely.STRtree([lane_polygon(lane) for lane in self._lanes])

    def around(self, place: F64) -> Any:
        """Return the carriageway around a place ``(3,)`` on its level as a shapely area."""
        rows = self._areas.query(shapely.points(place[:2]), predicate="dwithin", distance=AROUND_M)
        rises_m = [
            float(distance_and_rise(self._lanes[row].centre, place[None])[1][0])
            for row in rows.tolist()
        ]
        on_level = np.array(rises_m) < LEVEL_M
        area = shapely.union_all(self._areas.geometries[rows[on_level]])
        return shapely.buffer(shapely.buffer(area, SEAM_M), -SEAM_M)

    def post(self, foot: F64, lamps_m: float) -> Post:
        """Return the post of a light.

        Args:
            foot: ``(3,)`` where the map has it, metres, world.
            lamps_m: Height of the middle of its lamps above that place, as the map has it.
        """
        area = self.around(foot)
        place = shapely.points(foot[:2])
        if shapely.is_empty(area) or float(shapely.distance(area, place)) >= BESIDE_M / 2:
            return _upright(foot, lamps_m)
        beside = foot.copy()
        beside[:2] = _beside(area, foot[:2])
        if np.linalg.norm(beside - foot) < SHORTEST_ARM_M:
            return _upright(beside, lamps_m)
        lamps = foot.copy()
        lamps[2] += max(lamps_m, LOWEST_OVER_LANES_M)
        arm = np.array([0.0, 0.0, lamps[2] + ARM_M - foot[2]])
        return Post(np.stack([beside, beside + arm, foot + arm, lamps]), lamps)


def _upright(foot: F64, lamps_m: float) -> Post:
    """Return a post whose lamps sit on its top."""
    lamps = foot.copy()
    lamps[2] += max(lamps_m, LOWEST_M)
    return Post(np.stack([foot, lamps]), lamps)


def _beside(area: Any, place: F64) -> F64:
    """Return the place ``(2,)`` beside an area that is nearest to a place ``(2,)`` in it or at its
    border.
    """
    outside = shapely.boundary(shapely.buffer(area, BESIDE_M))
    nearest = shapely.line_interpolate_point(
        outside, shapely.line_locate_point(outside, shapely.points(place))
    )
    return np.asarray(shapely.get_coordinates(nearest)[0])
