"""OpenDRIVE roads as written: plan view, elevation, lane sections and links, and their reference
lines at any arc length.

Reference lines are line, arc, spiral, poly3 and paramPoly3 records. Source: ASAM OpenDRIVE 1.4 to
1.8, chapter on geometry: x east, y north, heading from x towards y, ``s`` along the line, ``t`` to
the left.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import scipy
from numpy.polynomial import Polynomial

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, some_of
from alpasim_plugin.core.files.limits import LIMIT_MPS, MAP_CURVATURE_PER_M, MAP_ROAD_M
from alpasim_plugin.core.geometry import transform_points
from alpasim_plugin.core.types import F64
from scenarios.countries import country_of
from scenarios.opendrive_fields import OPENDRIVE

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_TABLE = 2001  # places at which a cubic's arc length is tabulated before it is inverted

MAX_ROAD_M = MAP_ROAD_M.high
# Elements of a map that are read, or that change no road; types of junctions that are read.
KNOWN = {"header", "road", "junction", "controller", "junctionGroup", "station", "userData"}
JUNCTIONS = ("default", "direct", "")
# Catalogue numbers of marks on the road.
STOP_LINE = "294"
CROSSWALK = "1000003"
CROSSWALK_M = 4.0
UNITS_MPS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}
# Road users of access rules that the ego and the cars around it are.
CARS = frozenset({"passengerCar", "autonomousTraffic"})
JOIN_M = 0.01  # records of a reference line that lie farther apart do not join
_ABCD = ("a", "b", "c", "d")
_PARAMETERS = {
    "line": (),
    "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"),
    "poly3": _ABCD,
    "paramPoly3": tuple(f"{k}{axis}" for axis in "UV" for k in _ABCD),
}


@dataclass(frozen=True)
class Geometry:
    """One record of a plan view."""

    s_m: float
    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    kind: str  # of `_PARAMETERS`
    # line: none; arc: curvature; spiral: start and end curvature; poly3: a b c d; paramPoly3: aU bU
    # cU dU aV bV cV dV.
    numbers: tuple[float, ...] = ()
    normalised: bool = True  # paramPoly3: the parameter runs 0..1, else 0..length

    def at(self, s_m: F64) -> F64:
        """Return ``(N, 3)`` x, y and heading at arc lengths ``(N,)`` from the record's own
        start.
        """
        if self.kind in ("line", "arc", "spiral"):
            # The heading is quadratic in s: 32 points are exact to rounding for any road's turn.
            start = self.numbers[0] if self.numbers else 0.0
            rate = (self.numbers[1] - start) / self.length_m if self.kind == "spiral" else 0.0
            nodes_m = 0.5 * s_m[:, None] * (1.0 + _NODES)  # (N, 32)
            heading = self.heading_rad + nodes_m * (start + 0.5 * rate * nodes_m)
            x = self.x_m + 0.5 * s_m * (np.cos(heading) @ _WEIGHTS)
            y = self.y_m + 0.5 * s_m * (np.sin(heading) @ _WEIGHTS)
            return np.column_stack([x, y, self.heading_rad + s_m * (start + 0.5 * rate * s_m)])
        if self.kind == "poly3":
            p, along, across = self._along_poly3(s_m), Polynomial([0.0, 1.0]), self.numbers
        else:
            p = s_m / self.length_m if self.normalised and self.length_m > 0 else s_m
            along = Polynomial(self.numbers[:4])
            across = self.numbers[4:]
        left = Polynomial(across)
        u = along(p)
        v = left(p)
        heading = self.heading_rad + np.arctan2(left.deriv()(p), along.deriv()(p))
        c = np.cos(self.heading_rad)
        s = np.sin(self.heading_rad)
        return np.column_stack([self.x_m + u * c - v * s, self.y_m + u * s + v * c, heading])

    def _along_poly3(self, s_m: F64) -> F64:
        """Return u at arc lengths of ``v = a + b u + c u^2 + d u^3``."""
        u = np.linspace(0.0, max(self.length_m, 1e-9), _TABLE)  # an arc is never shorter than its u
        speed = np.hypot(1.0, Polynomial(self.numbers).deriv()(u))
        s = scipy.integrate.cumulative_simpson(speed, x=u, initial=0)
        return scipy.interpolate.CubicSpline(s, u)(s_m)


def reference_line(records: Sequence[Geometry], s_m: F64) -> F64:
    """Return ``(N, 3)`` x, y and heading (not wrapped) of a road's reference line at arc lengths
    ``(N,)``.
    """
    starts = np.array([record.s_m for record in records])
    owner = np.clip(np.searchsorted(starts, s_m, side="right") - 1, 0, len(records) - 1)
    out = np.empty((len(s_m), 3))
    for i in np.unique(owner):
        rows = owner == i
        out[rows] = records[i].at(s_m[rows] - records[i].s_m)
    return out


def gap_m(road: Road) -> float:
    """Return the largest distance, metres, between the end of a record of a road's reference line
    and the start of the next one.
    """
    largest = 0.0
    for record, following in itertools.pairwise(road.records):
        end = record.at(np.array([following.s_m - record.s_m]))[0]
        away = float(np.hypot(end[0] - following.x_m, end[1] - following.y_m))
        largest = max(largest, away)
    return largest


def cubics_at(records: F64, s_m: F64) -> F64:
    """Return ``(N,)`` the value of the record in force at each arc length; before the first record
    that one is extended, none gives 0.

    Args:
        records: Rows s, a, b, c, d, ordered by s: ``a + b ds + c ds^2 + d ds^3`` from s on.
        s_m: ``(N,)``.
    """
    if not len(records):
        return np.zeros(len(s_m))
    rows = np.searchsorted(records[:, 0], s_m, side="right") - 1
    s0, a, b, c, d = records[np.maximum(rows, 0)].T
    ds = s_m - s0
    return a + ds * (b + ds * (c + d * ds))


def beside(line: F64, t_m: F64) -> F64:
    """Return points ``(N, 2)`` at signed distances ``t_m (N,)``, left positive, across a line ``(N,
    3)`` of x, y, heading.
    """
    return np.column_stack(
        [line[:, 0] - t_m * np.sin(line[:, 2]), line[:, 1] + t_m * np.cos(line[:, 2])]
    )


Limit = tuple[float, float | None]  # from a place on, metres: speed limit in m/s, None without one


@dataclass(frozen=True)
class RoadMark:
    """A line along the outer border of a lane."""

    kind: str
    colour: str
    explicit: bool  # the map gives its pieces by themselves, as where it leads through a junction


@dataclass(frozen=True)
class OdrLane:
    """A lane of one section. ``widths`` and ``borders`` count s from the road's start."""

    lane_id: int
    kind: str
    widths: F64  # see `cubics_at`
    borders: F64
    successors: tuple[int, ...]
    predecessors: tuple[int, ...]
    mark: RoadMark | None  # the first one of its outer border
    reversed: bool = False  # driven against the usual direction of its side
    level: bool = False  # it and the lanes outside of it are not banked with the road
    limits: tuple[Limit, ...] = ()  # of its own, which go before those of the road
    closed: bool = False  # its access rules keep cars out


