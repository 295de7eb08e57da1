"""Who goes first where lights are green for both: whoever turns across oncoming traffic waits.

The rule is a line to give way at, beside the light, for the lane that turns.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.geometry import arc_lengths, heading_of, wrap_angle
from alpasim_plugin.core.types import Lane, Signal
from alpasim_plugin.world.ground import STACKED_M

MEET_M = 2.0  # middles of lanes that come nearer than this meet
ONCOMING_RAD = np.pi / 2  # between two approaches, at least
STRAIGHT_RAD = np.radians(30.0)  # a lane that turns less leads straight on


def turning_lines(lights: Sequence[Signal], lanes: Mapping[str, Lane]) -> tuple[Signal, ...]:
    """Return the lines at which those wait who turn across oncoming traffic that has green too.

    Of two lanes that meet, the one that turns gives way; of two that turn, the longer one.

    Args:
        lights: With their cycles.
        lanes: The map's lanes.
    """
    ways = [
        (light, key)
        for light in lights
        if not light.pedestrians
        for key in dict.fromkeys(through_junction(light, lanes))
    ]
    if not ways:
        return ()
    middles = [shapely.linestrings(lanes[key].centre) for _, key in ways]
    out: dict[str, Signal] = {}
    meetings = shapely.STRtree(middles).query(middles, "dwithin", MEET_M)
    for first, second in meetings.T.tolist():
        light, key = ways[first]
        other, other_key = ways[second]
        goes_second = detour(lanes[key], key) > detour(lanes[other_key], other_key)
        meet = is_level(middles[first], middles[second])
        if meet and goes_second and _oncoming(light, other) and green_together(light, other):
            out[key] = Signal(light.stop, light.heading_rad, (), name=light.name, lanes=(key,))
    return tuple(out.values())


def through_junction(light: Signal, lanes: Mapping[str, Lane]) -> list[str]:
    """Return the lanes of the junction behind the line of a light."""
    out: list[str] = []
    for key in (key for key in light.lanes if key in lanes):
        behind = [key] if lanes[key].is_intersection else lanes[key].successors
        out += [name for name in behind if name in lanes and lanes[name].is_intersection]
    return out


def detour(lane: Lane, key: str) -> tuple[bool, float, str]:
    """Return what orders lanes that meet: whether one turns, its length, and its name for a tie."""
    ends = heading_of(np.diff(lane.centre[[0, 1, -2, -1]], axis=0)[[0, 2]])
    turns = abs(float(wrap_angle(ends[1] - ends[0]))) > STRAIGHT_RAD
    return turns, float(arc_lengths(lane.centre)[-1]), key


def is_level(middle: Any, other: Any) -> bool:
    """Return whether lines in space are at one height where they are nearest in plan view."""
    ends = shapely.points(shapely.get_coordinates(shapely.shortest_line(middle, other)))
    lines = np.array([middle, other])
    places = shapely.line_interpolate_point(lines, shapely.line_locate_point(lines, ends))
    return float(np.ptp(shapely.get_z(places))) < STACKED_M


def _oncoming(light: Signal, other: Signal) -> bool:
    return abs(float(wrap_angle(light.heading_rad - other.heading_rad))) > ONCOMING_RAD


def green_together(light: Signal, other: Signal) -> bool:
    """Return whether some time both may be passed."""
    cycle_us = sum(lasts_us for _, lasts_us in light.phases)
    return any(
        "red" not in (light.colour_at(t_us), other.colour_at(t_us))
        for t_us in range(0, cycle_us, 500_000)
    )
