"""Who goes first at a junction without lights: by its signs, and without signs who comes from the
right, who goes straight on over oncoming traffic, and in a roundabout who is inside.

The rules are lines to give way at, where the lanes of a junction begin, that name the lanes which go
first.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import shapely

from alpasim_plugin.core.geometry import arc_lengths, heading_of, wrap_angle
from alpasim_plugin.core.types import Lane, Signal
from scenarios.junction_rules import MEET_M, detour, is_level, through_junction
from scenarios.map_lines import predecessors, rails

ASIDE_RAD = (np.radians(30.0), np.radians(150.0))  # between headings: from the right or the left
CIRCLE_M = 250.0  # once around a roundabout, at most
ROUND = 0.9  # 4 pi area / length^2 of a circle is 1, of a square 0.79, of an ellipse of 3:2 0.94
BACK_RAD = 0.1  # a lane around a circle turns back by no more


def priority_lines(
    lanes: Mapping[str, Lane],
    lights: Iterable[Signal],
    signed: Iterable[Signal],
    first_from_right: bool = True,
) -> tuple[Signal, ...]:
    """Return the lines at which the lanes of junctions without lights give way.

    Args:
        lanes: The map's lanes.
        lights: Lanes of junctions that they hold need no further rule.
        signed: Lines of signs to give way.
        first_from_right: Whether who comes from the right goes first; else who comes from the left.
    """
    junctions = _Junctions.of(lanes, lights, signed, first_from_right)
    yields: dict[str, list[str]] = {}
    for first, second in junctions.meetings():
        gives = junctions.second_of(first, second)
        if gives is not None:
            goes = second if gives == first else first
            yields.setdefault(gives, []).append(goes)
    waiting = _without_rings(yields, junctions.before)
    return tuple(_line(lanes[key], yields[key], waiting[key]) for key in yields)


def circle_lanes(lanes: Mapping[str, Lane]) -> set[str]:
    """Return the lanes of roundabouts: those that lead around to themselves within `CIRCLE_M`, all in
    one direction, as a round line.
    """
    turns = {key: _turn_rad(lane) for key, lane in lanes.items() if lane.kind == "vehicle"}
    return {
        key
        for sense in (1.0, -1.0)
        for ring in _rings({k: lanes[k] for k, turn in turns.items() if sense * turn > -BACK_RAD})
        if _is_round([lanes[key] for key in ring])
        for key in ring
    }


@dataclass(frozen=True)
class _Junctions:
    """The lanes of junctions among which a rule is missing.

    Attributes:
        lanes: The map's lanes.
        before: The lanes that lead to each.
        inside: Lanes of roundabouts.
        signed: Lanes of junctions that a sign to give way holds.
        open: Lanes of junctions that no light holds.
        first_from_right: Whether who comes from the right goes first.
    """

    lanes: Mapping[str, Lane]
    before: Mapping[str, Sequence[str]]
    inside: set[str]
    signed: set[str]
    open: tuple[str, ...]
    first_from_right: bool

    @classmethod
    def of(
        cls,
        lanes: Mapping[str, Lane],
        lights: Iterable[Signal],
        signed: Iterable[Signal],
        first_from_right: bool,
    ) -> "_Junctions":
        """Return the lanes of junctions that no light holds."""
        lit = _held(lights, lanes)
        is_open = tuple(
            key
            for key, lane in lanes.items()
            if lane.is_intersection and lane.kind == "vehicle" and key not in lit
        )
        by_sign = _held(signed, lanes)
        inside = circle_lanes(lanes)
        return cls(lanes, predecessors(lanes), inside, by_sign, is_open, first_from_right)

    def meetings(self) -> list[tuple[str, str]]:
        """Return the pairs of lanes that cross or join on one level, each once."""
        if not self.open:
            return []
        middles = [shapely.linestrings(self.lanes[key].centre) for key in self.open]
        near = shapely.STRtree(middles).query(middles, "dwithin", MEET_M)
        return [
            (self.open[first], self.open[second])
            for first, second in near.T.tolist()
            if first < second
            and self._part(self.open[first], self.open[second])
            and is_level(middles[first], middles[second])
        ]

    def _part(self, first: str, second: str) -> bool:
        """Return whether two lanes come from different ones and do not follow each other."""
        begin, other = set(self.before[first]), set(self.before[second])
        linked = first in other or second in begin
        return not linked and begin.isdisjoint(other)

    def second_of(self, first: str, second: str) -> str | None:
        """Return which of two lanes that meet gives way; None of two in one roundabout."""
        are_inside = (first in self.inside, second in self.inside)
        if all(are_inside):
            return None
        if any(are_inside):
            return second if are_inside[0] else first
        if (first in self.signed) != (second in self.signed):
            return first if first in self.signed else second
        from_right_rad = _begin_rad(self.lanes[second]) - _begin_rad(self.lanes[first])
        turned_rad = float(wrap_angle(from_right_rad))
        if not ASIDE_RAD[0] < abs(turned_rad) < ASIDE_RAD[1]:
            return max(first, second, key=lambda key: detour(self.lanes[key], key))
        second_goes_first = (turned_rad > 0.0) == self.first_from_right
        return first if second_goes_first else second


def _held(signals: Iterable[Signal], lanes: Mapping[str, Lane]) -> set[str]:
    """Return the lanes of junctions that lights for vehicles, or signs, hold."""
    vehicles = (signal for signal in signals if not signal.pedestrians)
    return {key for signal in vehicles for key in through_junction(signal, lanes)}


def _without_rings(
    yields: Mapping[str, Sequence[str]], before: Mapping[str, Sequence[str]]
) -> dict[str, list[str]]:
    """Return for each lane those that go first even where their traffic waits, so that nobody waits
    for ever: of approaches in a ring, each of which waits for the next one, only those with an earlier
    name. Who waits stands before all lanes of an approach, and nobody sees which one it will take.

    Args:
        yields: The lanes that go first, for each that gives way.
        before: The lanes that lead to each.
    """
    keys = sorted({*yields, *(key for goes in yields.values() for key in goes)})
    approach = _approaches(keys, before)
    number = {name: n for n, name in enumerate(dict.fromkeys(approach.values()))}
    links = [
        (number[approach[key]], number[approach[goes]])
        for key, all_goes in yields.items()
        for goes in all_goes
    ]
    ring = _connected(links, len(number), "strong")
    ring_of = {key: ring[number[approach[key]]] for key in keys}
    return {
        key: [
            goes
            for goes in all_goes
            if ring_of[key] != ring_of[goes] or approach[goes] < approach[key]
        ]
        for key, all_goes in yields.items()
    }


def _approaches(keys: Sequence[str], before: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return the name of each lane's approach, which lanes share that one lane leads to: the first of
    their names.
    """
    number = {key: n for n, key in enumerate(keys)}
    first_after: dict[str, str] = {}
    links = [
        (number[key], number[first_after.setdefault(name, key)])
        for key in keys
        for name in before[key]
    ]
    group = _connected(links, len(keys), "weak")
    names: dict[int, str] = {}
    return {key: names.setdefault(group[number[key]], key) for key in keys}