@dataclass(frozen=True)
class Section:
    """Lanes between two arc lengths."""

    s_m: float
    end_m: float
    lanes: tuple[OdrLane, ...]

    def side(self, sign: int) -> tuple[OdrLane, ...]:
        """Return the lanes of one side (1 left, -1 right), from the middle outwards."""
        return tuple(
            sorted(
                (lane for lane in self.lanes if lane.lane_id * sign > 0),
                key=lambda lane: abs(lane.lane_id),
            )
        )


@dataclass(frozen=True)
class RoadLink:
    """What a road's end is joined to."""

    kind: str  # road | junction
    target: str
    at_start: bool  # contact point


@dataclass(frozen=True)
class RoadSignal:
    """A light, a sign or a mark on a road, as written or by reference."""

    signal_id: str
    kind: str  # the country's catalogue number; 294: stop line
    dynamic: bool  # it changes its state: a light
    s_m: float
    t_m: float
    above_m: float
    orientation: str  # "+": for traffic along the road, "-": against it, else for both
    width_m: float
    height_m: float
    lanes: tuple[tuple[int, int], ...] = ()  # ranges of lanes that it is for; none: all
    by_reference: bool = False  # it stands where another road has it

    def holds(self, lane_id: int) -> bool:
        """Return whether it is for a lane, its direction apart."""
        return not self.lanes or any(low <= lane_id <= high for low, high in self.lanes)


