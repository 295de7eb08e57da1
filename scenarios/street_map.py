"""A map without a drive, as its file has it, and the program that is assumed for its traffic lights.

Map formats have no times. Lights of one phase are green together, the phases of a junction one after
the other, and people cross a road while its own traffic has red. The phases are those of the map's
controllers; without any, opposite approaches are green together, with all their turns.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.types import Lane, LaneMap, Signal
from scenarios.map_route import Spot

CYCLE_S = 64.0  # of a junction of two phases ...
LONGER_S = 12.0  # ... and longer for each further phase
YELLOW_S = 3.0  # of each phase
CLEAR_S = 2.0  # all are red between two phases
WALK_END_S = 5.0  # people have red so long before the traffic may drive
OPPOSITE_RAD = np.radians(40.0)  # approaches whose axes differ by less are one phase ...
CROSSING_RAD = np.radians(60.0)  # ... and by more cross each other
CYCLE = (
    f"assumed cycles of {CYCLE_S:g} s for two phases and {LONGER_S:g} s more for each further one, "
    f"{YELLOW_S:g} s yellow and {CLEAR_S:g} s red for all among them; phases are the map's "
    "controllers, without any the opposite approaches together"
)


@dataclass(frozen=True)
class Head:
    """A traffic light, where one waits for it, and what switches it."""

    signal: Signal  # without its cycle
    junction: str
    group: str  # the map's controller; empty: none
    road_id: str


@dataclass(frozen=True)
class StreetMap:
    """A whole map, in metres around ``origin``.

    Attributes:
        lanes: Linked lanes.
        beside: Without lanes: crosswalks, stop lines, signs and posts.
        heads: Traffic lights.
        give_way: Lines at which one lets others pass.
        roads: Name of a road to its length in metres.
        spots: Places on lanes at a number of metres along a road.
        origin: What was subtracted from the file's coordinates.
        notes: What was assumed or left out.
        country: Where it lies, a code of ISO 3166; None: not known.
    """

    lanes: Mapping[str, Lane]
    beside: LaneMap
    heads: tuple[Head, ...]
    give_way: tuple[Signal, ...]
    roads: Mapping[str, float]
    spots: Callable[[str, float], list[Spot]]
    origin: tuple[float, float, float]
    notes: tuple[str, ...]
    country: str | None = None


def with_cycles(heads: Sequence[Head], begins_us: Mapping[str, int]) -> tuple[Signal, ...]:
    """Return the lights with their cycles.

    Args:
        heads: All lights.
        begins_us: Junction to the time at which its first phase turns green; others begin at 0.
    """
    junctions: dict[str, list[Head]] = {}
    for head in heads:
        junctions.setdefault(head.junction, []).append(head)
    programs = {junction: _Program(members) for junction, members in junctions.items()}
    return tuple(
        programs[head.junction].timed(head, begins_us.get(head.junction, 0)) for head in heads
    )


class _Program:
    """Phases of the lights of one junction, at least two: for a light alone the other is empty."""

    def __init__(self, heads: Sequence[Head]) -> None:
        self._vehicles = [head for head in heads if not head.signal.pedestrians]
        names = sorted({head.group for head in self._vehicles}, key=lambda name: (len(name), name))
        by_controller = [
            [head for head in self._vehicles if head.group == name] for name in names if name
        ]
        if len(names) < 2 or "" in names or any(_cross(members) for members in by_controller):
            self._phases = _by_axis(self._vehicles)
        else:
            self._phases = by_controller
        self._n_phases = max(len(self._phases), 2)

    @property
    def cycle_s(self) -> float:
        """Return the length of the cycle."""
        return CYCLE_S + LONGER_S * (self._n_phases - 2)

    def timed(self, head: Head, begin_us: int) -> Signal:
        """Return a light with its cycle."""
        phase_s = self.cycle_s / self._n_phases
        first_s = phase_s * self._phase(head)
        if head.signal.pedestrians:
            walk_s = self.cycle_s - phase_s - WALK_END_S
            colours = [("green", walk_s), ("red", self.cycle_s - walk_s)]
            first_s += phase_s
        else:
            green_s = phase_s - YELLOW_S - CLEAR_S
            red_s = self.cycle_s - green_s - YELLOW_S
            colours = [("green", green_s), ("yellow", YELLOW_S), ("red", red_s)]
        phases = tuple((colour, round(lasts_s * 1e6)) for colour, lasts_s in colours)
        return replace(head.signal, phases=phases, offset_us=begin_us + round(first_s * 1e6))

    def _phase(self, head: Head) -> int:
        """Return the number of the phase of a light; of one for people that of the traffic that they
        cross.
        """
        if not head.signal.pedestrians:
            return next(
                number
                for number, phase in enumerate(self._phases)
                if any(member is head for member in phase)
            )
        crossed_rad = head.signal.heading_rad + np.pi / 2
        candidates = [other for other in self._vehicles if other.road_id == head.road_id]
        nearest = min(
            candidates or self._vehicles,
            key=lambda other: _between_axes(other.signal.heading_rad, crossed_rad),
            default=None,
        )
        return 0 if nearest is None else self._phase(nearest)


def _by_axis(heads: Sequence[Head]) -> list[list[Head]]:
    """Return lights by the axes of their approaches, along which traffic comes from both ends."""
    phases: list[list[Head]] = []
    for head in heads:
        apart_rad = [
            _between_axes(phase[0].signal.heading_rad, head.signal.heading_rad) for phase in phases
        ]
        nearest = int(np.argmin(apart_rad)) if apart_rad else 0
        if apart_rad and apart_rad[nearest] < OPPOSITE_RAD:
            phases[nearest].append(head)
        else:
            phases.append([head])
    return phases


def _cross(heads: Sequence[Head]) -> bool:
    """Return whether the traffic of some of these lights crosses that of others."""
    headings_rad = [head.signal.heading_rad for head in heads]
    return any(
        _between_axes(first, second) > CROSSING_RAD
        for first in headings_rad
        for second in headings_rad
    )


def _between_axes(first_rad: float, second_rad: float) -> float:
    """Return the angle between two lines, 0 to pi / 2."""
    return float(np.arcsin(min(abs(np.sin(first_rad - second_rad)), 1.0)))
