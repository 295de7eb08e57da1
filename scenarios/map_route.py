"""Ways along the lanes of a map: the shortest one between two places, or one that is drawn."""

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, heading_of, resample, wrap_angle
from alpasim_plugin.core.types import F64, Lane
from alpasim_plugin.world.path import Path, smooth_path, smoothstep

STATION_M = 2.0  # of the driven line, which is smooth in between
CHANGE_M = 40.0  # length of a lane change, where the lanes are as long
SHORTEST_CHANGE_M = 20.0
NARROWEST_M = 2.2  # of a lane on which a car fits
WIDEST_M = 15.0  # of a lane whose edges run together
CHANGE_COST_M = 50.0  # a way is so much longer before a lane change is worth it


@dataclass(frozen=True)
class Spot:
    """A place on a lane."""

    lane_id: str
    at_m: float  # along its centre


@dataclass(frozen=True)
class Way:
    """Lanes in driving order. From a lane to its neighbour one changes, else one follows the
    other.
    """

    lane_ids: tuple[str, ...]
    start_m: float  # on the first lane
    beyond_m: float  # of the last lane, behind the goal


class LaneGraph:
    """Lanes of one kind and how they follow one another; a lane that opens or closes, narrow at one
    end, is not among them, nor is one whose edges do not run side by side.

    Args:
        lanes: The map's lanes.
        kind: Of the lanes.
        narrowest_m: No lane is narrower anywhere.
    """

    def __init__(
        self, lanes: Mapping[str, Lane], kind: str = "vehicle", narrowest_m: float = NARROWEST_M
    ) -> None:
        self.lanes = {
            key: lane
            for key, lane in lanes.items()
            if lane.kind == kind and _is_even(lane, narrowest_m)
        }
        self.length_m = {
            lane_id: float(arc_lengths(lane.centre)[-1]) for lane_id, lane in self.lanes.items()
        }

    def following(self, lane_id: str) -> tuple[str, ...]:
        """Return the lanes that follow a lane."""
        return tuple(key for key in self.lanes[lane_id].successors if key in self.lanes)

    def driven_m(self, way: Way) -> float:
        """Return the length of a way up to its goal; a lane that one changes from lies beside the
        next one.
        """
        return sum(self._driven_lengths_m(way)) - way.start_m - way.beyond_m

    def _driven_lengths_m(self, way: Way) -> list[float]:
        """Return what each lane of a way adds to its length."""
        after = (*way.lane_ids[1:], "")
        return [
            0.0 if then in self.beside(key) else self.length_m[key]
            for key, then in zip(way.lane_ids, after, strict=True)
        ]

    def beside(self, lane_id: str) -> tuple[str, ...]:
        """Return the neighbours of a lane into which one may change."""
        lane = self.lanes[lane_id]
        neighbours = (lane.left_neighbour, lane.right_neighbour)
        return tuple(key for key in neighbours if key is not None and key in self.lanes)

    def drawn_spot(self, rng: np.random.Generator) -> Spot:
        """Draw a place, lanes by their length, outside of junctions where there is one."""
        keys = [key for key, lane in self.lanes.items() if not lane.is_intersection]
        keys = keys or list(self.lanes)
        lengths = np.array([self.length_m[key] for key in keys])
        key = keys[int(rng.choice(len(keys), p=lengths / lengths.sum()))]
        return Spot(key, float(rng.uniform(0.0, self.length_m[key])))

    def between(self, starts: Sequence[Spot], goals: Sequence[Spot]) -> Way | None:
        """Return the shortest way from one of ``starts`` to one of ``goals``; None without one."""
        aims = {goal.lane_id: goal.at_m for goal in goals}
        # cost, number, lanes, from where on the last lane, whether one has changed into it
        queue: list[tuple[float, int, tuple[str, ...], float, bool]] = [
            (0.0, n, (spot.lane_id,), spot.at_m, False) for n, spot in enumerate(starts)
        ]
        begins = {spot.lane_id: spot.at_m for spot in starts}
        settled: set[tuple[str, bool, bool]] = set()
        pushed = len(queue)
        while queue:
            cost_m, _, chain, on_m, changed = heapq.heappop(queue)
            last = chain[-1]
            least_m = on_m + (SHORTEST_CHANGE_M if changed else 0.0)
            if last in aims and aims[last] > least_m:
                return Way(chain, begins[chain[0]], self.length_m[last] - aims[last])
            state = last, changed, len(chain) == 1
            if state in settled:
                continue
            settled.add(state)
            rest_m = self.length_m[last] - on_m
            steps = [(key, rest_m, 0.0, False) for key in self.following(last)]
            if rest_m >= SHORTEST_CHANGE_M and not changed:
                steps += [
                    (key, CHANGE_COST_M, self._abreast(last, key, on_m), True)
                    for key in self.beside(last)
                ]
            for key, more_m, begin_m, change in steps:
                pushed += 1
                step = (cost_m + more_m, pushed, (*chain, key), begin_m, change)
                heapq.heappush(queue, step)
        return None

    def standing(self, spot: Spot) -> Way:
        """Return the way without length at a spot."""
        return Way((spot.lane_id,), spot.at_m, self.length_m[spot.lane_id] - spot.at_m)

    def through(self, places: Sequence[Sequence[Spot]]) -> list[Way]:
        """Return the shortest way to each spot of the last place that passes the others in order;
        none to a spot that no such way leads to. A way drives no lane twice, and changes lanes once
        at a time.

        Args:
            places: At least two, each with one spot for each of its lanes.
        """
        ways = [self.standing(spot) for spot in places[0]]
        begins = list(places[0])
        for goals in places[1:]:
            reached = []
            for goal in goals:
                further = [self.between([begin], [goal]) for begin in begins]
                longer = [
                    _joined(way, part)
                    for way, part in zip(ways, further, strict=True)
                    if part is not None
                ]
                longer = [way for way in longer if self._can_be_driven(way)]
                if longer:
                    reached.append((min(longer, key=self.driven_m), goal))
            ways = [way for way, _ in reached]
            begins = [goal for _, goal in reached]
        return ways

    def _can_be_driven(self, way: Way) -> bool:
        """Return whether a way takes each lane once, and no two changes of lanes follow at once."""
        ids = way.lane_ids
        changes = [then in self.beside(key) for key, then in itertools.pairwise(ids)]
        in_a_row = any(first and second for first, second in itertools.pairwise(changes))
        return len(set(ids)) == len(ids) and not in_a_row

    def drawn(self, way: Way, length_m: float, rng: np.random.Generator) -> Way:
        """Return a way carried on from its end to a length, at each fork into a drawn lane that it
        has not driven yet; it is shorter than ``length_m`` where there is none.
        """
        chain = list(way.lane_ids)
        length_m = max(length_m, self.driven_m(way))
        driven_m = self.driven_m(way) + way.beyond_m
        while driven_m < length_m:
            after = [key for key in self.following(chain[-1]) if key not in chain]
            if not after:
                break
            chain.append(after[int(rng.integers(len(after)))])
            driven_m += self.length_m[chain[-1]]
        return Way(tuple(chain), way.start_m, max(driven_m - length_m, 0.0))

    def carried_on(self, way: Way, length_m: float) -> Way:
        """Return a way with the lanes after its end that turn least, for a length."""
        chain = list(way.lane_ids)
        beyond_m = way.beyond_m
        while beyond_m < length_m and (after := self.following(chain[-1])):
            chain.append(min(after, key=self._turn_rad))
            beyond_m += self.length_m[chain[-1]]
        return Way(tuple(chain), way.start_m, beyond_m)

    def line(self, way: Way) -> Path:
        """Return the smooth line of a way, from its start to the end of its last lane."""
        parts: list[F64] = []
        begin_m = way.start_m
        ids = list(way.lane_ids)
        while ids:
            key = ids.pop(0)
            stations = np.arange(begin_m, max(self.length_m[key], begin_m + 0.1), STATION_M)
            points = resample(self.lanes[key].centre, stations)
            if ids and ids[0] in self.beside(key):
                other = ids.pop(0)
                other_points = resample(
                    self.lanes[other].centre, [self._abreast(key, other, s) for s in stations]
                )
                length_m = min(CHANGE_M, self.length_m[key] - begin_m)
                share = smoothstep((stations - begin_m) / length_m)[:, None]
                points = (1 - share) * points + share * other_points
            if parts and np.linalg.norm(points[0] - parts[-1][-1]) < STATION_M / 2:
                points = points[1:]
            if len(points):
                parts.append(points)
            begin_m = 0.0
        end = self.lanes[way.lane_ids[-1]].centre[-1:]
        if np.linalg.norm(end - parts[-1][-1]) > STATION_M / 4:
            parts.append(end)
        return smooth_path(np.concatenate(parts))

    def limits_mps(self, way: Way, line: Path) -> F64:
        """Return the speed limit at each vertex of a way's line; infinite where none is known."""
        ends_m = np.cumsum(self._driven_lengths_m(way)) - way.start_m
        limits = [self.lanes[key].speed_limit_mps or np.inf for key in way.lane_ids]
        return np.array(limits)[np.searchsorted(ends_m[:-1], line.s)]

    def _abreast(self, lane_id: str, other: str, at_m: float) -> float:
        """Return the arc length on a neighbour beside a place on a lane."""
        return at_m / self.length_m[lane_id] * self.length_m[other]

    def _turn_rad(self, lane_id: str) -> float:
        steps = np.diff(self.lanes[lane_id].centre[:, :2], axis=0)
        first, last = (heading_of(step) for step in (steps[0], steps[-1]))
        return abs(float(wrap_angle(last - first)))


def _joined(way: Way, further: Way) -> Way:
    """Return a way and the one from its end as one."""
    return Way((*way.lane_ids, *further.lane_ids[1:]), way.start_m, further.beyond_m)


def _is_even(lane: Lane, narrowest_m: float) -> bool:
    """Return whether a lane is wide enough everywhere; its edges have the same stations."""
    assert lane.left is not None
    assert lane.right is not None
    widths_m = np.linalg.norm((lane.left - lane.right)[:, :2], axis=1)
    return bool(widths_m.min() >= narrowest_m and widths_m.max() <= WIDEST_M)