@dataclass(frozen=True)
class Road:
    """One road."""

    road_id: str
    length_m: float
    junction: str  # "-1": none
    left_hand: bool  # traffic keeps left
    records: tuple[Geometry, ...]
    elevation: F64  # see `cubics_at`
    superelevation: F64
    lane_offset: F64
    sections: tuple[Section, ...]
    successor: RoadLink | None
    predecessor: RoadLink | None
    signals: tuple[RoadSignal, ...] = ()
    crosswalks: tuple[F64, ...] = ()  # rings (N, 2) of s and t
    limits: tuple[Limit, ...] = ()
    kinds: tuple[tuple[float, str], ...] = ()  # from a place on, metres: motorway, town ...

    @property
    def has_level_lanes(self) -> bool:
        """Return whether superelevation leaves out some lanes."""
        lanes = (lane for section in self.sections for lane in section.lanes)
        return len(self.superelevation) > 0 and any(lane.level for lane in lanes if lane.lane_id)


@dataclass(frozen=True)
class Connection:
    """A way into a junction: lanes of an incoming road to lanes of a connecting road, or, in a
    direct junction, of a linked road. Without lanes those of one direction are linked.
    """

    junction: str
    incoming: str
    connecting: str
    at_start: bool
    lanes: tuple[tuple[int, int], ...]
    direct: bool = False


@dataclass(frozen=True)
class OdrMap:
    """A whole file."""

    roads: tuple[Road, ...]
    connections: tuple[Connection, ...]
    geo_reference: str
    controllers: Mapping[str, str]  # signal to the controller that switches it
    notes: tuple[str, ...] = ()
    country: str | None = None  # a code of ISO 3166, where all roads that name one agree


def parse_map(location: Path | str, root: Element) -> OdrMap:
    """Parse an OpenDRIVE document.

    Raises:
        InputError: It is no OpenDRIVE, has no road, or a record lacks a number.
    """
    for element in root.iter():  # without namespaces
        element.tag = element.tag.rpartition("}")[2]
    elements = {str(road.get("id")): road for road in root.findall("road")}
    if root.tag != "OpenDRIVE" or not elements:
        raise InputError(
            f"{location}: a document <{root.tag}> of {len(elements)} roads",
            "give an OpenDRIVE file, whose root is <OpenDRIVE>, with at least one road",
        )
    if len(elements) < len(root.findall("road")):
        raise InputError(f"{location}: two roads of one id", "give every road its own id")
    originals = {str(signal.get("id")): signal for signal in root.iter("signal")}
    unused: Counter[str] = Counter()
    roads = []
    for road_id, element in elements.items():
        with parsing(f"{location}, road {road_id}", "correct the numbers of this road"):
            roads.append(_road(element, f"{location}, road {road_id}", originals, unused))
    with parsing(location, "correct the links of its junctions"):
        connections = tuple(
            _connection(junction, connection)
            for junction in root.findall("junction")
            for connection in junction.findall("connection")
        )
    controllers = {
        control.get("signalId", ""): controller.get("id", "")
        for controller in root.findall("controller")
        for control in controller.findall("control")
    }
    geo_reference = (root.findtext(".//geoReference") or "").strip()
    notes = (*_odd_sides(elements), *OPENDRIVE.notes_of_xml(root), *_notes(root, unused))
    country = country_of(kind.get("country", "") for kind in root.iterfind("road/type"))
    return OdrMap(tuple(roads), connections, geo_reference, controllers, notes, country)


def _connection(junction: Element, connection: Element) -> Connection:
    return Connection(
        junction.get("id", ""),
        connection.get("incomingRoad", ""),
        connection.get("connectingRoad", connection.get("linkedRoad", "")),
        connection.get("contactPoint", "start") == "start",
        tuple(
            (int(link.get("from", "")), int(link.get("to", "")))
            for link in connection.findall("laneLink")
        ),
        "linkedRoad" in connection.attrib,
    )


