"""OpenDRIVE maps as lane maps: lanes of every section with edges, links and markings, the border of
the drivable surface, and the place.

Lanes follow one another along sections, from road to road, and through junctions. A map lies in a
scene's local frame by its geographic origin and the scene's pose on the earth.

Source: ASAM OpenDRIVE 1.4 to 1.8. `scenarios.usdz` reads the same roads by AlpaSim's rule instead.
"""

import contextlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, some_of
from alpasim_plugin.core.files.limits import LATERAL_OFFSET_M
from alpasim_plugin.core.geometry import densify, direction_of, project, rigid, shifted
from alpasim_plugin.core.types import F64, I64, Lane, LaneMap, LaneMarkType
from scenarios.junction_marks import Side, with_open_junctions
from scenarios.map_lines import bordered
from scenarios.map_route import Spot
from scenarios.opendrive_road import (
    JOIN_M,
    MAX_ROAD_M,
    Geometry,
    OdrLane,
    OdrMap,
    Road,
    RoadMark,
    Section,
    beside,
    cubics_at,
    driven_along,
    gap_m,
    lane_borders,
    lane_key,
    lanes_at,
    limits_in,
    parse_map,
    placed,
    reference_line,
    road_points,
)
from scenarios.opendrive_signals import give_way_lines, roadside, traffic_lights
from scenarios.recorded import SourceFiles
from scenarios.street_map import StreetMap

# WGS 84 ellipsoid (NIMA TR8350.2).
SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
STEP_M = 0.5  # stations on bends and where widths change
MAX_TURN_RAD = (
    0.2  # of a road between two stations: an edge 7 m from the middle of a bend is 3.5 cm off
)
STRAIGHT_STEP_M = 2.0
MAX_OFFSET_M = LATERAL_OFFSET_M.high
MAX_MISSING_M = 1.0  # by which a reference line may be shorter than its road; it is extended
BACK_M = 1e-3  # by which an edge may run back
FORWARDS = 0.5  # cosine between the road and a step of an edge, where others run back
MIN_WIDTH_M = 0.1  # lanes that never reach this width are ignored
KINDS = {
    **dict.fromkeys(
        (
            "driving",
            "entry",
            "exit",
            "onRamp",
            "offRamp",
            "connectingRamp",
            "slipLane",
            "bidirectional",
        ),
        "vehicle",
    ),
    **dict.fromkeys(("bus", "taxi", "HOV"), "bus"),
    **dict.fromkeys(("shoulder", "stop"), "shoulder"),
    "biking": "bike",
    "parking": "parking",
}
OFF_THE_ROAD = "points that are not finite or not on a road"
_SOLID = ("solid", "solid solid", "solid broken", "broken solid")


def following(odr: OdrMap, lanes: Mapping[str, Lane]) -> tuple[dict[str, Lane], tuple[str, ...]]:
    """Return the lanes with their successors in driving direction, and notes; links to lanes that
    are not in ``lanes`` are left out.
    """
    roads = {road.road_id: road for road in odr.roads}
    turns, n_bare = _turns(odr, roads)
    notes = []
    if n_bare:
        notes.append(
            f"{n_bare} connections of junctions name no lanes: lanes of the same direction are linked by their number"
        )
    out = dict(lanes)
    ends = []
    opposed = []
    for road in odr.roads:
        for index, section in enumerate(road.sections):
            for lane in section.lanes:
                key = lane_key(road, index, lane.lane_id)
                if key not in out:
                    continue
                successors = []
                for name, is_entered in _ahead(road, index, lane, roads, turns).items():
                    if name in lanes and is_entered:
                        successors.append(name)
                    elif name in lanes:
                        opposed.append(f"{key} to {name}")
                out[key] = replace(out[key], successors=tuple(successors))
                link = road.successor if driven_along(road, lane) else road.predecessor
                if not successors and link is not None and out[key].kind == "vehicle":
                    ends.append(key)
    if opposed:
        notes.append(
            f"{len(opposed)} links join lanes that are driven against each other, and are not followed: {some_of(opposed)}"
        )
    if ends:
        notes.append(
            f"{len(ends)} lanes end although their road goes on, for want of a link: {some_of(ends)}"
        )
    return out, tuple(notes)


Turns = Mapping[tuple[str, str, int], list[tuple[str, bool, int]]]


