"""What stands on and beside the roads of an OpenDRIVE map: crosswalks, stop lines, signs and traffic
lights.

Source: ASAM OpenDRIVE 1.4 to 1.8, chapters on signals and objects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.geometry import direction_of, heading_of, se2
from alpasim_plugin.core.types import F64, Box, Lane, LaneMap, Signal
from scenarios.light_posts import Carriageway, Post
from scenarios.opendrive_road import (
    CROSSWALK,
    CROSSWALK_M,
    STOP_LINE,
    OdrMap,
    Road,
    RoadSignal,
    driven_along,
    lanes_at,
    placed,
    reference_line,
)
from scenarios.street_map import Head

PEDESTRIAN_LIGHT = "1000002"
GIVE_WAY = ("205", "206")  # give way; stop
STOP_REACH_M = 25.0  # a light is waited for at a stop line that is no farther away than this
OPEN_ROAD = "on road "  # and its name: of a light whose road leads to no junction
PLATE_M = 0.1  # what is lower than this is painted on the road


def roadside(odr: OdrMap, lanes: Mapping[str, Lane], T_local_map: F64) -> LaneMap:
    """Return a map without lanes: the crosswalks, stop lines, signs and posts of lights of the roads
    of ``lanes``.
    """
    crosswalks = []
    stop_lines = []
    signs = []
    for road in _roads(odr, lanes):
        crosswalks += [placed(road, ring, T_local_map) for ring in road.crosswalks]
        for signal in road.signals:
            if signal.kind == STOP_LINE:
                held = [
                    _lanes_at(road, signal.s_m, along, signal, lanes)
                    for along in _senses(road, signal)
                ]
                stop_lines += [
                    placed(road, _line(signal.s_m, direction_lanes), T_local_map)
                    for direction_lanes in held
                    if direction_lanes
                ]
            elif not signal.dynamic and signal.kind != CROSSWALK and signal.height_m > PLATE_M:
                heading = _heading_rad(
                    road, signal.s_m, (*_senses(road, signal), True)[0], T_local_map
                )
                x, y, z = placed(road, np.array([[signal.s_m, signal.t_m]]), T_local_map)[
                    0
                ].tolist()
                pose = se2(x, y, heading, z + signal.above_m + signal.height_m / 2)
                signs.append((pose, Box(0.05, signal.width_m, signal.height_m)))
    return LaneMap(
        {},
        crosswalks=tuple(crosswalks),
        stop_lines=tuple(stop_lines),
        poles=tuple(post.line for post in light_posts(odr, lanes, T_local_map).by_place.values()),
        signs=tuple(signs),
    )


def traffic_lights(
    odr: OdrMap, lanes: Mapping[str, Lane], T_local_map: F64
) -> tuple[tuple[Head, ...], tuple[str, ...]]:
    """Return the traffic lights of the roads of ``lanes``, one for each place and direction, and
    notes on lights that hold back no lane.

    A light is waited for at the nearest stop line of its direction, without one beside itself; one
    that stands on a road inside of a junction, where that road's lanes begin. One light before a
    junction and behind it, for those who leave it, is a post across the junction: it holds those
    before it.
    """
    heads = []
    loose: dict[str, None] = {}
    posts = light_posts(odr, lanes, T_local_map)
    for road in _roads(odr, lanes):
        for light in (signal for signal in road.signals if signal.dynamic):
            post = posts.of(road, light)
            lamps = None if post is None else post.lamps
            light_heads = [
                replace(head, signal=replace(head.signal, head=lamps))
                for head in _heads(road, light, odr.controllers, lanes, T_local_map)
            ]
            heads += light_heads
            loose |= {} if light_heads else {light.signal_id: None}
    holding = {head.signal.name for head in heads}
    at_junction = {head.signal.name for head in heads if not head.junction.startswith(OPEN_ROAD)}
    heads = [
        head
        for head in heads
        if not head.junction.startswith(OPEN_ROAD) or head.signal.name not in at_junction
    ]
    idle = [name for name in loose if name not in holding]
    notes = [f"{len(idle)} traffic lights hold back no lane: {some_of(idle)}"] if idle else []
    return tuple(heads), tuple(notes)


def give_way_lines(odr: OdrMap, lanes: Mapping[str, Lane], T_local_map: F64) -> tuple[Signal, ...]:
    """Return the lines of signs to give way, of traffic before a junction."""
    return tuple(
        head.signal
        for road in _roads(odr, lanes)
        for signal in road.signals
        if signal.kind in GIVE_WAY
        for head in _heads(road, signal, odr.controllers, lanes, T_local_map)
    )


Place = tuple[str, str, float, float]  # a road, a light on it, and its place there: s and t, metres


@dataclass(frozen=True)
class LightPosts:
    """The posts of the traffic lights of a map. Each stands once, where the map writes the light:
    what other roads say of it by reference is whom it holds.

    Attributes:
        by_place: The posts. Some maps give several lights one id.
        by_id: Of lights with one id the first, for references.
    """

    by_place: Mapping[Place, Post]
    by_id: Mapping[str, Post]

    def of(self, road: Road, light: RoadSignal) -> Post | None:
        """Return the post of a light; None of a reference to one that stands nowhere."""
        if light.by_reference:
            return self.by_id.get(light.signal_id)
        return self.by_place.get(_place(road, light))


def _place(road: Road, light: RoadSignal) -> Place:
    return road.road_id, light.signal_id, light.s_m, light.t_m


def light_posts(odr: OdrMap, lanes: Mapping[str, Lane], T_local_map: F64) -> LightPosts:
    """Return the posts of the traffic lights of a map."""
    surface = Carriageway(lanes)
    by_place: dict[Place, Post] = {}
    by_id: dict[str, Post] = {}
    for road in odr.roads:
        for light in (signal for signal in road.signals if signal.dynamic):
            if not light.by_reference and road.records:
                foot = placed(road, np.array([[light.s_m, light.t_m]]), T_local_map)[0]
                lamps_m = light.above_m + light.height_m / 2
                post = surface.post(foot, lamps_m)
                by_place[_place(road, light)] = post
                by_id.setdefault(light.signal_id, post)
    return LightPosts(by_place, by_id)


def _roads(odr: OdrMap, lanes: Mapping[str, Lane]) -> list[Road]:
    kept = {key.rpartition(".")[0].rpartition(".")[0] for key in lanes}
    return [road for road in odr.roads if road.road_id in kept]


def _heads(
    road: Road,
    light: RoadSignal,
    controllers: Mapping[str, str],
    lanes: Mapping[str, Lane],
    T_local_map: F64,
) -> list[Head]:
    heads = []
    for along in _held_senses(road, light, lanes):
        link = road.successor if along else road.predecessor
        junction = f"{OPEN_ROAD}{road.road_id}"
        stop_lines = [
            line.s_m
            for line in road.signals
            if line.kind == STOP_LINE
            and along in _senses(road, line)
            and abs(line.s_m - light.s_m) <= STOP_REACH_M
        ]
        s_m = min(stop_lines, key=lambda stop_m: abs(stop_m - light.s_m), default=light.s_m)
        if road.junction != "-1":
            junction = road.junction
            s_m = 0.0 if along else road.length_m
        elif link is not None and link.kind == "junction":
            junction = link.target
        if light.kind == PEDESTRIAN_LIGHT:
            signal = _for_people(road, light, lanes, T_local_map)
        else:
            held = _lanes_at(road, s_m, along, light, lanes)
            if not held:
                continue
            ends = placed(road, _line(s_m, held), T_local_map)
            signal = Signal(
                ends, _heading_rad(road, s_m, along, T_local_map), (), 0, light.signal_id,
                tuple(key for key, _, _ in held),
            )  # fmt: skip
        group = controllers.get(light.signal_id, "")
        heads.append(Head(signal, junction, group, road.road_id))
    return heads


def _for_people(
    road: Road, light: RoadSignal, lanes: Mapping[str, Lane], T_local_map: F64
) -> Signal:
    """Return the light of those who cross a road: they wait at the side of the nearest crosswalk
    that the light stands on.
    """
    rings = [ring for ring in road.crosswalks if abs(ring[:, 0].mean() - light.s_m) <= STOP_REACH_M]
    low_m = light.s_m - CROSSWALK_M / 2
    high_m = light.s_m + CROSSWALK_M / 2
    if rings:
        ring = min(rings, key=lambda ring: abs(float(ring[:, 0].mean()) - light.s_m))
        low_m = float(ring[:, 0].min())
        high_m = float(ring[:, 0].max())
    ends = placed(road, np.array([[low_m, light.t_m], [high_m, light.t_m]]), T_local_map)
    towards = -np.pi / 2 if light.t_m > 0 else np.pi / 2
    heading = _heading_rad(road, light.s_m, True, T_local_map) + towards
    crossed = [
        key
        for along in (True, False)
        for key, _, _ in _lanes_at(road, light.s_m, along, None, lanes)
    ]
    return Signal(ends, heading, (), 0, light.signal_id, tuple(crossed), pedestrians=True)


def _senses(road: Road, signal: RoadSignal) -> tuple[bool, ...]:
    """Return whether a signal is for traffic along its road, against it, or both; nothing where the
    lanes that it names are none: RoadRunner's posts stand for references on other roads.

    The lanes decide where all of them are driven against the orientation, as CARLA reads RoadRunner's
    references. Lights for people name lane 0: they stand for none.
    """
    facing = {"+": (True,), "-": (False,)}.get(signal.orientation, (True, False))
    if not signal.lanes or signal.kind == PEDESTRIAN_LIGHT:
        return facing
    driven = {
        driven_along(road, lane)
        for section in road.sections
        for lane in section.lanes
        if lane.lane_id != 0 and signal.holds(lane.lane_id)
    }
    return tuple(sense for sense in facing if sense in driven) or tuple(driven)


def _held_senses(road: Road, light: RoadSignal, lanes: Mapping[str, Lane]) -> tuple[bool, ...]:
    """Return `_senses` of a light; of one that names no lanes and stands on a road of a junction the
    other one where that alone has lanes: RoadRunner writes the sign of the lanes, and such roads are
    one-way.
    """
    senses = _senses(road, light)
    if light.lanes or light.kind == PEDESTRIAN_LIGHT or road.junction == "-1":
        return senses
    starts_m = {True: 0.0, False: road.length_m}
    if any(_lanes_at(road, starts_m[along], along, light, lanes) for along in senses):
        return senses
    return tuple(not along for along in senses)


Held = tuple[str, float, float]  # a lane and the signed distances of its borders


def _lanes_at(
    road: Road, s_m: float, along: bool, signal: RoadSignal | None, lanes: Mapping[str, Lane]
) -> list[Held]:
    """Return the lanes of one direction for vehicles, where a signal names some, only those."""
    candidates = []
    for lane, key, inner_t, outer_t in lanes_at(road, s_m):
        made = lanes.get(key)
        for_vehicles = made is not None and made.kind in ("vehicle", "bus")
        if for_vehicles and driven_along(road, lane) == along:
            candidates.append((lane.lane_id, (key, inner_t, outer_t)))
    return [held for lane_id, held in candidates if signal is None or signal.holds(lane_id)]


def _line(s_m: float, held: Sequence[Held]) -> F64:
    """Return the ends ``(2, 2)``, s and t, of a line across lanes."""
    borders = [border for _, inner_t, outer_t in held for border in (inner_t, outer_t)]
    return np.array([[s_m, min(borders)], [s_m, max(borders)]])


def _heading_rad(road: Road, s_m: float, along: bool, T_local_map: F64) -> float:
    heading = float(reference_line(road.records, np.array([s_m]))[0, 2])
    direction = T_local_map[:2, :2] @ direction_of(heading)
    return float(heading_of(direction)) + (0.0 if along else np.pi)
