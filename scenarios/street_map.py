"""A map without a drive, as its file has it, and the cycle that is assumed for its traffic lights.

Map formats say which lights belong together, and no times. The lights of one group are green
together, the groups of a junction one after the other, and people cross a road while its own traffic
has red.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from alpasim_plugin.core.types import Lane, LaneMap, Signal
from scenarios.map_route import Spot

GREEN_S = 6.0  # of each group
YELLOW_S = 3.0  # of each group
CLEAR_S = 2.0  # all are red between two groups
WALK_END_S = 5.0  # people have red so long before the traffic may drive
TURN_S = GREEN_S + YELLOW_S + CLEAR_S
CYCLE = (
    f"assumed {GREEN_S:g} s green, {YELLOW_S:g} s yellow, {CLEAR_S:g} s red for all, groups in turn"
)


@dataclass(frozen=True)
class Head:
    """A traffic light, where one waits for it, and the group that it belongs to."""

    signal: Signal  # without its cycle
    junction: str
    group: str
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
    """

    lanes: Mapping[str, Lane]
    beside: LaneMap
    heads: tuple[Head, ...]
    give_way: tuple[Signal, ...]
    roads: Mapping[str, float]
    spots: Callable[[str, float], list[Spot]]
    origin: tuple[float, float, float]
    notes: tuple[str, ...]


def with_cycles(heads: Sequence[Head], begins_us: Mapping[str, int]) -> tuple[Signal, ...]:
    """Return the lights with their cycles.

    Args:
        heads: All lights.
        begins_us: Junction to the time at which its first group turns green; others begin at 0.
    """
    groups: dict[str, list[str]] = {}
    of_road: dict[str, str] = {}
    for head in heads:
        junction_groups = groups.setdefault(head.junction, [])
        if not head.signal.pedestrians:
            junction_groups.append(head.group)
            of_road[head.road_id] = head.group
    out = []
    for head in heads:
        junction_groups = sorted(set(groups[head.junction]), key=lambda name: (len(name), name))
        group = of_road.get(head.road_id, head.group)
        turn = junction_groups.index(group) if group in junction_groups else 0
        cycle_s = TURN_S * max(len(junction_groups), 2)
        if head.signal.pedestrians:
            walk_s = cycle_s - TURN_S - WALK_END_S
            phases = [("green", walk_s), ("red", cycle_s - walk_s)]
            first_s = TURN_S
        else:
            rest_s = cycle_s - GREEN_S - YELLOW_S
            phases = [("green", GREEN_S), ("yellow", YELLOW_S), ("red", rest_s)]
            first_s = 0.0
        offset_us = begins_us.get(head.junction, 0) + round((turn * TURN_S + first_s) * 1e6)
        timed = tuple((colour, round(lasts_s * 1e6)) for colour, lasts_s in phases)
        out.append(replace(head.signal, phases=timed, offset_us=offset_us))
    return tuple(out)