def _turns(odr: OdrMap, roads: Mapping[str, Road]) -> tuple[Turns, int]:
    """Return the lanes that junctions link: from junction, road and lane to road, which of its ends,
    and lane; and how many connections name no lanes.
    """
    turns: dict[tuple[str, str, int], list[tuple[str, bool, int]]] = {}
    n_bare = 0
    for connection in odr.connections:
        incoming = roads.get(connection.incoming)
        connecting = roads.get(connection.connecting)
        if incoming is None or connecting is None:
            continue
        after = incoming.successor
        from_start = after is None or (after.kind, after.target) != (
            "junction",
            connection.junction,
        )
        links = connection.lanes
        if not links:
            n_bare += 1
            # Both roads run the same way unless they meet start to start, or end to end.
            sign = -1 if from_start == connection.at_start else 1
            end_section = incoming.sections[0 if from_start else -1 :][:1]
            links = tuple(
                (lane.lane_id, sign * lane.lane_id) for s in end_section for lane in s.lanes
            )
        for a, b in links:
            key = connection.junction, connection.incoming, a
            turns.setdefault(key, []).append((connection.connecting, connection.at_start, b))
            if connection.direct:
                key = connection.junction, connection.connecting, b
                turns.setdefault(key, []).append((connection.incoming, from_start, a))
    return turns, n_bare


def _ahead(
    road: Road, index: int, lane: OdrLane, roads: Mapping[str, Road], turns: Turns
) -> dict[str, bool]:
    """Return the keys of the lanes that are linked to the end of a lane of the section ``index`` of a
    road, and whether they begin there: two shoulders around a corner may end at each other.
    """
    along = driven_along(road, lane)
    linked = lane.successors if along else lane.predecessors
    next_section = index + (1 if along else -1)
    if 0 <= next_section < len(road.sections):
        linked = linked or _linked_inside(lane, road.sections, index, along)
        return dict(_met(road, next_section, along, i) for i in linked)
    link = road.successor if along else road.predecessor
    if link is None:
        return {}
    if link.kind == "junction":
        connected = turns.get((link.target, road.road_id, lane.lane_id), [])
        return dict(
            _met(roads[target], _entered(roads[target], at_start), at_start, i)
            for target, at_start, i in connected
        )
    target = roads.get(link.target)
    if target is None or not target.sections:
        return {}
    linked = linked or _linked_back(road, lane, target, link.at_start)
    return dict(_met(target, _entered(target, link.at_start), link.at_start, i) for i in linked)


def _met(road: Road, index: int, at_start: bool, lane_id: int) -> tuple[str, bool]:
    """Return the key of a lane that is met at the start or the end of a section, and whether it is
    driven on from there.
    """
    is_entered = any(
        driven_along(road, lane) == at_start
        for lane in road.sections[index].lanes
        if lane.lane_id == lane_id
    )
    return lane_key(road, index, lane_id), is_entered


def _linked_inside(
    lane: OdrLane, sections: Sequence[Section], index: int, along: bool
) -> tuple[int, ...]:
    """Return the lanes of the next section of a road that follow a lane without links: those that
    name it, or the one of its number where no lane has a link from this section to that one.
    """
    begin, end = index, index + (1 if along else -1)
    ahead = [other.successors if along else other.predecessors for other in sections[begin].lanes]
    back = {
        other.lane_id: other.predecessors if along else other.successors
        for other in sections[end].lanes
    }
    if not any(ahead) and not any(back.values()):
        return (lane.lane_id,)
    return tuple(name for name, linked in back.items() if lane.lane_id in linked)


def _entered(road: Road, at_start: bool) -> int:
    """Return the section through which a road is entered."""
    return 0 if at_start else len(road.sections) - 1


def _linked_back(road: Road, lane: OdrLane, target: Road, at_start: bool) -> tuple[int, ...]:
    """Return the lanes of the next road ``target`` that name a lane as the one before them: a link
    may stand in the other road alone.
    """
    back = target.predecessor if at_start else target.successor
    if back is None or (back.kind, back.target) != ("road", road.road_id):
        return ()
    lanes = target.sections[_entered(target, at_start)].lanes
    return tuple(
        target_lane.lane_id
        for target_lane in lanes
        if driven_along(target, target_lane) == at_start
        and lane.lane_id in (target_lane.predecessors if at_start else target_lane.successors)
    )


