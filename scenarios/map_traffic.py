"""Vehicles on the lanes of a map around a route. They follow their lanes with the Intelligent Driver
Model, stop at red lights and give way at lines for it.

Where two ways cross or join, a rule decides who goes first: lights that are never open for both, or
a line to give way on one of them. Without a rule the vehicle is not placed; those who start behind
one another share their way.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from alpasim_plugin.core.types import I64, Lane, LaneMap
from alpasim_plugin.world.ground import STACKED_M
from alpasim_plugin.world.idm import allowed_speeds
from alpasim_plugin.world.path import Path
from alpasim_plugin.world.signals import LightAhead, lights_on, red_gap_m
from scenarios.expert import Follower
from scenarios.junction_rules import green_together
from scenarios.map_route import LaneGraph, Way
from scenarios.traffic import SIZES

WAY_M = 300.0  # a vehicle is placed with the lanes that it will drive along
SHORTEST_WAY_M = 60.0
ROOM_M = 20.0  # between two vehicles at the start
CLOSE_M = 2.0  # lines nearer than this meet
HEAD_ON = -0.5  # cosine between two ways, below which they run against each other
EVERY = 4  # vertex of a line, a metre apart, is looked at
APART = 10  # such vertices on, ways that were close come together anew
RULED_M = 60.0  # a rule is looked for so far before the place where they do
SPEED_MPS = (7.0, 11.0)
SLOWEST_MPS = 3.0  # whatever limits say
BEND_MPS2 = 3.0  # lateral acceleration in bends
CHANGE_GAIN_MPS2 = 0.2  # of a change of lanes that is worth it
STOP_MPS2 = 2.0  # before a stop line
STOP_ROOM_M = 3.0  # that is kept before it, and what the brake takes to act
TRIES = 8  # for each vehicle


@dataclass(frozen=True)
class Ride:
    """A vehicle's way, and the lines at which it waits."""

    way: Way
    path: Path
    lights: tuple[LightAhead, ...]
    give_way: tuple[LightAhead, ...]


class Rides:
    """Who drives around a route: the ego's ride and those of everybody who is placed.

    Args:
        lane_map: Map around the route.
        way: The ego's way.
        line: Its line.
    """

    def __init__(self, lane_map: LaneMap, way: Way, line: Path) -> None:
        self.graph = LaneGraph(lane_map.lanes)
        self._map = lane_map
        self._rides = [self.ride(way, line)]

    @property
    def lanes(self) -> Mapping[str, Lane]:
        """Give all lanes of the map, whatever drives on them."""
        return self._map.lanes

    def ride(self, way: Way, path: Path) -> Ride:
        """Return the ride along a path."""
        lanes = self._map.lanes
        lights = lights_on(path, self._map.signals, lanes)
        return Ride(way, path, lights, lights_on(path, self._map.give_way, lanes))

    def admits(self, ride: Ride) -> bool:
        """Return whether a ride begins apart from all others and it is clear who goes first."""
        return not any(
            _too_close(ride, other) or not _is_ruled(ride, other) for other in self._rides
        )

    def add(self, ride: Ride) -> None:
        """Add somebody who is placed."""
        self._rides.append(ride)


