"""A drive on a map that has none: a route, an expert that drives it, and traffic around it.

Only the part of the map around the route enters the scene.
"""

import difflib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy  # its submodules load on first use
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.path_end import remaining
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Actor, Bool, LaneMap, Route, Signal, Vehicle
from alpasim_plugin.world.markings import with_default_markings
from alpasim_plugin.world.path import Path, smooth_path
from alpasim_plugin.world.signals import lights_on
from scenarios import lanelet2, opendrive
from scenarios.build import TRACKED_EVERY, with_last
from scenarios.countries import centre_line, first_from_right
from scenarios.ego_path import grid
from scenarios.expert import Follower, drive
from scenarios.junction_rules import turning_lines
from scenarios.map_cyclists import place_cyclists
from scenarios.map_lines import bordered, gaps_m, ground_of, link_notes
from scenarios.map_route import NARROWEST_M, STATION_M, WIDEST_M, LaneGraph, Spot, Way
from scenarios.map_traffic import Rides, place_followers, stopping_m
from scenarios.map_walkers import place_walkers
from scenarios.recorded import RecordedLog, SourceFiles
from scenarios.schema_parts import MapRoute, MapSpec
from scenarios.street_map import CYCLE, Head, StreetMap, with_cycles
from scenarios.unsigned_junctions import priority_lines
from scenarios.variation import SceneDraft

READERS = {"opendrive": opendrive.read_street, "lanelet2": lanelet2.read_street}
ROUTE_M = 200.0  # length of a route that is drawn
SHORTEST_ROUTE_M = 20.0
ROUNDING_M = 1e-6  # sums of lengths in another order differ by less
DRAWS = 100
REAR_M = 2.0  # room behind the rear axle where the map begins
AHEAD_M = 120.0  # the route goes on so far behind the end of the drive
AROUND_M = 130.0  # lanes that come this near to the route are part of the scene
DRIVEN_GAP_M = 1.0  # links across wider gaps are not driven
LONGEST_S = 300.0  # of a drive on a short route
LONGEST_SHARE = 3.0  # of the time that a long route takes at the cruising speed
SLOWER_SHARE = 1.5  # of the expert's time, which a policy may take
LEAST_WAIT_S = 30.0  # beyond that; where a light of the route has a longer cycle, one cycle
MOST_INSIDE_M = 0.6  # in bends: from the middle of the lane
EASED_M = 1.5  # length over which that offset is smoothed
YELLOW_AHEAD_S = 4.0  # before the ego, on a free road, would pass the first light of its route


def map_drive(draft: SceneDraft, vehicle: Vehicle) -> RecordedLog:
    """Read a map, choose a route on it and let the expert drive it.

    Args:
        draft: Specification with ``map``.
        vehicle: Ego vehicle.

    Raises:
        InputError: A map that cannot be read, a place that it does not have, or no way between two
            places, with the position of its key.
    """
    spec = draft.spec
    assert spec.map is not None
    files = SourceFiles()
    street, gap_notes = _without_gaps(_read_street(draft, spec.map, files))
    graph = LaneGraph(street.lanes)
    with draft.at("map", "route"):
        way = _way(draft, spec.map, graph, street)
    if not any(way.lane_ids[0] in lane.successors for lane in street.lanes.values()):
        way = replace(way, start_m=max(way.start_m, REAR_M))
    goal_m = graph.line(way).length_m - way.beyond_m
    way = graph.carried_on(way, AHEAD_M)
    line = graph.line(way)
    front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
    around = with_default_markings(_around(street, line), centre_line(street.country))
    lane_map, heads = _with_signals(street, around, line, front_m, spec.ego.cruise_mps)
    keep = line.s <= goal_m + front_m + 1.0
    driven = _inside_bends(
        Path(line.s[keep], line.xyz[keep], line.yaw[keep], line.curvature[keep]), front_m
    )
    limits = _TimeLimits.of(draft, driven, lane_map)
    followers, walkers = _traffic(draft, spec.map, lane_map, way, line, driven, front_m, limits)
    ego_log, vehicles = drive(
        driven,
        0.0,
        vehicle,
        spec.ego,
        walkers,
        followers,
        limits.expert_us,
        lane_map,
        graph.limits_mps(way, driven),
        limits.of_scene_us,
    )
    arrived_us = int(ego_log.t_us[-1])
    has_arrived = arrived_us < limits.expert_us
    return RecordedLog(
        draft.scene_id,
        spec.map.source[0],
        lane_map,
        ground_of(lane_map, ego_log.xyz),
        ego_log,
        vehicle,
        (*vehicles, *walkers),
        (),
        street.origin,
        files.content_hash,
        (*_notes(way, goal_m, heads, followers, spec.map.cyclists), *gap_notes, *street.notes),
        route=Route(line.xyz[::4], way.lane_ids),
        path_beyond=_up_to_goal(driven, driven.length_m - front_m - 1.0, ego_log.xyz),
        path_end="goal",
        goes_on_until_us=limits.of_scene_us(arrived_us) if has_arrived else None,
    )