def T_local_map(geo_reference: str, T_earth_local: F64) -> F64:
    """Return the ``(4, 4)`` transform from map coordinates to the local frame, as AlpaSim places a
    map.

    The map's coordinates are taken as east, north, up at the ``lat_0``, ``lon_0`` (and ``alt_0`` or
    ``h_0``) of its projection string; the projection itself is not applied. Without a usable origin
    the map lies in the local frame as it is.

    Args:
        geo_reference: PROJ string of the map.
        T_earth_local: ``(4, 4)`` pose of the local frame in earth-centred, earth-fixed coordinates.
    """
    origin = geographic_origin(geo_reference)
    if origin is None:
        return np.eye(4)
    return np.asarray(np.linalg.inv(T_enu_earth(*origin) @ T_earth_local), dtype=np.float64)


def geographic_origin(geo_reference: str) -> tuple[float, float, float] | None:
    """Return latitude and longitude in degrees and height in metres of a PROJ string; None where it
    names none or an impossible one.
    """
    values: dict[str, float] = {}
    for name, text in re.findall(r"\+(lat_0|lon_0|alt_0|h_0)[^\s=]*=(\S*)", geo_reference):
        # AlpaSim passes over words it cannot read; real files hold some.
        with contextlib.suppress(ValueError):
            values["alt_0" if name == "h_0" else name] = float(text)
    lat_deg = values.get("lat_0", np.nan)
    lon_deg = values.get("lon_0", np.nan)
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
        return None
    return lat_deg, lon_deg, values.get("alt_0", 0.0)


def earth_xyz(lat_deg: F64 | float, lon_deg: F64 | float, height_m: F64 | float) -> F64:
    """Return earth-centred, earth-fixed coordinates ``(..., 3)`` in metres."""
    lat, lon, height = np.broadcast_arrays(np.deg2rad(lat_deg), np.deg2rad(lon_deg), height_m)
    e2 = FLATTENING * (2.0 - FLATTENING)
    n = SEMI_MAJOR_M / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    level = (n + height) * np.cos(lat)
    z = (n * (1.0 - e2) + height) * np.sin(lat)
    return np.stack([level * np.cos(lon), level * np.sin(lon), z], axis=-1)


