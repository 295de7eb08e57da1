"""Who comes along lanes that go first, at a line to give way at which names them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F64, Bool, Lane, Signal
from alpasim_plugin.world.idm import LEVEL_M, Bodies
from alpasim_plugin.world.path import Path, polyline_path

LATERAL_M = 2.5  # who comes nearer to the own way is let pass
MOVING_MPS = 0.5
APPROACH_M = 60.0  # others are looked for so far before the lane that goes first
COMES_S = 5.0  # who will be where the ways meet within this time is let pass
ON_LANE_M = 2.0  # from its middle
SAME_WAY = 0.7  # cosine between a lane and those who drive along it
WAITS_M = 4.0  # who stands no farther before a lane waits to drive into it
STATION_M = 1.0
MOST_WAYS = 16  # to one lane; where streets branch as much, the farther ones are left out


@dataclass(frozen=True)
class WayIn:
    """A way on which others come who go first: a lane, and one that leads to it.

    Attributes:
        path: The way.
        lane_m: Where its last lane begins.
        counts_waiting: Whether who stands before that lane goes first too.
    """

    path: Path
    lane_m: float
    counts_waiting: bool

    def is_used(self, crossed: F64, bodies: Bodies, counts: Bool) -> bool:
        """Return whether somebody is on the lane, or will be where the ways meet within `COMES_S`.

        Args:
            crossed: ``(N, 3)`` places of the driver's way behind the line, metres.
            bodies: Everybody.
            counts: ``(K,)`` which of them may count.
        """
        met = self._met_m(crossed)
        if met is None or not counts.any():
            return False
        meet_m, over_m = met
        s_m, offset_m = self.path.project(bodies.xy)
        xyz, yaw = self.path.at(s_m)
        is_on = counts & (np.abs(offset_m) < ON_LANE_M) & (np.cos(bodies.yaw - yaw) > SAME_WAY)
        is_on &= ~(np.abs(bodies.z - xyz[:, 2]) > bodies.half_height_m + LEVEL_M)
        is_on &= s_m - bodies.half_length_m < over_m
        front_m = s_m + bodies.half_length_m
        speed_mps = np.hypot(*bodies.velocity.T)
        moves = speed_mps > MOVING_MPS
        comes = moves & (front_m + COMES_S * speed_mps > meet_m)
        waits = ~moves & (front_m > self.lane_m - WAITS_M) & self.counts_waiting
        return bool((is_on & (comes | waits)).any())

    def _met_m(self, crossed: F64) -> tuple[float, float] | None:
        """Return where the last lane begins and ends to be near to a driver's way; None where it is
        nowhere.
        """
        after = self.path.s >= self.lane_m
        apart_m = scipy.spatial.distance.cdist(self.path.xyz[after], crossed).min(axis=1)
        near_m = self.path.s[after][apart_m < LATERAL_M]
        return (float(near_m[0]), float(near_m[-1])) if len(near_m) else None


def ways_in(signal: Signal, lanes: Mapping[str, Lane]) -> tuple[WayIn, ...]:
    """Return the ways of those who go first at a line.

    Args:
        signal: The line.
        lanes: The map's lanes; some of those that the line names may not be among them.
    """
    before = lanes_before(lanes)
    out = []
    for key in signal.yields_to:
        if key not in lanes:
            continue
        lane_m = float(arc_lengths(lanes[key].centre[:, :2])[-1])
        for chain in chains_to(key, lanes, before, APPROACH_M):
            line = np.concatenate([lanes[name].centre for name in chain])
            length_m = float(arc_lengths(line[:, :2])[-1])
            stations = np.append(np.arange(0.0, length_m, STATION_M), length_m)
            path = polyline_path(resample(line, stations, arc_lengths(line[:, :2])))
            begin_m = max(path.length_m - lane_m, 0.0)
            out.append(WayIn(path, begin_m, key in signal.yields_to_waiting))
    return tuple(out)


def lanes_before(lanes: Mapping[str, Lane]) -> dict[str, list[str]]:
    """Return the lanes that lead to each lane."""
    before: dict[str, list[str]] = {key: [] for key in lanes}
    for key, lane in lanes.items():
        for after in lane.successors:
            if after in before:
                before[after].append(key)
    return before


def chains_to(
    key: str, lanes: Mapping[str, Lane], before: Mapping[str, list[str]], least_m: float
) -> list[tuple[str, ...]]:
    """Return the chains of lanes that end with a lane, as long as ``least_m`` before it where lanes
    lead there.
    """
    finished: list[tuple[str, ...]] = []
    growing: list[tuple[float, tuple[str, ...]]] = [(0.0, (key,))]
    while growing and len(finished) < MOST_WAYS:
        length_m, chain = growing.pop(0)
        leading = [name for name in before[chain[0]] if name not in chain]
        if length_m >= least_m or not leading:
            finished.append(chain)
            continue
        for name in leading:
            longer_m = length_m + float(arc_lengths(lanes[name].centre[:, :2])[-1])
            growing.append((longer_m, (name, *chain)))
    return finished
