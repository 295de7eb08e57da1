"""Where a line passes traffic lights and lines to give way at, and how far a driver may go before
one that is red, or at which others come.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from alpasim_plugin.core.lights_passed import passings
from alpasim_plugin.core.types import F64, Bool, Lane, Signal
from alpasim_plugin.world.idm import LEVEL_M, Bodies
from alpasim_plugin.world.path import Path
from alpasim_plugin.world.precedence import LATERAL_M, MOVING_MPS, WayIn, ways_in

STOP_BRAKE_MPS2 = 3.0  # who would have to brake harder for a yellow light drives on
SEEN_M = 30.0  # others are looked for from so far before a line to give way at
CROSSED_M = 30.0  # behind the line
CROSSED_S = np.arange(0.0, 4.1, 0.5)  # ahead in time
SLOPE = 0.1  # a street that leads to the own way may rise or fall by this much a metre
ALONG = 0.7  # cosine between the own way and those who drive along it ahead, who are followed


@dataclass(frozen=True)
class LightAhead:
    """A traffic light and the arc length at which a path passes its line.

    Attributes:
        s_m: Where the path passes the line.
        signal: The light, or the line to give way at.
        lanes: The map's lanes.
    """

    s_m: float
    signal: Signal
    lanes: Mapping[str, Lane]

    @cached_property
    def ways_in(self) -> tuple[WayIn, ...]:
        """Give the ways of those who go first at a line that names their lanes."""
        return ways_in(self.signal, self.lanes)


def lights_on(
    path: Path, signals: Sequence[Signal] | None, lanes: Mapping[str, Lane]
) -> tuple[LightAhead, ...]:
    """Return the lights for vehicles that hold the lanes which a path follows, in its order.

    Args:
        path: Where somebody drives.
        signals: Lights, or lines to give way at.
        lanes: The map's lanes.
    """
    lights = [
        LightAhead(passing.s_m, passing.signal, lanes)
        for passing in passings(path.xyz, signals or (), lanes, np.zeros(3))
    ]
    return tuple(sorted(lights, key=lambda light: light.s_m))


def red_gap_m(lights: Sequence[LightAhead], front_s_m: float, speed_mps: float, t_us: int) -> float:
    """Return the distance from the front bumper to the nearest line at which a driver has to stop;
    infinite without one.

    A yellow light is one to stop at where `STOP_BRAKE_MPS2` is enough for it.
    """
    for light in lights:
        gap_m = light.s_m - front_s_m
        if gap_m < 0.0:
            continue
        colour = light.signal.colour_at(t_us)
        stoppable = speed_mps**2 <= 2.0 * STOP_BRAKE_MPS2 * gap_m
        if colour in ("red", "red_yellow") or (colour == "yellow" and stoppable):
            return gap_m
    return float("inf")


def give_way_gap_m(
    lines: Sequence[LightAhead], path: Path, front_s_m: float, bodies: Bodies, row: int
) -> float:
    """Return the distance from the front bumper to the nearest line at which others are to be let
    pass; infinite without one.

    Where the line names the lanes that go first, those count who are on them or come to them; see
    `WayIn`. At other lines others come if, straight on at the speed that they have, they will be on the
    way behind the line. Who drives along the own way, before the line or behind it, does not count, nor
    who is on a bridge above it or on a road below.

    Args:
        lines: On the path, in its order.
        path: The driver's way.
        front_s_m: Arc length of the front bumper.
        bodies: Everybody.
        row: The driver's row among them, -1: none.
    """
    for line in lines:
        gap_m = line.s_m - front_s_m
        if not 0.0 <= gap_m <= SEEN_M:
            continue
        crossed, _ = path.at(np.arange(line.s_m + 1.0, line.s_m + CROSSED_M, 1.0))
        others = np.arange(len(bodies.xy)) != row
        if line.signal.yields_to:
            comes = any(way.is_used(crossed, bodies, others) for way in line.ways_in)
        else:
            comes = _anybody_comes(crossed, path, bodies, others)
        if comes:
            return gap_m
    return float("inf")


def _anybody_comes(crossed: F64, path: Path, bodies: Bodies, counts: Bool) -> bool:
    """Return whether anybody who counts will, straight on at its speed, be on a driver's way.

    Args:
        crossed: ``(N, 3)`` places of the way behind the line.
        path: The way.
        bodies: Everybody.
        counts: ``(K,)`` which of them may count.
    """
    s_m, offset_m = path.project(bodies.xy)
    beside, way_yaw = path.at(s_m)
    turned_rad = bodies.yaw - way_yaw
    counts = counts & ((np.cos(turned_rad) < ALONG) | (np.abs(offset_m) > LATERAL_M))
    counts &= np.linalg.norm(bodies.velocity, axis=1) > MOVING_MPS
    rise_m = np.abs(bodies.z - beside[:, 2])  # NaN where a height is not known
    counts &= ~(rise_m > bodies.half_height_m + LEVEL_M + SLOPE * np.abs(offset_m))
    ahead = bodies.velocity[counts, None] * CROSSED_S[:, None]
    places = bodies.xy[counts, None] + ahead  # (K, T, 2)
    apart = places[:, :, None] - crossed[:, :2]  # (K, T, N, 2)
    return bool((np.hypot(apart[..., 0], apart[..., 1]) < LATERAL_M).any())