def T_enu_earth(lat_deg: float, lon_deg: float, height_m: float) -> F64:
    """Return the ``(4, 4)`` transform from earth-centred coordinates to east, north, up at a
    place.
    """
    lat = np.deg2rad(lat_deg)
    lon = np.deg2rad(lon_deg)
    place = earth_xyz(lat_deg, lon_deg, height_m)
    east = [-np.sin(lon), np.cos(lon), 0.0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    turn = np.array([east, north, up])
    return rigid(turn, -turn @ place)


def lane_map_of(
    location: Path | str, odr: OdrMap, T_local_map: F64
) -> tuple[LaneMap, tuple[str, ...]]:
    """Return the lane map of a parsed file in the local frame, with notes on what was left out.

    States of traffic lights are not known of a map.

    Raises:
        InputError: No road has a lane for vehicles.
    """
    lanes, notes = read_lanes(location, odr, T_local_map)
    return bordered(lanes, roadside(odr, lanes, T_local_map)), notes


def read_lanes(
    location: Path | str, odr: OdrMap, T_local_map: F64
) -> tuple[dict[str, Lane], tuple[str, ...]]:
    """Return the linked lanes of a parsed file in the local frame, with notes on what was left out.

    Lane ids are ``ROAD.SECTION.LANE``. Edges and centres are sampled every 0.5 m and 0.2 rad on
    bends, every 0.5 m where a width changes, else every 2 m.

    Raises:
        InputError: No road has a lane for vehicles.
    """
    lanes: dict[str, Lane] = {}
    left_out: Counter[str] = Counter()
    unlike = []
    apart = []
    changing: list[str] = []
    for road in odr.roads:
        place = f"{location}, road {road.road_id}"
        for index, section in enumerate(road.sections):
            if not road.records or section.end_m - section.s_m <= 1e-6:
                left_out["any, in a section without length or geometry"] += len(section.lanes)
                continue
            with parsing(f"{place}, section {index}", "repair its numbers"):
                section_lanes = _section(road, index, section, T_local_map, left_out, changing)
            lanes.update({lane.lane_id: lane for lane in section_lanes})
        missing = road.length_m - _end_m(road)
        if missing > MAX_MISSING_M:
            raise InputError(
                f"{place}: a reference line that ends {missing:g} m before the road of {road.length_m:g} m",
                "correct the length of the road, or add the records that lack",
            )
        if abs(missing) > JOIN_M:
            unlike.append(f"{road.road_id} ({-missing:+.2f} m)")
        gap = gap_m(road)
        if gap > JOIN_M:
            apart.append(f"{road.road_id} ({gap:.2f} m)")
    if not any(lane.kind == "vehicle" for lane in lanes.values()):
        raise InputError(
            f"{location}: a map without a lane for vehicles", "use a map with lanes of type driving"
        )
    linked, link_notes = following(odr, _open_junctions(odr, lanes))
    notes = [f"lanes of type {kind} left out: {n}" for kind, n in sorted(left_out.items())]
    if changing:
        notes.append(
            f"{len(changing)} lanes change their speed limit inside a section, of which the lowest holds all along: {some_of(changing)}"
        )
    if unlike:
        notes.append(
            f"{len(unlike)} reference lines are not as long as their road: {some_of(unlike)}"
        )
    if apart:
        notes.append(f"{len(apart)} reference lines whose records do not join: {some_of(apart)}")
    return linked, (*notes, *link_notes, *odr.notes)


def _end_m(road: Road) -> float:
    """Return where the last record of a road's reference line ends; without records its length."""
    return max((record.s_m + record.length_m for record in road.records), default=road.length_m)


def read_street(files: SourceFiles, path: Path) -> StreetMap:
    """Read a map for a drive on it. Its origin is the start of the first road, in whole metres: the
    subtraction loses nothing.

    Raises:
        InputError: The file is no map, or broken.
    """
    odr = parse_map(path, files.read_xml(path))
    starts = [road.records[0] for road in odr.roads if road.records]
    origin = (np.round(starts[0].x_m), np.round(starts[0].y_m), 0.0) if starts else (0.0, 0.0, 0.0)
    T_local_map = shifted(*np.negative(origin))
    lanes, notes = read_lanes(path, odr, T_local_map)
    heads, light_notes = traffic_lights(odr, lanes, T_local_map)
    roads = {road.road_id: road for road in odr.roads if road.records and road.sections}

    def spots(name: str, s_m: float) -> list[Spot]:
        road = roads[name]
        nearby_spots = []
        for _, key, inner_t, outer_t in lanes_at(road, s_m):
            if key in lanes:
                middle = np.array([[s_m, (inner_t + outer_t) / 2]])
                point = placed(road, middle, T_local_map)[0]
                nearby_spots.append(Spot(key, project(lanes[key].centre, point)[0]))
        return nearby_spots

    return StreetMap(
        lanes,
        roadside(odr, lanes, T_local_map),
        heads,
        give_way_lines(odr, lanes, T_local_map),
        {name: road.length_m for name, road in roads.items()},
        spots,
        origin,
        (*_signs_by_type(odr), *notes, *light_notes),
        odr.country,
    )


def _signs_by_type(odr: OdrMap) -> tuple[str, ...]:
    signals = [signal for road in odr.roads for signal in road.signals]
    if not signals:
        return ()
    signs = Counter(signal.kind for signal in signals if not signal.dynamic)
    listed = ", ".join(f"{kind} ({n})" for kind, n in sorted(signs.items()))
    return (
        f"{signs.total()} signs by type: {listed or 'none'}; "
        f"{len(signals) - signs.total()} traffic lights",
    )


def _section(
    road: Road,
    index: int,
    section: Section,
    T_local_map: F64,
    left_out: Counter[str],
    changing: list[str],
) -> list[Lane]:
    """Return the lanes of a section; lanes whose speed limit changes inside of it are added to
    ``changing``.

    Raises:
        ValueError: Its numbers give no road.
    """
    s = _stations(road, section)
    line = reference_line(road.records, s)
    if not (
        np.abs(line[:, :2] - line[0, :2]).max() <= MAX_ROAD_M
        and np.abs(cubics_at(road.elevation, s)).max() <= MAX_ROAD_M
        and np.isfinite(np.tan(cubics_at(road.superelevation, s))).all()
    ):
        raise ValueError(OFF_THE_ROAD)
    lanes = []
    for lane, inner_t, outer_t in lane_borders(road, section, s):
        if not np.abs(outer_t).max() <= MAX_OFFSET_M:
            raise ValueError(OFF_THE_ROAD)
        if lane.kind not in KINDS:
            left_out[lane.kind] += 1
            continue
        if float(np.abs(outer_t - inner_t).max()) < MIN_WIDTH_M:
            left_out[f"{lane.kind}, nowhere {MIN_WIDTH_M} m wide"] += 1
            continue
        kept = _advancing(line, [beside(line, t) for t in (inner_t, outer_t)])
        borders = [road_points(road, line, s, t, T_local_map)[kept] for t in (inner_t, outer_t)]
        lanes.append(_lane(road, index, section, lane, borders))
        if len(set(limits_in(lane, road, section))) > 1:
            changing.append(lane_key(road, index, lane.lane_id))
    return lanes


def _advancing(line: F64, edges: Sequence[F64]) -> I64:
    """Return the stations of a lane without those at which an edge runs back, as inside of corners
    of a reference line that is made of straight pieces. Its ends stay.

    Args:
        line: ``(N, 3)`` reference line with headings.
        edges: Its edges, each ``(N, 2)``, in the same coordinates.
    """
    direction = direction_of(line[:, 2])
    stations = np.arange(len(line))
    along = [np.sum(np.diff(edge, axis=0) * direction[1:], axis=1) for edge in edges]
    if all((step_m >= -BACK_M).all() for step_m in along):
        return stations

    def leads_on(begin: int, end: int) -> bool:
        steps = [edge[end] - edge[begin] for edge in edges]
        return all(step @ direction[end] >= FORWARDS * np.hypot(*step) for step in steps)

    kept = [0]
    for station in stations[1:-1].tolist():
        if leads_on(kept[-1], station):
            kept.append(station)
    while len(kept) > 1 and not leads_on(kept[-1], len(line) - 1):
        kept.pop()
    return np.array([*kept, len(line) - 1], dtype=np.int64)


def _lane(road: Road, index: int, section: Section, lane: OdrLane, borders: Sequence[F64]) -> Lane:
    """Return a lane in driving direction.

    Args:
        road: Its road.
        index: Number of its section.
        section: Its section.
        lane: What the file says of it.
        borders: Its inner and its outer edge ``(N, 3)``, metres, along the road.
    """
    side = section.side(1 if lane.lane_id > 0 else -1)
    k = side.index(lane)
    inside = side[k - 1] if k > 0 else None
    outside = side[k + 1] if k + 1 < len(side) else None

    def key_of(neighbour: OdrLane | None) -> str | None:
        is_same_way = neighbour is not None and neighbour.reversed == lane.reversed
        if neighbour is None or neighbour.kind not in KINDS or not is_same_way:
            return None
        return lane_key(road, index, neighbour.lane_id)

    # Seen in driving direction the middle of the road is on the left, with left-hand traffic on
    # the right.
    order = -1 if road.left_hand != lane.reversed else 1
    left_mark, right_mark = _marks(road, section, lane)
    left_id, right_id = (key_of(inside), key_of(outside))[::order]
    turn = 1 if driven_along(road, lane) else -1
    left, right = (edge[::turn] for edge in borders[::order])
    limits = [mps for mps in limits_in(lane, road, section) if mps is not None]
    kind = KINDS[lane.kind]
    return Lane(
        lane_key(road, index, lane.lane_id),
        densify((left + right) / 2),
        left,
        right,
        "bus" if lane.closed and kind == "vehicle" else kind,
        left_neighbour=left_id,
        right_neighbour=right_id,
        left_mark_type=_mark_type(left_mark),
        right_mark_type=_mark_type(right_mark),
        is_intersection=road.junction != "-1",
        speed_limit_mps=min(limits, default=None),
        is_motorway=_is_motorway(road, section),
    )


def _is_motorway(road: Road, section: Section) -> bool:
    """Return whether a road is a motorway where a section begins."""
    begun = [kind for start_m, kind in road.kinds if start_m <= section.s_m]
    return bool(begun) and begun[-1] == "motorway"


def _marks(road: Road, section: Section, lane: OdrLane) -> tuple[RoadMark | None, RoadMark | None]:
    """Return the marks on the left and on the right of a lane in driving direction."""
    side = section.side(1 if lane.lane_id > 0 else -1)
    k = side.index(lane)
    marks = {other.lane_id: other.mark for other in section.lanes}
    inner_mark = marks.get(side[k - 1].lane_id if k > 0 else 0)
    if road.left_hand != lane.reversed:
        return lane.mark, inner_mark
    return inner_mark, lane.mark


def _guides(roads: Sequence[Road]) -> set[Side]:
    """Return the sides of lanes in junctions whose line the map gives piece by piece."""
    guides = set()
    for road in roads:
        for index, section in enumerate(road.sections):
            for lane in (lane for lane in section.lanes if lane.lane_id != 0):
                key = lane_key(road, index, lane.lane_id)
                for side, mark in zip(("left", "right"), _marks(road, section, lane), strict=True):
                    if mark is not None and mark.explicit:
                        guides.add((key, side))
    return guides


def _open_junctions(odr: OdrMap, lanes: Mapping[str, Lane]) -> dict[str, Lane]:
    """Return lanes without the markings over which other lanes of their junction lead."""
    roads = [road for road in odr.roads if road.junction != "-1"]
    junctions = {
        key: road.junction
        for road in roads
        for index, section in enumerate(road.sections)
        for lane in section.lanes
        if (key := lane_key(road, index, lane.lane_id)) in lanes
    }
    return with_open_junctions(lanes, junctions, _guides(roads))


def _stations(road: Road, section: Section) -> F64:
    """Return the arc lengths of a section's stations: its ends, the start of every record, no gap
    above the step, and no turn between two of them above `MAX_TURN_RAD`.
    """
    lines = [record for lane in section.lanes for record in (lane.widths, lane.borders)]
    cubics = np.concatenate([road.lane_offset, *lines])
    curved = any(record.kind != "line" for record in road.records)
    starts = [*(record.s_m for record in road.records), *cubics[:, 0], *road.elevation[:, 0]]
    inside = [start_m for start_m in starts if section.s_m < start_m < section.end_m]
    knots = np.unique([section.s_m, *inside, section.end_m])
    bends = curved or cubics[:, 2:].any() or len(road.elevation) > 1
    step = STEP_M if bends else STRAIGHT_STEP_M
    s_m = _divided(knots, np.diff(knots) / step)
    if not all(_is_gentle(record) for record in road.records):
        # A record's heading may jump at its start: what counts is how it turns up to the next one.
        last = np.nextafter(s_m[1:], s_m[:-1])
        headings = [reference_line(road.records, ends)[:, 2] for ends in (s_m[:-1], last)]
        s_m = _divided(s_m, np.abs(headings[1] - headings[0]) / MAX_TURN_RAD)
    # A section ends where the next one begins: the values just before it count.
    s_m[-1] = np.nextafter(section.end_m, section.s_m)
    return s_m


def _is_gentle(record: Geometry) -> bool:
    """Return whether a record turns by less than `MAX_TURN_RAD` a step."""
    if record.kind in ("arc", "spiral"):
        return max(map(abs, record.numbers)) * STEP_M <= MAX_TURN_RAD
    return record.kind == "line"


def _divided(knots: F64, parts: F64) -> F64:
    """Return increasing knots ``(N + 1,)`` with each gap divided evenly into at least ``parts (N,)``
    pieces.
    """
    pieces = np.maximum(np.ceil(parts - 1e-9).astype(np.int64), 1)
    divided = [
        np.linspace(begin, end, n, endpoint=False)
        for begin, end, n in zip(knots[:-1], knots[1:], pieces, strict=True)
    ]
    return np.concatenate([*divided, knots[-1:]])


def _mark_type(mark: RoadMark | None) -> LaneMarkType:
    """Return the kind of a road mark; colours other than yellow are white."""
    if mark is None or mark.kind == "none":
        return "none"
    kind, colour = mark.kind, mark.colour
    if kind in _SOLID:
        return (
            ("double_yellow" if " " in kind else "solid_yellow")
            if colour == "yellow"
            else "solid_white"
        )
    if kind in ("broken", "broken broken"):
        return "dashed_yellow" if colour == "yellow" else "dashed_white"
    return "none" if kind in ("curb", "grass", "edge") else "unknown"
