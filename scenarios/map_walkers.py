"""Pedestrians on the crosswalks of a map's route, about when the ego comes; they go first.

Behind a traffic light of the route they cross while it is red. Crosswalks near other lights stay
empty: nobody knows when people there have green.
"""

import numpy as np
import shapely

from alpasim_plugin.core.geometry import unit
from alpasim_plugin.core.types import F64, I64, Actor, LaneMap
from alpasim_plugin.world.ground import SLOPE, STACKED_M
from alpasim_plugin.world.path import Path
from alpasim_plugin.world.signals import lights_on
from scenarios.ego_path import walk_track
from scenarios.traffic import SIZES

LIGHT_M = 30.0  # a traffic light that is nearer to a crosswalk governs it
AFTER_RED_US = 1_000_000  # so long after it has turned red they begin
FIRST_M = 25.0  # of the route, without people
MARGIN_M = 1.0  # beside the crosswalk, where they start
LATE_S = (-2.0, 1.0)  # when they are in the ego's lane, after the ego would be there
SPEED_MPS = (1.1, 1.6)


def place_walkers(
    lane_map: LaneMap,
    driven: Path,
    front_m: float,
    cruise_mps: float,
    count: int,
    t_us: I64,
    rng: np.random.Generator,
) -> list[Actor]:
    """Return up to ``count`` pedestrians, one for each crosswalk that the ego drives over.

    Args:
        lane_map: Map around the route.
        driven: The ego's line.
        front_m: From its rear axle to its front.
        cruise_mps: Its speed on a free road.
        count: Wanted pedestrians.
        t_us: Times of their tracks.
        rng: Which crosswalks, sides, speeds and times.
    """
    stops = [signal.stop.mean(axis=0) for signal in lane_map.signals or ()]
    lights = lights_on(driven, lane_map.signals, lane_map.lanes)
    points = shapely.points(driven.xyz[:, :2])
    places = []
    for ring in lane_map.crosswalks:
        middle = ring[:-1].mean(axis=0)
        is_inside = shapely.contains(shapely.Polygon(ring[:, :2]), points)
        is_level = np.abs(driven.xyz[:, 2] - middle[2]) < STACKED_M  # not of a bridge above the way
        inside = np.flatnonzero(is_inside & is_level)
        if not len(inside) or driven.s[inside[0]] < FIRST_M:
            continue
        row = inside[len(inside) // 2]
        signals = [light.signal for light in lights if 0.0 <= driven.s[row] - light.s_m < LIGHT_M]
        if signals or not any(_governs(stop, middle) for stop in stops):
            places.append((ring, row, signals))
    walkers = []
    for number, chosen in enumerate(rng.permutation(len(places))[:count]):
        ring, row, signals = places[chosen]
        start, goal = _ends(ring, float(driven.yaw[row]), float(driven.xyz[row, 2]))
        if rng.random() < 0.5:
            start, goal = goal, start
        speed_mps = float(rng.uniform(*SPEED_MPS))
        there_s = (driven.s[row] - front_m) / cruise_mps + float(rng.uniform(*LATE_S))
        walked_m = float(np.hypot(*(driven.xyz[row] - start)[:2]))
        begin_us = round((there_s - walked_m / speed_mps) * 1e6)
        if signals:
            # The last time at which the light has turned red.
            cycle_us = sum(lasts_us for _, lasts_us in signals[-1].phases)
            turns_us = signals[-1].offset_us + cycle_us - signals[-1].phases[-1][1]
            n_cycles = (round(there_s * 1e6) - turns_us) // cycle_us
            begin_us = turns_us + n_cycles * cycle_us + AFTER_RED_US
        box = SIZES["pedestrian"]
        track = walk_track(start, goal, t_us, begin_us, speed_mps, box)
        walkers.append(Actor(f"walker-{number}", "pedestrian", box, track))
    return walkers


def _governs(stop: F64, middle: F64) -> bool:
    """Return whether a light with a stop line at a place is one of a crosswalk at another place."""
    away_m = float(np.hypot(*(stop - middle)[:2]))
    rise_m = abs(float(stop[2] - middle[2]))
    return away_m < LIGHT_M and rise_m < STACKED_M + SLOPE * away_m


def _ends(ring: F64, heading_rad: float, height_m: float) -> tuple[F64, F64]:
    """Return where one enters and leaves a crosswalk: the middles of the sides of its rectangle that
    lie across the road.
    """
    corners = shapely.get_coordinates(shapely.oriented_envelope(shapely.Polygon(ring[:, :2])))[:4]
    across = np.array([-np.sin(heading_rad), np.cos(heading_rad)])
    sides = np.roll(corners, -1, axis=0) - corners
    ways = unit(sides)
    walked = sides[int(np.argmax(ways @ across))]
    half = walked / 2 + MARGIN_M * unit(walked)
    middle = corners.mean(axis=0)
    start = middle - half
    goal = middle + half
    return np.array([*start, height_m]), np.array([*goal, height_m])