def _read_street(draft: SceneDraft, spec: MapSpec, files: SourceFiles) -> StreetMap:
    kind, text = spec.source
    path = draft.document.folder_of(("map", kind)) / text
    with parsing(path, "repair this map, or use another one"):
        return READERS[kind](files, path)


@dataclass(frozen=True)
class _TimeLimits:
    """How long a drive on a route may take.

    Attributes:
        expert_us: Last time of the expert's drive.
        stated_us: Last time of the scene as the file states it; None: by the expert's arrival.
        wait_us: What a slower drive may wait in addition.
    """

    expert_us: int
    stated_us: int | None
    wait_us: int

    @classmethod
    def of(cls, draft: SceneDraft, driven: Path, lane_map: LaneMap) -> Self:
        """Return the limits of a route: the duration that the file states, or the longest that the
        expert may take.
        """
        lights = lights_on(driven, lane_map.signals, lane_map.lanes)
        cycles_us = [sum(us for _, us in light.signal.phases) for light in lights]
        wait_us = max([round(LEAST_WAIT_S * 1e6), *cycles_us])
        timing = draft.spec.timing
        if timing.duration_us is None:
            free_drive_s = driven.length_m / draft.spec.ego.cruise_mps
            longest_s = max(LONGEST_S, LONGEST_SHARE * free_drive_s)
            return cls(round(longest_s * 1e6), None, wait_us)
        stated_us = timing.start_us + timing.start_time_offset_us + timing.duration_us
        return cls(stated_us, stated_us, wait_us)

    def of_scene_us(self, arrived_us: int) -> int:
        """Return the last time of a scene in which the expert arrives at a time: a policy may be
        slower, and may miss a green light.
        """
        if self.stated_us is not None:
            return self.stated_us
        return round(SLOWER_SHARE * arrived_us) + self.wait_us


def _traffic(
    draft: SceneDraft,
    spec: MapSpec,
    lane_map: LaneMap,
    way: Way,
    line: Path,
    driven: Path,
    front_m: float,
    limits: _TimeLimits,
) -> tuple[Sequence[Follower], Sequence[Actor]]:
    """Return the drivers, with cyclists, and the walkers around the route, at places that the seed draws.

    Args:
        draft: Scene and seed.
        spec: How many of each.
        lane_map: The map around the route.
        way: The route.
        line: Its line, on past the goal.
        driven: The line of the rear axle up to the goal.
        front_m: From the rear axle to the front of the ego.
        limits: How long the scene lasts at most.
    """
    rides = Rides(lane_map, way, line)
    followers = place_followers(
        rides,
        spec.vehicles,
        stream(draft.scene_id, draft.spec.seed, "scenario/map/vehicles"),
        spec.lane_changes,
    )
    cyclists = place_cyclists(
        rides, spec.cyclists, stream(draft.scene_id, draft.spec.seed, "scenario/map/cyclists")
    )
    walkers = place_walkers(
        lane_map,
        driven,
        front_m,
        draft.spec.ego.cruise_mps,
        spec.pedestrians,
        grid(limits.of_scene_us(limits.expert_us)),
        stream(draft.scene_id, draft.spec.seed, "scenario/map/pedestrians"),
    )
    return [*followers, *cyclists], walkers


def _without_gaps(street: StreetMap) -> tuple[StreetMap, tuple[str, ...]]:
    """Return a map without the links over which nobody can drive, and notes on links whose lanes do
    not meet.
    """
    notes = list(link_notes(street.lanes))
    wide = {link for link, gap in gaps_m(street.lanes).items() if gap > DRIVEN_GAP_M}
    if not wide:
        return street, tuple(notes)
    notes.append(f"{len(wide)} links over gaps of more than {DRIVEN_GAP_M:g} m are not driven")
    lanes = {
        key: replace(lane, successors=tuple(s for s in lane.successors if (key, s) not in wide))
        for key, lane in street.lanes.items()
    }
    return replace(street, lanes=lanes), tuple(notes)