def _notes(root: Element, unused: Counter[str]) -> list[str]:
    """Return notes on what a document holds and is not used; ``unused`` counts what the roads have
    of it.
    """
    notes = [
        f"elements <{tag}> of the map are not read: {len(root.findall(tag))}"
        for tag in sorted({child.tag for child in root} - KNOWN)
    ]
    notes += [f"{n} {element}" for element, n in sorted(unused.items())]
    if root.find("header/offset") is not None:
        notes.append(
            "the offset in the map's header is not applied: its coordinates are as written"
        )
    kinds = {junction.get("type", "default") for junction in root.findall("junction")}
    notes += [
        f"junctions of type {kind} are not driven through" for kind in sorted(kinds - {*JUNCTIONS})
    ]
    counts = {
        "lanes for both directions are driven in one only: {}": sum(
            lane.get("type") == "bidirectional" or lane.get("direction") == "both"
            for lane in root.iter("lane")
        ),
        "speed limits of 0 are taken as none: {}": sum(map(_is_zero, root.iter("speed"))),
        "{} lanes are driven as travelDir in their userData says, against the direction of their side": (
            _n_turned_by_user_data(root)
        ),
        "lanes that change their marking inside a section, of which the first holds: {}": sum(
            len(lane.findall("roadMark")) > 1 for lane in root.iter("lane")
        ),
        "lanes that access rules close to cars are not driven by them: {}": sum(
            map(_closed_to_cars, root.iter("lane"))
        ),
        "{} cross section shapes of the map are not used": len(
            root.findall(".//lateralProfile/shape")
        ),
    }
    return notes + [sentence.format(n) for sentence, n in counts.items() if n]


def _n_turned_by_user_data(root: Element) -> int:
    """Count the lanes without a direction that their userData turns."""
    return sum(
        _is_reversed(lane, road.get("rule", "RHT").upper() == "LHT")
        for road in root.findall("road")
        for lane in road.iter("lane")
        if lane.get("direction") is None and lane.get("id") != "0"
    )


def _odd_sides(elements: Mapping[str, Element]) -> list[str]:
    """Return a note on lanes whose number belongs to the other side of the reference line: the
    number counts, since the reference lines of netconvert's left-hand junctions follow it.
    """
    sides = {"left": 1, "right": -1}
    odd = [
        f"{lane.get('id')} of road {road_id}"
        for road_id, road in elements.items()
        for side, sign in sides.items()
        for lane in road.findall(f"lanes/laneSection/{side}/lane")
        if int(lane.get("id", "0")) * sign < 0
    ]
    if not odd:
        return []
    return [
        f"{len(odd)} lanes stand under a side that is not that of their number, which is followed: {some_of(odd)}"
    ]


def _road(
    element: Element, location: str, originals: Mapping[str, Element], unused: Counter[str]
) -> Road:
    """Parse a road; what stands on it and is not used is counted in ``unused``."""
    road_m = _number(element, "length")
    MAP_ROAD_M.check(road_m, location, "length")
    rule = element.get("rule", "RHT").upper()
    if rule not in ("RHT", "LHT"):
        raise ValueError(f"rule = {rule!r}, neither RHT nor LHT")
    signals, crosswalks = _signals_and_crosswalks(element, originals, unused)
    geometries = element.findall("planView/geometry")
    records = [_geometry(geometry, location, road_m) for geometry in geometries]
    types = sorted(element.findall("type"), key=_start_m)
    return Road(
        str(element.get("id")),
        road_m,
        element.get("junction", "-1"),
        rule == "LHT",
        tuple(sorted(records, key=lambda record: record.s_m)),
        _cubics(element, "elevationProfile/elevation"),
        _cubics(element, "lateralProfile/superelevation"),
        _cubics(element, "lanes/laneOffset"),
        _sections(element, road_m, rule == "LHT"),
        _link(element, "successor"),
        _link(element, "predecessor"),
        signals,
        crosswalks,
        tuple((_start_m(kind), _limit_mps(kind.find("speed"))) for kind in types),
        tuple((_start_m(kind), kind.get("type", "unknown")) for kind in types),
    )


def _start_m(element: Element) -> float:
    return _number(element, "s", 0.0)


def _signals_and_crosswalks(
    element: Element, originals: Mapping[str, Element], unused: Counter[str]
) -> tuple[tuple[RoadSignal, ...], tuple[F64, ...]]:
    """Return the signals and stop lines of a road, and the rings ``(N, 2)`` of s and t of its
    crosswalks.

    Crosswalks are objects of that type, or marks of type 1000003, which have no length along the
    road: 4 m is assumed. Stop lines are marks of type 294, or objects with such a name.
    """
    signals = [_signal(signal, signal) for signal in element.findall("signals/signal")]
    rings = [_rectangle(signal) for signal in signals if signal.kind == CROSSWALK]
    for road_object in element.findall("objects/object"):
        name = f"{road_object.get('name')}{road_object.get('subtype')}".lower().replace(" ", "")
        if road_object.get("type") == "crosswalk" and road_object.find(".//outline") is not None:
            rings.append(_crosswalk(road_object))
        elif "stopline" in name:
            signals.append(replace(_signal(road_object, road_object), kind=STOP_LINE))
        else:
            unused[f"objects of type {road_object.get('type')} are not used"] += 1
    for reference in element.findall("signals/signalReference"):
        original = originals.get(str(reference.get("id")))
        if original is None:
            unused["references to signals that the map does not have are left out"] += 1
        else:
            signals.append(_signal(reference, original))
    return tuple(signals), tuple(rings)


