"""Cyclists on the cycle lanes of a map around a route, and at the outer side of lanes of roads up to
50 km/h. They ride, wait and give way as vehicles do.

They keep so near to the middle of a lane that a car does not pass within it, but follows; only
where the lane is wide enough for a car to pass with room to spare they ride at its edge.
"""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import gaussian_filter1d

from alpasim_plugin.core.types import F64, Lane
from alpasim_plugin.world.idm import allowed_speeds
from alpasim_plugin.world.path import Path, smooth_path
from alpasim_plugin.world.signals import red_gap_m
from scenarios.expert import Follower
from scenarios.map_route import STATION_M, LaneGraph, Way
from scenarios.map_traffic import SHORTEST_WAY_M, WAY_M, Rides, stopping_m
from scenarios.traffic import SIZES

# Adults on ordinary bicycles ride at 15 km/h on average, on pedelecs at 17 km/h, at most at 25 km/h
# with assistance: Schleinitz et al., "The German Naturalistic Cycling Study", Safety Science 92 (2017).
SPEED_MPS = (3.0, 7.0)
ACCEL_MPS2 = 1.0
BRAKE_MPS2 = 1.5  # comfortable
HARD_BRAKE_MPS2 = 5.0  # more lifts the rear wheel
HEADWAY_S = 1.0
MIN_GAP_M = 1.5
BEND_MPS2 = 2.0  # lateral acceleration in bends
FASTEST_ROAD_MPS = 50.0 / 3.6
NARROWEST_M = 0.9  # of a cycle lane
EDGE_M = 0.6  # from the edge of a lane to the middle of the bicycle
FOLLOWED_M = 1.2  # from the middle of a lane: no farther where cars stay behind ...
PASSED_M = 2.3  # ... and no nearer where they pass, with a metre between
EASED_M = 5.0  # length over which the place in the lane changes
ONCOMING_M = 15.0  # lanes that run the other way are looked for so far beside
TRIES = 12  # for each cyclist


def place_cyclists(rides: Rides, count: int, rng: np.random.Generator) -> list[Follower]:
    """Return up to ``count`` cyclists near a route, as many as find room.

    Args:
        rides: Who is placed already; the cyclists are added.
        count: Wanted cyclists.
        rng: Where and how fast they start.
    """
    box = SIZES["cyclist"]
    cycle_lanes = LaneGraph(rides.lanes, "bike", NARROWEST_M)
    cyclists: list[Follower] = []
    for attempt in range(TRIES * count):
        if len(cyclists) == count:
            break
        wanted_mps = float(rng.uniform(*SPEED_MPS))
        on_cycle_lane = attempt % 2 == 0 and len(cycle_lanes.lanes) > 0
        graph = cycle_lanes if on_cycle_lane else rides.graph
        spot = graph.drawn_spot(rng)
        way = graph.carried_on(graph.standing(spot), WAY_M)
        if way.beyond_m < SHORTEST_WAY_M:
            continue
        path = graph.line(way)
        if not on_cycle_lane:
            if not _is_ridden(graph, way, path, rides.lanes):
                continue
            path = _at_the_side(graph, way, path)
        ride = rides.ride(way, path)
        if not rides.admits(ride):
            continue
        begin_mps = float(allowed_speeds(ride.path, wanted_mps, BEND_MPS2)[0])
        stop_m = red_gap_m(ride.lights, box.length_m / 2, begin_mps, 0)
        if stop_m < stopping_m(begin_mps):
            continue
        rides.add(ride)
        params = {
            "desired_speed_mps": wanted_mps,
            "headway_s": HEADWAY_S,
            "min_gap_m": MIN_GAP_M,
            "accel_mps2": ACCEL_MPS2,
            "brake_mps2": BRAKE_MPS2,
            "hard_brake_mps2": HARD_BRAKE_MPS2,
            "lateral_accel_mps2": BEND_MPS2,
        }
        name = f"cyclist-{len(cyclists)}"
        cyclists.append(Follower(name, "cyclist", ride.path, 0.0, begin_mps, box, params))
    return cyclists


def _is_ridden(graph: LaneGraph, way: Way, line: Path, lanes: Mapping[str, Lane]) -> bool:
    """Return whether cyclists ride along a way: it begins in the outermost lane of a road without a
    cycle lane, and no limit on it is higher than `FASTEST_ROAD_MPS`.
    """
    first = graph.lanes[way.lane_ids[0]]
    on_left = _drives_on_left(graph, first)
    neighbour = first.left_neighbour if on_left else first.right_neighbour
    beside = None if neighbour is None else lanes.get(neighbour)
    if beside is not None and beside.kind in ("vehicle", "bike", "bus"):
        return False
    if any(graph.lanes[key].is_motorway for key in way.lane_ids):
        return False
    limits_mps = graph.limits_mps(way, line)
    posted = limits_mps[np.isfinite(limits_mps)]
    return not len(posted) or float(posted.max()) <= FASTEST_ROAD_MPS + 0.1


def _drives_on_left(graph: LaneGraph, lane: Lane) -> bool:
    """Return whether the nearest lane that runs the other way lies to the right of a lane."""
    begin = lane.centre[0, :2]
    along = lane.centre[1, :2] - begin
    nearest_m = ONCOMING_M
    on_left = False
    for other in graph.lanes.values():
        oncoming = other.centre[-1, :2] - other.centre[-2, :2]
        offset = other.centre[-1, :2] - begin
        away_m = float(np.hypot(*offset))
        if oncoming @ along < 0.0 and away_m < nearest_m:
            nearest_m = away_m
            on_left = bool(along[0] * offset[1] - along[1] * offset[0] < 0.0)
    return on_left


def _at_the_side(graph: LaneGraph, way: Way, line: Path) -> Path:
    """Return the line of a cyclist in the lanes of a way: at the outer side of each."""
    half_m = np.interp(line.s, *_half_widths(graph, way))
    outer_m = half_m - EDGE_M
    aside_m = np.where(outer_m >= PASSED_M, outer_m, np.clip(outer_m, 0.0, FOLLOWED_M))
    smooth_m = gaussian_filter1d(aside_m, EASED_M / line.s[1], mode="nearest")
    side = 1.0 if _drives_on_left(graph, graph.lanes[way.lane_ids[0]]) else -1.0
    stations = np.linspace(0.0, line.length_m, int(line.length_m / STATION_M) + 2)
    points, _ = line.at(stations, side * np.interp(stations, line.s, smooth_m))
    return smooth_path(points)


def _half_widths(graph: LaneGraph, way: Way) -> tuple[F64, F64]:
    """Return arc lengths ``(L,)`` on the line of a way, one for each of its lanes, at its middle, and
    half the least width of that lane, metres.
    """
    begin_m = -way.start_m
    stations = []
    halves = []
    for key in way.lane_ids:
        lane = graph.lanes[key]
        assert lane.left is not None
        assert lane.right is not None
        width_m = float(np.linalg.norm((lane.left - lane.right)[:, :2], axis=1).min())
        stations.append(begin_m + graph.length_m[key] / 2)
        halves.append(width_m / 2)
        begin_m += graph.length_m[key]
    return np.array(stations), np.array(halves)