def _up_to_goal(line: Path, goal_m: float, driven: F64) -> F64:
    """Return the line ``(N, 3)`` of the rear axle between the end of a drive and the goal."""
    stations = np.append(np.arange(0.0, goal_m, STATION_M / 2), goal_m)
    return remaining(line.at(stations)[0], with_last(driven, TRACKED_EVERY))


def _way(draft: SceneDraft, spec: MapSpec, graph: LaneGraph, street: StreetMap) -> Way:
    """Return the route: between two places, or with an end that is drawn."""
    if not graph.lanes:
        raise InputError(
            f"the map has no lane for cars that is {NARROWEST_M:g} to {WIDEST_M:g} m wide everywhere",
            "use another map, or correct the widths of its lanes",
        )
    named = spec.route if isinstance(spec.route, MapRoute) else MapRoute()
    places = [_spots(text, graph, street) for text in (named.from_, *named.via, named.to) if text]
    rng = stream(draft.scene_id, draft.spec.seed, "scenario/map/route")
    if named.from_ is not None and named.to is not None:
        return _between(graph, named, places)
    ways = []
    for _ in range(DRAWS):
        begin = [] if named.from_ is not None else [[graph.drawn_spot(rng)]]
        way = _drawn(graph, [*begin, *places], named, rng)
        if way is None:
            continue
        ways.append(way)
        wanted_m = (named.length_m or ROUTE_M) - ROUNDING_M
        if named.to is not None or graph.driven_m(way) >= wanted_m:
            return way
    return _longest(graph, ways, named.length_m)


def _between(graph: LaneGraph, named: MapRoute, places: Sequence[Sequence[Spot]]) -> Way:
    """Return the shortest way between the named ends through the places between."""
    way = _shortest(graph, places)
    if way is None:
        passed = "".join(f" through {text}" for text in named.via)
        raise InputError(
            f"no way along the lanes from {named.from_} to {named.to}{passed}",
            "choose places that lanes lead to, each lane driven once, or exchange the two",
        )
    return way


def _shortest(graph: LaneGraph, places: Sequence[Sequence[Spot]]) -> Way | None:
    """Return the shortest way through places; None where no lanes lead through them."""
    if len(places) == 2:
        return graph.between(*places)
    return min(graph.through(places), key=graph.driven_m, default=None)


def _drawn(
    graph: LaneGraph,
    places: Sequence[Sequence[Spot]],
    named: MapRoute,
    rng: np.random.Generator,
) -> Way | None:
    """Return a way through places, and on to a drawn end where the end has no name; None where no
    lanes lead through them.
    """
    if named.to is not None:
        return _shortest(graph, places)
    spot = places[0][int(rng.integers(len(places[0])))]
    way = min(graph.through([[spot], *places[1:]]), key=graph.driven_m, default=None)
    return None if way is None else graph.drawn(way, named.length_m or ROUTE_M, rng)


def _longest(graph: LaneGraph, ways: Sequence[Way], length_m: float | None) -> Way:
    """Return the longest of the drawn ways that are shorter than wanted.

    Raises:
        InputError: All are shorter than a route may be, or than the length that the user wants.
    """
    longest = max(ways, key=graph.driven_m, default=None)
    longest_m = 0.0 if longest is None else graph.driven_m(longest)
    least_m = length_m or SHORTEST_ROUTE_M
    if longest is None or longest_m < least_m - ROUNDING_M:
        raise InputError(
            f"no route of {least_m:.0f} m in {DRAWS} draws; the longest has {longest_m:.0f} m",
            "name map.route.from and map.route.to, or use a map with longer lanes",
        )
    return longest


def _spots(text: str, graph: LaneGraph, street: StreetMap) -> list[Spot]:
    """Return the places on lanes for vehicles at ``ROAD:S``.

    Raises:
        InputError: There is no such road, it is shorter, or has no lane for vehicles there.
    """
    name, _, number = text.rpartition(":")
    length_m = street.roads.get(name)
    if length_m is None:
        near = difflib.get_close_matches(name, list(street.roads), n=3, cutoff=0.0)
        raise InputError(
            f"{text}: the map has no road {name!r} with lanes",
            f"choose a road such as {', '.join(near)}",
        )
    if float(number) > length_m:
        raise InputError(
            f"{text}: road {name} has lanes from 0 to {length_m:.1f} m", "choose a place on it"
        )
    spots = [spot for spot in street.spots(name, float(number)) if spot.lane_id in graph.lanes]
    if not spots:
        raise InputError(
            f"{text}: road {name} has no lane there on which a car fits", "choose another place"
        )
    return spots


