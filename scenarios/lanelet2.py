"""Lanelet2 maps: OSM XML of nodes, ways for the bounds of lanes, and relations for lanelets and
regulatory elements.

A lanelet's left bound is on its left in driving direction, however its ways are drawn. Lanelets that
share the end points of both bounds follow each other; those that share a bound lie side by side. A
lanelet that is driven both ways becomes two lanes, the second one named ``-ID``.

Source: Poggenhans and others, Lanelet2: A high-definition map framework (ITSC 2018), and the
format's public description (LaneletPrimitives, RegulatoryElementTagging).
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, some_of
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.geometry import arc_lengths, centre_line, heading_of, se2, transform_points
from alpasim_plugin.core.types import F64, Box, Lane, LaneMap, LaneMarkType, Signal
from scenarios.commonroad_map import mark_intersections
from scenarios.countries import country_at
from scenarios.light_posts import Carriageway
from scenarios.map_lines import is_left_of, rails
from scenarios.map_route import Spot
from scenarios.opendrive import T_enu_earth, earth_xyz
from scenarios.recorded import SourceFiles, near
from scenarios.street_map import Head, StreetMap

KINDS = {
    **dict.fromkeys(("road", "highway", "play_street", "exit"), "vehicle"),
    "bus_lane": "bus",
    "bicycle_lane": "bike",
    **dict.fromkeys(("emergency_lane", "road_shoulder"), "shoulder"),
}
MARKS = ("line_thin", "line_thick", "bike_marking")  # ways that are painted on the road
UNMARKED = ("virtual", "road_border", "curbstone", "guard_rail", "wall", "fence", "rail")
CARS = ("vehicle", "vehicle:car")  # participants that cars are; other vehicles begin alike
YES = ("yes", "true", "1")
RULES = ("traffic_light", "right_of_way", "speed_limit")  # regulatory elements that are read
LIMIT_TAGS = ("speed_limit:vehicle:car", "speed_limit:vehicle", "speed_limit")
SIGN = re.compile(r"de274-(\d+)", re.ASCII)  # German sign of a limit, by its number in km/h
TOWN_SIGN = {"de310": 50.0}  # km/h
SPEED = re.compile(r"(\d+(?:\.\d+)?)\s*(km/h|kmh|mph|m/s|mps|)", re.ASCII)
MPS = {"km/h": 1 / 3.6, "kmh": 1 / 3.6, "": 1 / 3.6, "mph": 0.44704, "m/s": 1.0, "mps": 1.0}
JUNCTION_M = 60.0  # lights whose lines lie nearer to each other belong to one junction
SIGN_M = 2.1  # height at which signs stand
PLATE_M = 0.6  # height of a sign itself
LAMPS_M = 0.9  # height of a light whose map does not state it


LANELET2 = Fields(
    "Lanelet2",
    read={
        "lanelet": "@type @subtype @one_way @participant @speed_limit left right regulatory_element",
        "regulatory_element": "@type @subtype @sign_type @fallback refers ref_line yield",
        "way": "@type @subtype @color @height",
        "node": "@local_x @local_y @ele",
    },
    harmless={
        # Limits by location have a note of their own.
        "lanelet": "@location @region @road_name @name @width @turn_direction @area @source",
        "regulatory_element": "right_of_way @name light_bulbs",
        "way": "@width @name @area @temporary @source @traffic_light_id",
        "node": "@type @subtype @color @name @mgrs_code @source",
    },
)


@dataclass(frozen=True)
class Item:
    """A node, way or relation: its tags and, of the latter two, its members by role."""

    tags: Mapping[str, str]
    members: tuple[tuple[str, str, str], ...] = ()  # type, role, id

    def of(self, role: str, kind: str) -> list[str]:
        """Return the ids of the members of one type that have a role."""
        return [ref for of_kind, of_role, ref in self.members if (of_kind, of_role) == (kind, role)]


class Osm:
    """The elements of a file, with an error for each that is missing, and places in metres.

    Args:
        files: Reads and hashes.
        path: The file.

    Raises:
        InputError: No OSM file, one of OpenStreetMap without lanelets, or one id twice.
    """

    def __init__(self, files: SourceFiles, path: Path) -> None:
        self.files = files
        self.path = path
        root = files.read_xml(path)
        if root.tag != "osm":
            raise InputError(f"{path}: root element {root.tag!r}", "give a Lanelet2 map (OSM XML)")
        self.items: dict[str, dict[str, Item]] = {"node": {}, "way": {}, "relation": {}}
        places: dict[str, dict[str, str]] = {}
        for element in root:
            of_kind = self.items.get(element.tag)
            if of_kind is None or element.get("action") == "delete":
                continue
            key = str(element.get("id"))
            if key in of_kind:
                raise InputError(f"{path}: {element.tag} {key} twice", "give each its own id")
            tags = {str(tag.get("k")): str(tag.get("v")) for tag in element.iter("tag")}
            nodes = [("node", "", str(nd.get("ref"))) for nd in element.iter("nd")]
            members = [
                (str(member.get("type")), str(member.get("role")), str(member.get("ref")))
                for member in element.iter("member")
            ]
            of_kind[key] = Item(tags, (*nodes, *members))
            if element.tag == "node":
                places[key] = {**element.attrib, **of_kind[key].tags}
        self.lanelets = self.relations("lanelet")
        streets = [way for way in self.items["way"].values() if "highway" in way.tags]
        if streets and not self.lanelets:
            raise InputError(
                f"{path}: an OpenStreetMap extract with {len(streets)} ways of streets and paths (tag `highway`) and no lanelet; such a file has no lanes",
                "make lanes of it first, for example with SUMO's `netconvert --osm-files FILE --opendrive-output MAP.xodr`, and give the OpenDRIVE map",
            )
        self.rules = self.relations("regulatory_element")
        used = {ref for way in self._used_ways() for ref in self.nodes(way)}
        self.xyz, self.origin, self.notes = self._placed({key: places[key] for key in sorted(used)})
        self.country = _country(places[key] for key in sorted(used))

    def relations(self, kind: str) -> dict[str, Item]:
        """Return the relations of one type."""
        relations = self.items["relation"].items()
        return {key: item for key, item in relations if item.tags.get("type") == kind}

    def ways(self, kind: str) -> list[str]:
        """Return the ways of one type."""
        return [key for key, way in self.items["way"].items() if way.tags.get("type") == kind]

    def get(self, kind: str, key: str) -> Item:
        """Return an element.

        Raises:
            InputError: It is missing.
        """
        if key not in self.items[kind]:
            raise InputError(f"{self.path}: {kind} {key}, which is missing", "add it to the map")
        return self.items[kind][key]

    def nodes(self, way: str) -> list[str]:
        """Return the nodes of a way, each once in a row.

        Raises:
            InputError: The way is missing or shorter than two nodes, or one of them is missing.
        """
        refs = [ref for ref, _ in groupby(self.get("way", way).of("", "node"))]
        if len(refs) < 2:
            raise InputError(f"{self.path}, way {way}: {len(refs)} node", "give it at least two")
        for ref in refs:
            self.get("node", ref)
        return refs

    def line(self, nodes: Iterable[str]) -> F64:
        """Return the points ``(N, 3)`` of nodes."""
        return np.array([self.xyz[node] for node in nodes])

    def rules_of(self, lanelet: Item) -> list[tuple[str, Item]]:
        """Return the regulatory elements of a lanelet."""
        refs = lanelet.of("regulatory_element", "relation")
        return [(ref, self.get("relation", ref)) for ref in refs]

    def _used_ways(self) -> list[str]:
        beside = ("stop_line", "traffic_sign")
        ways = [key for kind in beside for key in self.ways(kind)]
        for lanelet in self.lanelets.values():
            ways += [*lanelet.of("left", "way"), *lanelet.of("right", "way")]
        for rule in self.rules.values():
            ways += [*rule.of("ref_line", "way"), *rule.of("refers", "way")]
        return ways

    def _placed(
        self, places: Mapping[str, Mapping[str, str]]
    ) -> tuple[dict[str, F64], tuple[float, float, float], tuple[str, ...]]:
        """Return the nodes' places in metres, what was subtracted, and notes on the frame.

        Metres ``local_x``, ``local_y`` go before latitude and longitude, which are projected onto
        the plane that touches the earth in the middle of the map.
        """
        is_local = self._has_local_places(places)
        axes = ["local_x", "local_y"] if is_local else ["lon", "lat"]
        has_height = all("ele" in place for place in places.values())
        if has_height:
            axes.append("ele")
        most = (1e9, 1e9, 1e9) if is_local else (180.0, 90.0, 1e9)
        table = np.zeros((len(places), 3))
        for row, (key, place) in zip(table, places.items(), strict=True):
            with parsing(f"{self.path}, node {key}", "give numbers, degrees or metres"):
                row[: len(axes)] = [float(place[axis]) for axis in axes]
                if not (np.abs(row) <= most).all():
                    raise ValueError(f"no place on the earth: {row.tolist()}")
        notes = [] if has_height else ["not all points have a height (ele): the map is level"]
        if is_local:
            shift = np.round(table[0, :2])
            origin = (float(shift[0]), float(shift[1]), 0.0)
            points = table - np.array(origin)
        else:
            origin = (0.0, 0.0, 0.0)
            points, lat, lon = _in_tangent_plane(table)
            notes.append(f"origin at latitude {lat:.3f}, longitude {lon:.3f}; x east, y north")
        near(self.path, points)
        return dict(zip(places, points, strict=True)), origin, tuple(notes)

    def _has_local_places(self, places: Mapping[str, Mapping[str, str]]) -> bool:
        """Tell whether the nodes have places in metres.

        Raises:
            InputError: Some nodes have and some have not, or a node has no place at all.
        """
        local = {key for key, place in places.items() if "local_x" in place or "local_y" in place}
        for key, place in places.items():
            if local and key not in local:
                raise InputError(
                    f"{self.path}, node {key}: no local_x and local_y, which {len(local)} of {len(places)} nodes have",
                    "give them to all nodes, or to none",
                )
            if local and not {"local_x", "local_y"} <= {*place}:
                raise InputError(
                    f"{self.path}, node {key}: one of local_x and local_y without the other",
                    "give both in metres",
                )
            if not local and not {"lat", "lon"} <= {*place}:
                raise InputError(
                    f"{self.path}, node {key}: neither lat and lon nor the tags local_x and local_y",
                    "convert the map; metres in attributes x and y (INTERACTION) are not read",
                )
        return bool(local)


def _country(places: Iterable[Mapping[str, str]]) -> str | None:
    """Return the country of the first node with latitude and longitude; None where it is not known."""
    for place in places:
        with contextlib.suppress(ValueError):
            return country_at(float(place.get("lat", "")), float(place.get("lon", "")))
    return None


def _in_tangent_plane(table: F64) -> tuple[F64, float, float]:
    """Project longitude and latitude ``(N, 3)`` (degrees; heights, metres, stay) onto the plane that
    touches the earth in their middle: east, north, and latitude and longitude of that middle. A map
    may lie on both sides of the 180th meridian.
    """
    lon_lat = table[:, :2].copy()
    lon, lat = 0.0, 0.0
    if len(table):
        if np.ptp(lon_lat[:, 0]) > 180.0:
            lon_lat[:, 0] %= 360.0
        lon, lat = np.round((lon_lat.min(axis=0) + lon_lat.max(axis=0)) / 2, 3)
        lon = lon - 360.0 if lon > 180.0 else lon
    earth = earth_xyz(table[:, 1], table[:, 0], np.zeros(len(table)))
    points = transform_points(T_enu_earth(lat, lon, 0.0), earth)
    points[:, 2] = table[:, 2]
    return points, lat, lon


@dataclass(frozen=True)
class Bound:
    """One bound of a lane in driving direction."""

    way: str
    nodes: tuple[str, ...]

    def turned(self) -> Bound:
        """Return the bound in the other direction."""
        return Bound(self.way, self.nodes[::-1])


@dataclass
class Lanelets:
    """The lanelets of a map as they are read.

    Attributes:
        lanes: The lanes by id.
        bounds: Left and right bound of each lane.
        crosswalks: Outline of each ``(N, 3)``, metres.
        left_out: How many lanelets of each type are no lanes.
        reserved: How many lanes of each type are not for cars.
    """

    lanes: dict[str, Lane] = field(default_factory=dict)
    bounds: dict[str, tuple[Bound, Bound]] = field(default_factory=dict)
    crosswalks: list[F64] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    reserved: Counter[str] = field(default_factory=Counter)


def read_street(files: SourceFiles, path: Path) -> StreetMap:
    """Read a map for a drive on it.

    Raises:
        InputError: The file is no Lanelet2 map, an element that is used is missing or broken, or no
            lanelet is for vehicles.
    """
    osm = Osm(files, path)
    limits, unread = _limits(osm)
    lanelets = _read_lanelets(osm, limits)
    if not any(lane.kind == "vehicle" for lane in lanelets.lanes.values()):
        raise InputError(f"{path}: a map without a lanelet for vehicles", "use one with a road")
    _add_opposite_lanes(osm, lanelets, limits)
    lanes = _linked(lanelets.lanes, lanelets.bounds)
    lengths = {key: float(arc_lengths(lane.centre)[-1]) for key, lane in lanes.items()}

    def spots(name: str, s_m: float) -> list[Spot]:
        stations = {name: s_m, f"-{name}": lengths[name] - s_m}
        return [Spot(key, at_m) for key, at_m in stations.items() if key in lanes]

    heads, posts = _with_posts(_heads(osm, lanes), Carriageway(lanes))
    notes = [*_lane_notes(lanelets, lanes), *_rule_notes(osm, unread)]
    return StreetMap(
        lanes,
        LaneMap(
            {},
            crosswalks=tuple(lanelets.crosswalks),
            stop_lines=tuple(osm.line(osm.nodes(way)) for way in osm.ways("stop_line")),
            poles=posts,
            signs=tuple(_sign(osm, way) for way in osm.ways("traffic_sign")),
        ),
        heads,
        _give_way(osm, lanes),
        lengths,
        spots,
        osm.origin,
        (*osm.notes, *notes, *LANELET2.notes(_met(osm))),
        osm.country,
    )


def _read_lanelets(osm: Osm, limits: Mapping[str, float | None]) -> Lanelets:
    """Return the lanelets of a map, each in its own direction, without what follows them."""
    lanelets = Lanelets()
    for key, lanelet in osm.lanelets.items():
        left, right = _bounds(osm, key, lanelet)
        subtype = lanelet.tags.get("subtype", "road")
        if subtype == "crosswalk":
            outline = (*left.nodes, *right.nodes[::-1], left.nodes[0])
            lanelets.crosswalks.append(osm.line(outline))
        participants = _participants(lanelet)
        users = ", ".join(sorted(name for name, may in participants.items() if may))
        kind = _kind(subtype, participants)
        if kind is None:
            lanelets.left_out[f"{subtype} for {users}" if users else subtype] += 1
            continue
        if kind != "vehicle" and participants:
            lanelets.reserved[f"{subtype} are for {users} and not for cars"] += 1
        lanelets.bounds[key] = left, right
        lanelets.lanes[key] = _lane(osm, key, kind, left, right, limits.get(key), subtype)
    return lanelets


def _add_opposite_lanes(osm: Osm, lanelets: Lanelets, limits: Mapping[str, float | None]) -> None:
    """Mark the lanes of intersections, and add a lane ``-ID`` to each lanelet that is driven both
    ways.
    """
    bounds = lanelets.bounds
    lanelets.lanes = mark_intersections(_linked(lanelets.lanes, bounds))
    for key, lane in [*lanelets.lanes.items()]:
        tags = osm.lanelets[key].tags
        if tags.get("one_way") in ("no", "false"):
            subtype = tags.get("subtype", "road")
            left, right = bounds[key]
            bounds[f"-{key}"] = right.turned(), left.turned()
            turned = bounds[f"-{key}"]
            back = _lane(osm, f"-{key}", lane.kind, *turned, limits.get(key), subtype)
            lanelets.lanes[f"-{key}"] = replace(back, is_intersection=lane.is_intersection)


def _lane_notes(lanelets: Lanelets, lanes: Mapping[str, Lane]) -> list[str]:
    """Return notes on lanelets that are no lanes, or lanes without a limit."""
    notes = [
        f"lanelets of type {kind} left out: {n}" for kind, n in sorted(lanelets.left_out.items())
    ]
    notes += [f"{n} lanelets of type {text}" for text, n in sorted(lanelets.reserved.items())]
    without = sum(
        lane.kind == "vehicle" and lane.speed_limit_mps is None for lane in lanes.values()
    )
    if without:
        notes.append(
            f"lanes for cars without a speed limit: {without}; limits by location and type are not applied"
        )
    return notes


def _rule_notes(osm: Osm, unread: Sequence[str]) -> list[str]:
    """Return notes on regulatory elements, ``unread`` limits and areas that are left out."""
    rules = Counter(rule.tags.get("subtype", "") for rule in osm.rules.values())
    notes = [
        f"regulatory elements of type {subtype or 'unknown'} are not read: {n}"
        for subtype, n in sorted(rules.items())
        if subtype not in RULES
    ]
    if unread:
        notes.append(f"{len(unread)} speed limits without a number: {some_of(unread)}")
    areas = len(osm.relations("multipolygon"))
    if areas:
        notes.append(f"areas (multipolygon) left out: {areas}")
    return notes


def _met(osm: Osm) -> Iterator[str]:
    """Yield the names of the fields of a map: tags and roles of lanelets, regulatory elements and
    ways, and attributes of nodes.
    """
    for holder, items in (("lanelet", osm.lanelets), ("regulatory_element", osm.rules)):
        for item in items.values():
            yield from (field_name(holder, f"@{tag.partition(':')[0]}") for tag in item.tags)
            yield from (field_name(holder, role) for _, role, _ in item.members)
    for item in osm.items["way"].values():
        yield from (field_name("way", f"@{tag}") for tag in item.tags)
    for item in osm.items["node"].values():
        yield from (field_name("node", f"@{tag}") for tag in item.tags)


def _participants(lanelet: Item) -> dict[str, bool]:
    """Return the road users that a lanelet names, and whether they may use it."""
    prefix = "participant:"
    return {
        key.removeprefix(prefix): value.lower() in YES
        for key, value in lanelet.tags.items()
        if key.startswith(prefix)
    }


def _kind(subtype: str, named: Mapping[str, bool]) -> str | None:
    """Return the kind of a lane by those who may use it: where participants are named only those,
    else by its type; None for one that is no lane of vehicles.
    """
    if not named:
        return KINDS.get(subtype)
    cars = [may for name, may in named.items() if name in CARS]
    if cars and all(cars):
        return "vehicle"
    kind = KINDS.get(subtype)
    if any(may and name.startswith("vehicle:") and name not in CARS for name, may in named.items()):
        return "shoulder" if kind == "shoulder" else "bus"
    return "bike" if kind == "bike" else None


def _bounds(osm: Osm, key: str, lanelet: Item) -> tuple[Bound, Bound]:
    """Return the bounds of a lanelet, both in the direction that has the left one on the left."""
    with parsing(f"{osm.path}, lanelet {key}", "give it one way with a length for each bound"):
        left_way, right_way = (_one_way(lanelet, side) for side in ("left", "right"))
        left, right = (Bound(way, tuple(osm.nodes(way))) for way in (left_way, right_way))
        ends = [osm.line((bound.nodes[0], bound.nodes[-1])) for bound in (left, right)]
        apart = np.linalg.norm(ends[0] - ends[1], axis=1).sum()
        if np.linalg.norm(ends[0] - ends[1][::-1], axis=1).sum() < apart:
            right = right.turned()
        lines = osm.line(left.nodes), osm.line(right.nodes)
        if left_way == right_way or min(float(arc_lengths(line)[-1]) for line in lines) <= 0.0:
            raise ValueError("a bound without length, or one for both sides")
    if not is_left_of(*lines):
        left = left.turned()
        right = right.turned()
    return left, right


def _one_way(lanelet: Item, side: str) -> str:
    """Return the way of the bound of a side; `ValueError` where it is none or several."""
    ways = lanelet.of(side, "way")
    if len(ways) != 1:
        raise ValueError(f"{len(ways)} ways for its {side} bound")
    return ways[0]


def _lane(
    osm: Osm, key: str, kind: str, left: Bound, right: Bound, limit_mps: float | None, subtype: str
) -> Lane:
    lines = osm.line(left.nodes), osm.line(right.nodes)
    lane = Lane(
        key,
        centre_line(*lines),
        *lines,
        kind,
        left_mark_type=_mark_type(osm.items["way"][left.way]),
        right_mark_type=_mark_type(osm.items["way"][right.way]),
        speed_limit_mps=limit_mps,
        is_motorway=subtype == "highway",
    )
    even_left, even_right = rails(lane)
    return replace(lane, left=even_left, right=even_right)


def _linked(
    lanes: Mapping[str, Lane], bounds: Mapping[str, tuple[Bound, Bound]]
) -> dict[str, Lane]:
    """Return the lanes with what follows them and what lies beside them."""
    begins: dict[tuple[str, str], list[str]] = {}
    of_left: dict[Bound, str] = {}
    of_right: dict[Bound, str] = {}
    for key in lanes:
        left, right = bounds[key]
        begins.setdefault((left.nodes[0], right.nodes[0]), []).append(key)
        of_left[left], of_right[right] = key, key
    return {
        key: replace(
            lane,
            successors=tuple(begins.get((bounds[key][0].nodes[-1], bounds[key][1].nodes[-1]), ())),
            left_neighbour=of_right.get(bounds[key][0]),
            right_neighbour=of_left.get(bounds[key][1]),
        )
        for key, lane in lanes.items()
    }


def _mark_type(way: Item) -> LaneMarkType:
    """Return the lane marking of a bound; colours other than yellow are white."""
    kind = way.tags.get("type")
    subtype = way.tags.get("subtype", "")
    if kind in UNMARKED:
        return "none"
    if kind not in MARKS or (not subtype and kind != "bike_marking"):
        return "unknown"
    yellow = way.tags.get("color") == "yellow"
    if "solid" not in subtype:
        return "dashed_yellow" if yellow else "dashed_white"
    if not yellow:
        return "solid_white"
    return "double_yellow" if "_" in subtype else "solid_yellow"


def _limits(osm: Osm) -> tuple[dict[str, float], list[str]]:
    """Return lanelets' speed limits in m/s, by their own tags or by a regulatory element, and those
    that name no number.
    """
    limits: dict[str, float] = {}
    unread: list[str] = []
    for key, lanelet in osm.lanelets.items():
        texts = [lanelet.tags[tag] for tag in LIMIT_TAGS if tag in lanelet.tags][:1]
        for _, rule in osm.rules_of(lanelet):
            if rule.tags.get("subtype") == "speed_limit":
                texts += _limit_texts(osm, rule)
        for text in texts:
            limit_mps = _limit_mps(text.strip())
            if limit_mps is None:
                unread.append(f"{text!r} of lanelet {key}")
            else:
                limits.setdefault(key, limit_mps)
    return limits, unread


def _limit_texts(osm: Osm, rule: Item) -> list[str]:
    """Return what a regulatory element says of a limit: its own type of sign, else those of the
    signs that it refers to.
    """
    if "sign_type" in rule.tags:
        return [rule.tags["sign_type"]]
    signs = [osm.get("way", way).tags.get("subtype", "") for way in rule.of("refers", "way")]
    return signs or [""]


def _limit_mps(text: str) -> float | None:
    """Return a speed limit in m/s; None where the text names no number of a known kind."""
    sign = SIGN.fullmatch(text)
    if sign is not None:
        return float(sign[1]) / 3.6
    if text in TOWN_SIGN:
        return TOWN_SIGN[text] / 3.6
    written = SPEED.fullmatch(text)
    return None if written is None else float(written[1]) * MPS[written[2]]


def _heads(osm: Osm, lanes: Mapping[str, Lane]) -> tuple[Head, ...]:
    """Return the traffic lights: those of lines that lie close together are one junction."""
    held: dict[tuple[str, str], list[str]] = {}  # stop line or else lanelet, and element
    for key in (key for key in lanes if key in osm.lanelets):
        for ref, rule in osm.rules_of(osm.lanelets[key]):
            if rule.tags.get("subtype") == "traffic_light":
                line = next(iter(rule.of("ref_line", "way")), f"end of {key}")
                held.setdefault((line, ref), []).append(key)
    signals = [
        (line, replace(stop, head=head))
        for (line, ref), keys in held.items()
        for stop in [_stop(osm, line, ref, [lanes[key] for key in keys])]
        for head in _lamps(osm, osm.rules[ref])
    ]
    if not signals:
        return ()
    middles = np.array([signal.stop.mean(axis=0)[:2] for _, signal in signals])
    close = scipy.spatial.distance.cdist(middles, middles) < JUNCTION_M
    _, junction = scipy.sparse.csgraph.connected_components(close)
    return tuple(
        Head(signal, str(number), "", line)
        for (line, signal), number in zip(signals, junction, strict=True)
    )


def _lamps(osm: Osm, rule: Item) -> list[F64 | None]:
    """Return the middle of the lamps of each light of an element: a way is their lower edge, in
    maps without heights on the ground; None alone where the element names no light.
    """
    middles: list[F64 | None] = []
    for way in rule.of("refers", "way"):
        middle = osm.line(osm.nodes(way)).mean(axis=0)
        with parsing(f"{osm.path}, way {way}, height", "give a number of metres"):
            middle[2] += float(osm.items["way"][way].tags.get("height", LAMPS_M)) / 2
        middles.append(middle)
    return middles or [None]


def _give_way(osm: Osm, lanes: Mapping[str, Lane]) -> tuple[Signal, ...]:
    """Return the lines at which lanelets give way, where no traffic light goes before the rule."""
    lines = []
    for ref, rule in osm.rules.items():
        if rule.tags.get("subtype") == "right_of_way" and rule.tags.get("fallback") != "yes":
            line = next(iter(rule.of("ref_line", "way")), "")
            keys = [key for key in rule.of("yield", "relation") if key in lanes]
            lines += [_stop(osm, line, ref, [lanes[key]]) for key in keys]
    return tuple(lines)


def _stop(osm: Osm, line: str, name: str, lanes: Sequence[Lane]) -> Signal:
    """Return the line at which lanelets wait: a way, or the end of the first one."""
    ends = np.stack([edge[-1] for edge in rails(lanes[0])])
    if line in osm.items["way"]:
        ends = osm.line(osm.nodes(line))[[0, -1]]
    along = lanes[0].centre[-1, :2] - lanes[0].centre[-2, :2]
    heading_rad = float(heading_of(along))
    return Signal(ends, heading_rad, (), 0, name, tuple(lane.lane_id for lane in lanes))


def _with_posts(
    heads: Sequence[Head], carriageway: Carriageway
) -> tuple[tuple[Head, ...], tuple[F64, ...]]:
    """Return lights with the places of their lamps on posts, and the posts ``(N, 3)``."""
    placed_heads = []
    posts = []
    for head in heads:
        lamps = head.signal.head
        if lamps is not None:
            foot = np.array([*lamps[:2], head.signal.stop[:, 2].mean()])
            post = carriageway.post(foot, float(lamps[2] - foot[2]))
            posts.append(post.line)
            lamps = post.lamps
        placed_heads.append(replace(head, signal=replace(head.signal, head=lamps)))
    return tuple(placed_heads), tuple(posts)


def _sign(osm: Osm, way: str) -> tuple[F64, Box]:
    """Return the middle of a sign, which stands along its way, and its size."""
    line = osm.line(osm.nodes(way))
    along = line[-1] - line[0]
    width_m = float(np.hypot(along[0], along[1]))
    heading_rad = float(heading_of(along)) + np.pi / 2
    x, y, z = line.mean(axis=0).tolist()
    pose = se2(x, y, heading_rad, z + SIGN_M + PLATE_M / 2)
    return pose, Box(0.05, max(width_m, PLATE_M), PLATE_M)