def _sections(element: Element, road_m: float, left_hand: bool) -> tuple[Section, ...]:
    """Return the lane sections of a road in the order of their starts.

    Raises:
        ValueError: A section holds one side only, or starts outside of the road.
    """
    sections = sorted(element.findall("lanes/laneSection"), key=_start_m)
    if any(section.get("singleSide") == "true" for section in sections):
        raise ValueError("lane sections of a single side, which are not read: write both sides")
    starts = [_start_m(section) for section in sections]
    if starts and not (starts[0] >= 0 and starts[-1] <= road_m):
        raise ValueError(f"lane sections at {starts} of a road of {road_m} m")
    ends = [*starts, road_m][1:]
    return tuple(
        _section(section, start, end, left_hand)
        for section, start, end in zip(sections, starts, ends, strict=True)
    )


def limits_in(lane: OdrLane, road: Road, section: Section) -> list[float | None]:
    """Return the speed limits in m/s that hold on a lane of a section, in the order of the road;
    None stands for a part without a limit.
    """
    starts = [start for start, _ in (*road.limits, *lane.limits)]
    places = {section.s_m, *(s for s in starts if section.s_m < s < section.end_m)}
    return [
        _limit_at(lane.limits, s_m) if _has_begun(lane.limits, s_m) else _limit_at(road.limits, s_m)
        for s_m in sorted(places)
    ]


def _has_begun(limits: Sequence[Limit], s_m: float) -> bool:
    return any(start_m <= s_m for start_m, _ in limits)


def _limit_at(limits: Sequence[Limit], s_m: float) -> float | None:
    return next((mps for start_m, mps in limits[::-1] if start_m <= s_m), None)


def _is_zero(speed: Element) -> bool:
    """Return whether a limit is 0, which RoadRunner writes where none is stated."""
    try:
        return float(speed.get("max", "")) == 0.0
    except ValueError:
        return False


def _limit_mps(speed: Element | None) -> float | None:
    text = "" if speed is None else speed.get("max", "")
    if speed is None or text in ("", "no limit", "undefined") or _is_zero(speed):
        return None
    value = float(text) * UNITS_MPS[speed.get("unit", "m/s")]
    LIMIT_MPS.check(value, "speed", "max")
    return value


def _geometry(record: Element, location: str, road_m: float) -> Geometry:
    shapes = [child for child in record if child.tag in _PARAMETERS]
    if not shapes:
        raise ValueError(f"a <geometry> of none of {', '.join(_PARAMETERS)}")
    shape = shapes[0]
    numbers = tuple(_number(shape, name) for name in _PARAMETERS[shape.tag])
    s, x, y, heading, length = (_number(record, name) for name in ("s", "x", "y", "hdg", "length"))
    MAP_ROAD_M.check(length, location, "length of a <geometry>")
    if not -1.0 <= s <= road_m + 1.0:
        raise ValueError(f"a <geometry> at s = {s:g} of a road of {road_m:g} m")
    if shape.tag in ("arc", "spiral"):
        for value in numbers:
            MAP_CURVATURE_PER_M.check(value, location)
    normalised = shape.get("pRange", "normalized") != "arcLength"
    return Geometry(s, x, y, heading, length, shape.tag, numbers, normalised)


def _closed_to_cars(lane: Element) -> bool:
    """Return whether the access rules of a lane keep cars out, on a part of it or all along.

    Where the rules from one place on allow some, all others are kept out there; a rule that does not
    say what it does restricts those that it names.
    """
    allowed: dict[str, set[str]] = {}
    denied: dict[str, set[str]] = {}
    for access in lane.findall("access"):
        begin = access.get("sOffset", "0")
        names = {access.get("restriction", "")}
        names |= {part.get("type", "") for part in access.findall("restriction")}
        by_begin = allowed if access.get("rule") == "allow" else denied
        by_begin.setdefault(begin, set()).update(names - {""})
    are_denied = any(names & CARS for names in denied.values())
    are_left_out = any(names and not names & CARS for names in allowed.values())
    return are_denied or are_left_out