def _near(line: Path, shapes: Sequence[F64]) -> Bool:
    """Return which polylines and points come near to the route, by their vertices."""
    route = shapely.linestrings(line.xyz[::8, :2])
    shapely.prepare(route)
    places = [shapely.multipoints(shape[:, :2]) for shape in shapes]
    return shapely.dwithin(route, places, AROUND_M)


def _around(street: StreetMap, line: Path) -> LaneMap:
    """Return the part of a map around the route."""
    beside = street.beside

    def kept(shapes: Sequence[F64]) -> tuple[F64, ...]:
        return tuple(itertools.compress(shapes, _near(line, shapes)))

    lanes = list(street.lanes.items())
    middles = [pose[None, :3, 3] for pose, _ in beside.signs]
    return bordered(
        dict(itertools.compress(lanes, _near(line, [lane.centre for _, lane in lanes]))),
        replace(
            beside,
            crosswalks=kept(beside.crosswalks),
            stop_lines=kept(beside.stop_lines),
            poles=kept(beside.poles),
            signs=tuple(itertools.compress(beside.signs, _near(line, middles))),
        ),
    )


def _with_signals(
    street: StreetMap, lane_map: LaneMap, line: Path, front_m: float, cruise_mps: float
) -> tuple[LaneMap, list[Head]]:
    """Return the part of a map around the route with its lights and lines of give-way, and the heads
    of its lights.
    """

    def is_part(signal: Signal) -> bool:
        return any(key in lane_map.lanes for key in signal.lanes)

    heads = [head for head in street.heads if is_part(head.signal)]
    lights = _timed(heads, line, lane_map, front_m, cruise_mps)
    signed = [signal for signal in street.give_way if is_part(signal)]
    from_right = first_from_right(street.country)
    unlit = priority_lines(lane_map.lanes, lights, signed, from_right)
    give_way = (*signed, *turning_lines(lights, lane_map.lanes), *unlit)
    return replace(lane_map, signals=lights, give_way=give_way), heads


def _inside_bends(line: Path, front_m: float) -> Path:
    """Return the line of the rear axle, moved to the inside of bends by half of what the front of
    the car swings out there.
    """
    swing_m = front_m**2 * line.curvature / 2
    inside_m = np.clip(swing_m / 2, -MOST_INSIDE_M, MOST_INSIDE_M)
    smooth_m = scipy.ndimage.gaussian_filter1d(inside_m, EASED_M / line.s[1], mode="nearest")
    stations = np.linspace(0.0, line.length_m, int(line.length_m / STATION_M) + 2)
    return smooth_path(line.at(stations, np.interp(stations, line.s, smooth_m))[0])


def _timed(
    heads: Sequence[Head], line: Path, lane_map: LaneMap, front_m: float, cruise_mps: float
) -> tuple[Signal, ...]:
    """Return the lights with their cycles: the first one on the route turns yellow shortly before
    the ego, on a free road, would pass it; one that is too near to stop at is green then.
    """
    signals = [head.signal for head in heads]
    lights = lights_on(line, signals, lane_map.lanes)
    first = next((light for light in lights if light.s_m >= front_m), None)
    begins_us: dict[str, int] = {}
    if first is not None:
        number = next(n for n, signal in enumerate(signals) if signal is first.signal)
        head = heads[number]
        timed_signal = with_cycles(heads, {})[number]
        gap_m = first.s_m - front_m
        green_us = timed_signal.phases[0][1]
        passed_us = round(YELLOW_AHEAD_S * 1e6) + green_us  # since it has turned green
        if gap_m < stopping_m(cruise_mps):
            passed_us = green_us // 2
        turns_green_us = round(gap_m / cruise_mps * 1e6) - passed_us
        begins_us[head.junction] = turns_green_us - timed_signal.offset_us
    return with_cycles(heads, begins_us)


def _notes(
    way: Way,
    goal_m: float,
    heads: Sequence[Head],
    followers: Sequence[Follower],
    wanted_cyclists: int,
) -> tuple[str, ...]:
    """Return what was chosen."""
    cyclists = sum(follower.label == "cyclist" for follower in followers)
    placed = f"{len(followers) - cyclists} vehicles"
    placed += f" and {cyclists} of {wanted_cyclists} cyclists" if wanted_cyclists else ""
    notes = [
        f"route of {goal_m:.0f} m from lane {way.lane_ids[0]}, with {placed}; the map "
        f"within {AROUND_M:.0f} m of it is used"
    ]
    if heads:
        notes.append(f"the map has no times of its lights: {CYCLE}")
    return tuple(notes)
