"""Which traffic lights and lines to give way at hold somebody who drives along a line: those of the
lanes that the line follows.

At one line stand the lights of several lanes, for instance one for each turn. All of these lanes
begin at the same place, so that where a line crosses says nothing; where it goes on to does.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.map_types import F64, Lane, Signal

AHEAD_M = 40.0  # a line is compared with lanes so far behind the place where it passes a light
STEP_M = 1.0
TIE_M = 0.3  # lanes that fit a line this nearly as well as the best one may be the driven one
TOGETHER_M = 5.0  # stop lines that are passed within this length are one place


@dataclass(frozen=True)
class Passing:
    """A line passes the stop line of a light.

    Attributes:
        vertex: Of the line, before the stop line.
        share: Of the way to the next vertex.
        s_m: Arc length along the line.
        signal: The light, or the line to give way at.
        lanes: Among the lanes that part there, those that the line may follow: several where it ends
            before they part. Empty where the signal names no lanes of the map.
    """

    vertex: int
    share: float
    s_m: float
    signal: Signal
    lanes: tuple[str, ...]


def passings(
    line: F64, signals: Iterable[Signal], lanes: Mapping[str, Lane], origin: F64
) -> list[Passing]:
    """Return where a line passes signals for vehicles that hold a lane that it may follow.

    Args:
        line: ``(N, 3)`` metres, relative to ``origin``.
        signals: Lights, or lines to give way at.
        lanes: The lanes of the map; a signal without lanes, or whose lanes are not among them, holds
            whoever passes it.
        origin: ``(3,)`` world point.
    """
    along = arc_lengths(line)
    out = []
    for signal in signals:
        if signal.pedestrians:
            continue
        for vertex, share in signal.crossings(line, origin):
            s_m = float(along[vertex] + share * (along[vertex + 1] - along[vertex]))
            held = [key for key in signal.lanes if key in lanes]
            stations = np.arange(s_m, min(s_m + AHEAD_M, float(along[-1])) + 1e-9, STEP_M)
            ahead = resample(line, stations, along)[:, :2] + origin[:2]
            followed = _followed(ahead, held, lanes)
            if not held or any(key in followed for key in held):
                out.append(Passing(vertex, share, s_m, signal, followed))
    return out


def passed_red(at_lines: Sequence[Passing], are_red: Sequence[bool]) -> list[Passing]:
    """Return the passings, among ``at_lines``, of lights that are red for whoever drives there.

    A line that may follow several lanes passes red only where each of them has a red light at this
    place.
    """
    red = [passing for passing, is_red in zip(at_lines, are_red, strict=True) if is_red]
    out = []
    for passing in red:
        held: set[str] = set()
        for other in red:
            if abs(other.s_m - passing.s_m) <= TOGETHER_M:
                held |= {*other.signal.lanes}
        if held.issuperset(passing.lanes):
            out.append(passing)
    return out


def _followed(ahead: F64, held: Sequence[str], lanes: Mapping[str, Lane]) -> tuple[str, ...]:
    """Return which of the lanes that part where the held ones begin fit a line ``(N, 2)`` best, held
    ones first.
    """
    parting = dict.fromkeys(held)
    for lane in lanes.values():
        if any(key in lane.successors for key in held):
            parting |= dict.fromkeys(key for key in lane.successors if key in lanes)
    if len(parting) <= 1:
        return tuple(parting)
    apart_m = {key: _apart_m(ahead, _carried_on(key, lanes)) for key in parting}
    least_m = min(apart_m.values())
    return tuple(key for key in parting if apart_m[key] <= least_m + TIE_M)


def _carried_on(key: str, lanes: Mapping[str, Lane]) -> F64:
    """Return the middle ``(N, 2)`` of a lane and of those behind it, for `AHEAD_M` or to a fork."""
    parts = [lanes[key].centre[:, :2]]
    length_m = 0.0
    while True:
        length_m += float(arc_lengths(parts[-1])[-1])
        following = [name for name in lanes[key].successors if name in lanes]
        if length_m >= AHEAD_M or len(following) != 1 or len(parts) > AHEAD_M:
            return np.concatenate(parts)
        key = following[0]
        parts.append(lanes[key].centre[:, :2])


def _apart_m(ahead: F64, middle: F64) -> float:
    """Return the mean distance of a line ``(N, 2)`` to the middle of a lane, up to the lane's end."""
    lane_line = shapely.linestrings(middle)
    points = shapely.points(ahead)
    beside = shapely.line_locate_point(lane_line, points) < shapely.length(lane_line) - 1e-6
    beside[0] = True
    return float(shapely.distance(lane_line, points[beside]).mean())