def _connected(links: Sequence[tuple[int, int]], count: int, connection: str) -> list[int]:
    """Return the connected component of each of ``count`` nodes."""
    if not links:
        return list(range(count))
    rows, columns = np.array(links).T
    graph = scipy.sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    labels: list[int] = scipy.sparse.csgraph.connected_components(graph, connection=connection)[
        1
    ].tolist()
    return labels


def _line(lane: Lane, goes_first: Sequence[str], waiting: Sequence[str]) -> Signal:
    """Return the line at which a lane begins."""
    ends = np.stack([edge[0] for edge in rails(lane)])
    return Signal(
        ends,
        _begin_rad(lane),
        (),
        name="priority",
        lanes=(lane.lane_id,),
        yields_to=tuple(goes_first),
        yields_to_waiting=tuple(waiting),
    )


def _begin_rad(lane: Lane) -> float:
    return float(heading_of(np.diff(lane.centre[:2, :2], axis=0))[0])


def _turn_rad(lane: Lane) -> float:
    """Return the angle by which a lane turns to the left from its begin to its end."""
    yaw = np.unwrap(heading_of(np.diff(lane.centre[:, :2], axis=0)))
    return float(yaw[-1] - yaw[0])


def _rings(lanes: Mapping[str, Lane]) -> list[list[str]]:
    """Return the shortest chain from each lane to itself within `CIRCLE_M`, where there is one."""
    keys = list(lanes)
    number = {key: n for n, key in enumerate(keys)}
    length_m = {key: float(arc_lengths(lane.centre)[-1]) for key, lane in lanes.items()}
    links = [
        (number[key], number[after], length_m[key])
        for key, lane in lanes.items()
        for after in lane.successors
        if after in number
    ]
    if not links:
        return []
    rows, columns, weights = np.array(links).T
    ends = (rows.astype(int), columns.astype(int))
    graph = scipy.sparse.csr_matrix((weights, ends), shape=2 * (len(keys),))
    away_m, leads = scipy.sparse.csgraph.dijkstra(graph, return_predecessors=True, limit=CIRCLE_M)
    rings = []
    for key in keys:
        ring_m = {
            after: length_m[key] + away_m[number[after], number[key]]
            for after in lanes[key].successors
            if after in number
        }
        first = min(ring_m, key=lambda name: ring_m[name], default=None)
        if first is None or ring_m[first] > CIRCLE_M:
            continue
        chain = [number[key]]
        while chain[-1] != number[first]:
            chain.append(int(leads[number[first], chain[-1]]))
        rings.append([keys[n] for n in chain[::-1]])
    return rings


def _is_round(ring: Sequence[Lane]) -> bool:
    """Return whether lanes one after the other are a circle or nearly."""
    line: Any = shapely.Polygon(np.concatenate([lane.centre[:, :2] for lane in ring]))
    return bool(line.is_valid and 4 * np.pi * line.area > ROUND * line.length**2)