def _is_reversed(lane: Element, left_hand: bool) -> bool:
    """Return whether a lane is driven against the usual direction of its side: by its attribute, and
    where it has none by the direction of travel that RoadRunner writes into its user data.
    """
    if lane.get("direction") is not None:
        return lane.get("direction") == "reversed"
    stated = {travel.get("travelDir") for travel in lane.findall("userData/vectorLane")}
    directions = stated & {"forward", "backward"}
    if len(directions) != 1:
        return False
    is_usually_forward = (int(lane.get("id", "0")) < 0) != left_hand
    return directions != {"forward" if is_usually_forward else "backward"}


def _lane(lane: Element, section_m: float, left_hand: bool) -> OdrLane:
    """Return a lane of a section that starts at ``section_m`` of its road."""
    return OdrLane(
        int(lane.get("id", "")),
        lane.get("type", "none"),
        _cubics(lane, "width", "sOffset", section_m),
        _cubics(lane, "border", "sOffset", section_m),
        tuple(int(link.get("id", "")) for link in lane.findall("link/successor")),
        tuple(int(link.get("id", "")) for link in lane.findall("link/predecessor")),
        _mark(lane.find("roadMark")),
        _is_reversed(lane, left_hand),
        lane.get("level") == "true",
        tuple(
            (section_m + _number(limit, "sOffset", 0.0), _limit_mps(limit))
            for limit in lane.findall("speed")
            if not _is_zero(limit)
        ),
        _closed_to_cars(lane),
    )


def _section(element: Element, start_m: float, end_m: float, left_hand: bool) -> Section:
    lanes = [
        _lane(lane, start_m, left_hand)
        for side in ("left", "center", "right")
        for lane in element.findall(f"{side}/lane")
    ]
    return Section(start_m, end_m, tuple(lanes))


def _mark(element: Element | None) -> RoadMark | None:
    if element is None:
        return None
    is_explicit = element.find("explicit") is not None
    return RoadMark(element.get("type", "none"), element.get("color", "standard"), is_explicit)


def _cubics(owner: Element, place: str, start_key: str = "s", start_m: float = 0.0) -> F64:
    """Return the records of an element as rows s, a, b, c, d, ordered by s; see `cubics_at`."""
    rows = [
        [start_m + _number(record, start_key), *(_number(record, name, 0.0) for name in _ABCD)]
        for record in owner.findall(place)
    ]
    return np.array(sorted(rows, key=lambda row: row[0]), dtype=np.float64).reshape(-1, 5)


def _signal(place: Element, nature: Element) -> RoadSignal:
    """Return a signal; one by reference has its place from there, and its nature from where it was
    written.
    """
    lanes = [
        (int(validity.get("fromLane", "")), int(validity.get("toLane", "")))
        for validity in place.findall("validity")
    ]
    return RoadSignal(
        nature.get("id", ""),
        nature.get("type", ""),
        nature.get("dynamic") == "yes",
        _number(place, "s"),
        _number(place, "t"),
        _number(nature, "zOffset", 0.0),
        place.get("orientation", "none"),
        _number(nature, "width", 0.0),
        _number(nature, "height", 0.0),
        tuple((min(ends), max(ends)) for ends in lanes),
        place is not nature,
    )


def _rectangle(signal: RoadSignal) -> F64:
    """Return the ring ``(5, 2)`` of s and t of a crosswalk that is a mark across a road."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    return np.array([signal.s_m, signal.t_m]) + corners * [CROSSWALK_M / 2, signal.width_m / 2]


def _crosswalk(crosswalk: Element) -> F64:
    """Return the ring ``(N, 2)`` of s and t of a crosswalk's outline."""
    turn = _number(crosswalk, "hdg", 0.0)
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    local = [[_number(corner, k) for k in "uv"] for corner in crosswalk.findall(".//cornerLocal")]
    on_road = [[_number(corner, k) for k in "st"] for corner in crosswalk.findall(".//cornerRoad")]
    placed = np.array(local).reshape(-1, 2) @ turned + [
        _number(crosswalk, "s"),
        _number(crosswalk, "t"),
    ]
    ring = np.concatenate([placed, np.array(on_road).reshape(-1, 2)])
    return np.concatenate([ring, ring[:1]])


