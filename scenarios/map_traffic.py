"""Vehicles on the lanes of a map around a route. They follow their lanes with the Intelligent Driver
Model and stop at red lights.

Nobody here gives way at a junction. So no vehicle is placed whose way would cross or join the ego's,
or that of another vehicle; those who start behind one another share their way.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.types import F64
from alpasim_plugin.world.path import Path
from scenarios.expert import Follower
from scenarios.map_route import LaneGraph, Way
from scenarios.traffic import SIZES

WAY_M = 300.0  # a vehicle is placed with the lanes that it will drive along
SHORTEST_WAY_M = 60.0
ROOM_M = 20.0  # between two vehicles at the start
CLOSE_M = 2.0  # lines nearer than this meet
SPEED_MPS = (7.0, 11.0)
BEND_MPS2 = 3.0  # lateral acceleration in the sharpest bend of its way
TRIES = 8  # for each vehicle


def place_followers(
    graph: LaneGraph, way: Way, line: Path, count: int, rng: np.random.Generator
) -> list[Follower]:
    """Return up to ``count`` vehicles on the lanes of ``graph``, as many as find room.

    Args:
        graph: Lanes near the route.
        way: The ego's way.
        line: Its line.
        count: Wanted vehicles.
        rng: Where and how fast they start.
    """
    followers: list[Follower] = []
    taken: list[tuple[Way, Any, F64]] = [(way, _shape(line), line.xyz[0, :2])]
    for _ in range(TRIES * count):
        if len(followers) == count:
            break
        spot = graph.drawn_spot(rng)
        speed_mps = float(rng.uniform(*SPEED_MPS))
        start = Way((spot.lane_id,), spot.at_m, graph.length_m[spot.lane_id] - spot.at_m)
        own = graph.carried_on(start, WAY_M)
        if own.beyond_m < SHORTEST_WAY_M:
            continue
        path = graph.line(own)
        shape, place = _shape(path), path.xyz[0, :2]
        if any(
            np.hypot(*(place - there)) < ROOM_M or _meet(own, shape, other, drawn)
            for other, drawn, there in taken
        ):
            continue
        taken.append((own, shape, place))
        sharpest = max(float(np.abs(path.curvature).max()), 1e-6)
        speed_mps = min(speed_mps, float(np.sqrt(BEND_MPS2 / sharpest)))
        params = {"desired_speed_mps": speed_mps}
        name = f"car-{len(followers)}"
        followers.append(Follower(name, "car", path, 0.0, speed_mps, SIZES["car"], params))
    return followers


def _shape(path: Path) -> Any:
    return shapely.linestrings(path.xyz[::8, :2])


def _meet(one: Way, one_shape: Any, other: Way, other_shape: Any) -> bool:
    """Return whether two ways cross or join; from one lane on, they follow each other."""
    if one.lane_ids[0] in other.lane_ids or other.lane_ids[0] in one.lane_ids:
        return False
    return bool(shapely.dwithin(one_shape, other_shape, CLOSE_M))