def place_followers(
    rides: Rides, count: int, rng: np.random.Generator, lane_changes: bool = False
) -> list[Follower]:
    """Return up to ``count`` vehicles on the lanes near a route, as many as find room.

    Args:
        rides: Who is placed already; the vehicles are added.
        count: Wanted vehicles.
        rng: Where and how fast they start.
        lane_changes: Whether they change lanes where that is worth it.
    """
    graph = rides.graph
    followers: list[Follower] = []
    for _ in range(TRIES * count):
        if len(followers) == count:
            break
        spot = graph.drawn_spot(rng)
        wanted_mps = float(rng.uniform(*SPEED_MPS))
        own_way = graph.carried_on(graph.standing(spot), WAY_M)
        if own_way.beyond_m < SHORTEST_WAY_M:
            continue
        candidate = rides.ride(own_way, graph.line(own_way))
        if not rides.admits(candidate):
            continue
        posted_mps = max(float(graph.limits_mps(own_way, candidate.path).min()), SLOWEST_MPS)
        wanted_mps = min(wanted_mps, posted_mps)
        params = {"desired_speed_mps": wanted_mps, "lateral_accel_mps2": BEND_MPS2}
        params |= {"change_gain_mps2": CHANGE_GAIN_MPS2} if lane_changes else {}
        begin_mps = float(allowed_speeds(candidate.path, wanted_mps, BEND_MPS2)[0])
        front_m = SIZES["car"].length_m / 2
        if red_gap_m(candidate.lights, front_m, begin_mps, 0) < stopping_m(begin_mps):
            continue
        rides.add(candidate)
        name = f"car-{len(followers)}"
        followers.append(
            Follower(name, "car", candidate.path, 0.0, begin_mps, SIZES["car"], params)
        )
    return followers


def stopping_m(speed_mps: float) -> float:
    """Return the distance to a stop line from which a driver still stops at it without haste."""
    return speed_mps**2 / (2.0 * STOP_MPS2) + STOP_ROOM_M


def _too_close(ride: Ride, other: Ride) -> bool:
    apart = ride.path.xyz[0] - other.path.xyz[0]
    return float(np.hypot(*apart[:2])) < ROOM_M and abs(float(apart[2])) < STACKED_M


def _is_ruled(ride: Ride, other: Ride) -> bool:
    """Return whether it is clear who goes first where two ways cross or join; from one lane on,
    they follow each other. Nobody drives against another one on one lane.
    """
    # In space: ways on a bridge and below it do not meet.
    tree = scipy.spatial.KDTree(other.path.xyz[::EVERY])
    apart_m, row = tree.query(ride.path.xyz[::EVERY])
    close = np.flatnonzero(apart_m < CLOSE_M)
    if not len(close):
        return True
    turned_rad = ride.path.yaw[::EVERY][close] - other.path.yaw[::EVERY][row[close]]
    if np.cos(turned_rad).min() < HEAD_ON:
        return False
    places = np.split(close, np.flatnonzero(np.diff(close) > APART) + 1)
    if ride.way.lane_ids[0] in other.way.lane_ids or other.way.lane_ids[0] in ride.way.lane_ids:
        places = places[1:]  # behind one another from the start
    return all(_who_is_clear(ride, other, place, row[place]) for place in places)


def _who_is_clear(ride: Ride, other: Ride, place: I64, other_place: I64) -> bool:
    """Return whether a rule says who goes first where two ways come together.

    Args:
        ride, other: The ways.
        place, other_place: Every `EVERY`-th vertex of each at the place.
    """
    s_m = float(ride.path.s[EVERY * place[0]])
    other_s_m = float(other.path.s[EVERY * other_place.min()])
    gives = _gives_way(ride, s_m, other), _gives_way(other, other_s_m, ride)
    first = _before(ride.lights, s_m)
    second = _before(other.lights, other_s_m)
    if first is not None and second is not None:
        return sum(gives) == 1 or not green_together(first.signal, second.signal)
    return sum(gives) == 1 and first is None and second is None


def _gives_way(ride: Ride, s_m: float, other: Ride) -> bool:
    """Return whether a line before a place holds a ride for another one."""
    return any(
        not line.signal.yields_to or not set(line.signal.yields_to).isdisjoint(other.way.lane_ids)
        for line in ride.give_way
        if 0.0 <= s_m - line.s_m <= RULED_M
    )


def _before(lines: tuple[LightAhead, ...], s_m: float) -> LightAhead | None:
    """Return the last light before a place."""
    candidates = [line for line in lines if 0.0 <= s_m - line.s_m <= RULED_M]
    return candidates[-1] if candidates else None