def _number(element: Element, name: str, default: float | None = None) -> float:
    text = element.get(name)
    if text is None and default is not None:
        return default
    value = float(text or "nan")
    if not np.isfinite(value):
        raise ValueError(f"<{element.tag}> with {name} = {text!r}, which is no finite number")
    return value


def _link(road: Element, tag: str) -> RoadLink | None:
    link = road.find(f"link/{tag}")
    if link is None:
        return None
    return RoadLink(
        link.get("elementType", "road"),
        str(link.get("elementId")),
        link.get("contactPoint", "start") == "start",
    )


def driven_along(road: Road, lane: OdrLane) -> bool:
    """Return whether a lane is driven in the direction of its road's arc length."""
    return ((lane.lane_id < 0) != road.left_hand) != lane.reversed


def lane_borders(road: Road, section: Section, s_m: F64) -> Iterator[tuple[OdrLane, F64, F64]]:
    """Give each lane of both sides with the signed distances ``(N,)`` of its inner and its outer
    border at arc lengths ``(N,)``: by widths, or by borders where it has those instead.
    """
    middle = cubics_at(road.lane_offset, s_m)
    for sign in (1, -1):
        inner_t = middle
        for lane in section.side(sign):
            if len(lane.borders) and not len(lane.widths):
                outer_t = middle + cubics_at(lane.borders, s_m)
            else:
                outer_t = inner_t + sign * np.maximum(cubics_at(lane.widths, s_m), 0.0)
            yield lane, inner_t, outer_t
            inner_t = outer_t


def lanes_at(road: Road, s_m: float) -> Iterator[tuple[OdrLane, str, float, float]]:
    """Give each lane at an arc length with its key and the signed distances of its borders."""
    station_m = np.array([min(s_m, float(np.nextafter(road.length_m, 0.0)))])
    index = max(
        (i for i, section in enumerate(road.sections) if section.s_m <= station_m[0]), default=0
    )
    for lane, inner_t, outer_t in lane_borders(road, road.sections[index], station_m):
        yield lane, lane_key(road, index, lane.lane_id), float(inner_t[0]), float(outer_t[0])


def placed(road: Road, st: F64, T_local_map: F64) -> F64:
    """Return points ``(N, 3)`` in the local frame of a road's s and t ``(N, 2)``."""
    line = reference_line(road.records, st[:, 0])
    return road_points(road, line, st[:, 0], st[:, 1], T_local_map)


def road_points(road: Road, line: F64, s_m: F64, t_m: F64, T_local_map: F64) -> F64:
    """Return points ``(N, 3)`` in the local frame, at signed distances ``(N,)`` from the reference
    line ``(N, 3)`` at arc lengths ``(N,)``.
    """
    slope = np.tan(cubics_at(road.superelevation, s_m))
    height = cubics_at(road.elevation, s_m) + _banked_t(road, s_m, t_m) * slope
    return transform_points(T_local_map, np.column_stack([beside(line, t_m), height]))


def _banked_t(road: Road, s_m: F64, t_m: F64) -> F64:
    """Return the signed distances ``(N,)`` up to which the road is banked: those of points on a
    level lane, or outside of one, end at the inner border of that lane.
    """
    if not road.has_level_lanes:
        return t_m
    low_t = np.full(len(s_m), -np.inf)
    high_t = np.full(len(s_m), np.inf)
    starts = np.array([section.s_m for section in road.sections])
    owner = np.clip(np.searchsorted(starts, s_m, side="right") - 1, 0, len(starts) - 1)
    for i in np.unique(owner):
        rows = owner == i
        for lane, inner_t, _ in lane_borders(road, road.sections[i], s_m[rows]):
            if lane.level and lane.lane_id < 0:
                low_t[rows] = np.maximum(low_t[rows], inner_t)
            elif lane.level:
                high_t[rows] = np.minimum(high_t[rows], inner_t)
    return np.clip(t_m, low_t, high_t)


def lane_key(road: Road, section: int, lane_id: int) -> str:
    """Return the id under which a lane of a section enters a lane map."""
    return f"{road.road_id}.{section}.{lane_id}"
