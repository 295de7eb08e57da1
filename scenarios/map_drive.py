"""A drive on a map that has none: a route, an expert that drives it, and traffic around it.

Only the part of the map around the route enters the scene.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import project
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Lane, Route, Signal, Vehicle
from alpasim_plugin.world.path import Path
from alpasim_plugin.world.signals import lights_on
from scenarios.expert import ExpertStyle, drive
from scenarios.map_lines import ground_of
from scenarios.map_route import LaneGraph, Spot, Way
from scenarios.map_traffic import place_followers, vehicles
from scenarios.opendrive import bordered, read_lanes
from scenarios.opendrive_road import (
    OdrMap,
    lanes_at,
    parse_map,
    placed,
    sided,
)
from scenarios.opendrive_signals import CYCLE, GREEN_S, Head, traffic_lights, with_cycles
from scenarios.recorded import RecordedLog, SourceFiles
from scenarios.schema_parts import MapRoute, MapSpec
from scenarios.variation import Drawn

ROUTE_M = 200.0  # length of a route that is drawn
SHORTEST_ROUTE_M = 20.0
DRAWS = 100
REAR_M = 2.0  # room behind the rear axle where the map begins
AHEAD_M = 120.0  # the route goes on so far behind the end of the drive
AROUND_M = 130.0  # lanes that come this near to the route are part of the scene
LONGEST_S = 300.0  # of a drive
YELLOW_AHEAD_S = 4.0  # before the ego, on a free road, would pass the first light of its route


def map_drive(drawn: Drawn, vehicle: Vehicle) -> RecordedLog:
    """Read a map, choose a route on it and let the expert drive it.

    Args:
        drawn: Specification with ``map``.
        vehicle: Ego vehicle.

    Raises:
        InputError: A map that cannot be read, a place that it does not have, or no way between two
            places, with the position of its key.
    """
    spec = drawn.spec
    assert spec.map is not None
    path = drawn.document.folder_of(("map", "opendrive")) / spec.map.opendrive
    files = SourceFiles()
    with parsing(path, "repair this map, or use another one"):
        odr = parse_map(files, path, files.read_xml(path))
        odr = replace(odr, roads=tuple(sided(road) for road in odr.roads))
        origin = _origin(odr)
        T_local_map = np.eye(4)
        T_local_map[:3, 3] = -origin
        lanes, notes = read_lanes(files, path, odr, T_local_map)
    graph = LaneGraph(lanes)
    with drawn.at("map", "route"):
        way = _way(drawn, spec.map, graph, odr, T_local_map)
    if not any(way.lane_ids[0] in lane.successors for lane in lanes.values()):
        way = replace(way, start_m=max(way.start_m, REAR_M))
    goal_m = graph.line(way).length_m - way.beyond_m
    way = graph.carried_on(way, AHEAD_M)
    line = graph.line(way)
    near = _near(lanes, line)
    lane_map = bordered(odr, near, T_local_map)
    heads, light_notes = traffic_lights(odr, near, T_local_map)
    style = ExpertStyle(
        spec.ego.speed_mps,
        spec.ego.cruise_mps,
        spec.ego.max_lateral_accel_mps2,
        spec.ego.headway_s,
    )
    front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
    lane_map = replace(lane_map, signals=_timed(heads, line, front_m, spec.ego.cruise_mps))
    driven = _until(line, goal_m + front_m + 1.0)
    duration_us = spec.timing.duration_us
    end_us = round(LONGEST_S * 1e6)
    if duration_us is not None:
        end_us = spec.timing.start_us + spec.timing.start_time_offset_us + duration_us
    rng = stream(drawn.scene_id, spec.seed, "scenario/map/vehicles")
    followers = place_followers(LaneGraph(near), way, line, spec.map.vehicles, rng)
    run = drive(driven, 0.0, vehicle, style, (), followers, end_us, lane_map.signals)
    return RecordedLog(
        drawn.scene_id,
        "opendrive",
        lane_map,
        ground_of(lane_map, run.ego_log.xyz),
        run.ego_log,
        vehicle,
        vehicles(followers, run.followers),
        (),
        (float(origin[0]), float(origin[1]), 0.0),
        files.content_hash,
        (*_said(odr, way, goal_m, heads, len(followers)), *notes, *light_notes),
        route=Route(line.xyz[::4], way.lane_ids),
    )


def _origin(odr: OdrMap) -> F64:
    """Return the start ``(3,)`` of the first road, in whole metres: the subtraction loses
    nothing.
    """
    starts = [road.records[0] for road in odr.roads if road.records]
    if not starts:
        return np.zeros(3)
    return np.array([np.round(starts[0].x_m), np.round(starts[0].y_m), 0.0])


def _way(drawn: Drawn, spec: MapSpec, graph: LaneGraph, odr: OdrMap, T_local_map: F64) -> Way:
    """Return the route: between two places, or with an end that is drawn."""
    named = spec.route if isinstance(spec.route, MapRoute) else MapRoute()
    starts, goals = (
        None if text is None else _spots(text, graph, odr, T_local_map)
        for text in (named.from_, named.to)
    )
    rng = stream(drawn.scene_id, drawn.spec.seed, "scenario/map/route")
    best: Way | None = None
    longest_m = 0.0
    for _ in range(DRAWS):
        begin = starts or [graph.drawn_spot(rng)]
        if goals is not None:
            way = graph.between(begin, goals)
            if way is not None:
                return way
            if starts is not None:
                raise InputError(
                    f"no way along the lanes from {named.from_} to {named.to}",
                    "choose a place that lanes lead to, or exchange the two",
                )
            continue
        spot = begin[int(rng.integers(len(begin)))]
        way = graph.drawn(spot, ROUTE_M, rng)
        length_m = graph.driven_m(way)
        if length_m > longest_m:
            best, longest_m = way, length_m
        if length_m >= ROUTE_M:
            break
    if best is None or longest_m < SHORTEST_ROUTE_M:
        raise InputError(
            f"no route of {SHORTEST_ROUTE_M:.0f} m in {DRAWS} draws",
            "name map.route.from and map.route.to, or use a map with longer lanes",
        )
    return best


def _spots(text: str, graph: LaneGraph, odr: OdrMap, T_local_map: F64) -> list[Spot]:
    """Return the places on lanes for vehicles at ``ROAD:S``.

    Raises:
        InputError: There is no such road, it is shorter, or has no lane for vehicles there.
    """
    name, _, number = text.rpartition(":")
    s_m = float(number)
    roads = {road.road_id: road for road in odr.roads}
    road = roads.get(name)
    if road is None:
        near = difflib.get_close_matches(name, list(roads), n=3, cutoff=0.0)
        raise InputError(
            f"{text}: the map has no road {name!r}", f"choose a road such as {', '.join(near)}"
        )
    if s_m > road.length_m or not road.records or not road.sections:
        raise InputError(
            f"{text}: road {name} has lanes from 0 to {road.length_m:.1f} m", "choose a place on it"
        )
    spots = []
    for _, key, inner_t, outer_t in lanes_at(road, s_m):
        if key in graph.lanes:
            point = placed(road, np.array([[s_m, (inner_t + outer_t) / 2]]), T_local_map)[0]
            spots.append(Spot(key, project(graph.lanes[key].centre, point)[0]))
    if not spots:
        raise InputError(
            f"{text}: road {name} has no lane there on which a car fits", "choose another place"
        )
    return spots


def _near(lanes: dict[str, Lane], line: Path) -> dict[str, Lane]:
    """Return the lanes that come near to the route."""
    route = shapely.linestrings(line.xyz[::8, :2])
    shapely.prepare(route)
    centres = [shapely.linestrings(lane.centre[:, :2]) for lane in lanes.values()]
    close = shapely.dwithin(route, centres, AROUND_M)
    return {key: lane for (key, lane), keep in zip(lanes.items(), close, strict=True) if keep}


def _until(line: Path, length_m: float) -> Path:
    keep = line.s <= length_m
    return Path(line.s[keep], line.xyz[keep], line.yaw[keep], line.curvature[keep])


def _timed(
    heads: Sequence[Head], line: Path, front_m: float, cruise_mps: float
) -> tuple[Signal, ...]:
    """Return the lights with their cycles: the first one on the route turns yellow shortly before
    the ego, on a free road, would pass it.
    """
    signals = [head.signal for head in heads]
    first = next(iter(lights_on(line, signals)), None)
    begins_us: dict[str, int] = {}
    if first is not None:
        number = next(n for n, signal in enumerate(signals) if signal is first.signal)
        head, shown = heads[number], with_cycles(heads, {})[number]
        arrival_s = (first.s_m - front_m) / cruise_mps
        green_us = round((arrival_s - YELLOW_AHEAD_S - GREEN_S) * 1e6)
        begins_us[head.junction] = green_us - shown.offset_us
    return with_cycles(heads, begins_us)


def _said(
    odr: OdrMap, way: Way, goal_m: float, heads: Sequence[Head], vehicles: int
) -> tuple[str, ...]:
    """Return what was chosen, and the signs of the whole map by their type."""
    notes = [
        f"route of {goal_m:.0f} m from lane {way.lane_ids[0]}, with {vehicles} vehicles; the map "
        f"within {AROUND_M:.0f} m of it is used"
    ]
    signals = [one for road in odr.roads for one in road.signals]
    signs = Counter(one.kind for one in signals if not one.dynamic)
    if signals:
        listed = ", ".join(f"{kind} ({n})" for kind, n in sorted(signs.items()))
        notes.append(
            f"{sum(signs.values())} signs by type: {listed or 'none'}; "
            f"{len(signals) - sum(signs.values())} traffic lights"
        )
    if heads:
        notes.append(f"the map has no times of its lights: {CYCLE}")
    return tuple(notes)
