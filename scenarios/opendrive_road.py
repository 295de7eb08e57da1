"""OpenDRIVE roads as written: plan view, elevation, lane sections, links; nothing is interpreted here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from alpasim_plugin.io.limits import MAP_CURVATURE_PER_M, MAP_ROAD_M
from scenarios.opendrive_geometry import KINDS, Cubic, Geometry
from scenarios.reading import SourceFiles

MAX_ROAD_M = MAP_ROAD_M.high
_ABCD = ("a", "b", "c", "d")
_PARAMETERS = {
    "line": (),
    "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"),
    "poly3": _ABCD,
    "paramPoly3": tuple(f"{k}{axis}" for axis in "UV" for k in _ABCD),
}


@dataclass(frozen=True)
class OdrLane:
    """A lane of one section. ``widths`` and ``borders`` count s from the road's start."""

    lane_id: int
    kind: str
    widths: tuple[Cubic, ...]
    borders: tuple[Cubic, ...]
    successors: tuple[int, ...]
    predecessors: tuple[int, ...]
    mark: tuple[str, str] | None  # type and colour of the first road mark of its outer border


@dataclass(frozen=True)
class Section:
    """Lanes between two arc lengths."""

    s_m: float
    end_m: float
    lanes: tuple[OdrLane, ...]

    def side(self, sign: int) -> tuple[OdrLane, ...]:
        """Return the lanes of one side (1 left, -1 right), from the middle outwards."""
        return tuple(sorted((one for one in self.lanes if one.lane_id * sign > 0), key=lambda one: abs(one.lane_id)))


@dataclass(frozen=True)
class RoadLink:
    """What a road's end is joined to."""

    kind: str  # road | junction
    target: str
    at_start: bool  # contact point


@dataclass(frozen=True)
class Road:
    """One road."""

    road_id: str
    length_m: float
    junction: str  # "-1": none
    left_hand: bool  # traffic keeps left
    records: tuple[Geometry, ...]
    elevation: tuple[Cubic, ...]
    superelevation: tuple[Cubic, ...]
    lane_offset: tuple[Cubic, ...]
    sections: tuple[Section, ...]
    successor: RoadLink | None
    predecessor: RoadLink | None


@dataclass(frozen=True)
class Connection:
    """A way into a junction: lanes of an incoming road to lanes of a connecting road."""

    incoming: str
    connecting: str
    at_start: bool
    lanes: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class OdrMap:
    """A whole file."""

    roads: tuple[Road, ...]
    connections: tuple[Connection, ...]
    geo_reference: str
    n_signals: int
    n_objects: int


def parse_map(files: SourceFiles, where: Path | str, root: Element) -> OdrMap:
    """Parse an OpenDRIVE document.

    Raises:
        InputError: It is no OpenDRIVE, has no road, or a record lacks a number.
    """
    _drop_namespaces(root)
    if root.tag != "OpenDRIVE":
        raise files.fail(where, f"a document <{root.tag}>", "give an OpenDRIVE file, whose root is <OpenDRIVE>")
    roads = tuple(_road(files, where, element) for element in root.findall("road"))
    if not roads:
        raise files.fail(where, "a map without roads", "use a map with at least one road")
    connections = tuple(
        Connection(
            c.get("incomingRoad", ""), c.get("connectingRoad", ""), c.get("contactPoint", "start") == "start",
            tuple((_integer(files, where, link, "from"), _integer(files, where, link, "to")) for link in c.findall("laneLink")),
        )
        for j in root.findall("junction") for c in j.findall("connection")
    )  # fmt: skip
    reference = root.find(".//geoReference")
    counts = [len(root.findall(f".//{name}")) for name in ("signal", "object")]
    return OdrMap(roads, connections, (reference.text or "").strip() if reference is not None else "", *counts)


def _road(files: SourceFiles, where: Path | str, element: Element) -> Road:
    here = f"{where}, road {element.get('id')}"

    def number(owner: Element, name: str, default: float | None = None) -> float:
        text = owner.get(name)
        if text is None and default is not None:
            return default
        try:
            value = float(str(text))
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise files.fail(here, f"<{owner.tag}> with {name} = {text!r}", "give a finite number")
        return value

    def cubics(owner: Element | None, tag: str, at: str = "s", start_m: float = 0.0) -> tuple[Cubic, ...]:
        found = owner.findall(tag) if owner is not None else []
        records = [Cubic(start_m + number(r, at), *(number(r, k, 0.0) for k in _ABCD)) for r in found]
        return tuple(sorted(records, key=lambda r: r.s_m))

    road_m = number(element, "length")
    MAP_ROAD_M.check(road_m, files.doing, here, "length")

    def geometry(record: Element) -> Geometry:
        shape = next((child for child in record if child.tag in KINDS), None)
        if shape is None:
            raise files.fail(here, f"a <geometry> of {[child.tag for child in record]}", f"use {', '.join(KINDS)}")
        numbers = tuple(number(shape, name) for name in _PARAMETERS[shape.tag])
        s, x, y, heading, length = (number(record, name) for name in ("s", "x", "y", "hdg", "length"))
        MAP_ROAD_M.check(length, files.doing, here, "length of a <geometry>")
        if not -1.0 <= s <= road_m + 1.0:
            raise files.fail(here, f"a <geometry> at s = {s:g} of a road of {road_m:g} m", "start every record on the road")
        if shape.tag in ("arc", "spiral"):
            for value in numbers:
                MAP_CURVATURE_PER_M.check(value, files.doing, here)
        kind = next(k for k in KINDS if k == shape.tag)
        return Geometry(s, x, y, heading, length, kind, numbers, shape.get("pRange", "normalized") != "arcLength")

    def lane(one: Element, start_m: float) -> OdrLane:
        mark = one.find("roadMark")
        links = {tag: tuple(_integer(files, here, e, "id") for e in one.findall(f"link/{tag}")) for tag in ("successor", "predecessor")}
        return OdrLane(
            _integer(files, here, one, "id"), one.get("type", "none"), cubics(one, "width", "sOffset", start_m),
            cubics(one, "border", "sOffset", start_m), links["successor"], links["predecessor"],
            None if mark is None else (mark.get("type", "none"), mark.get("color", "standard")),
        )  # fmt: skip

    length = road_m
    lanes = element.find("lanes")
    elements = sorted(lanes.findall("laneSection") if lanes is not None else [], key=lambda e: number(e, "s", 0.0))
    starts = [number(e, "s", 0.0) for e in elements]
    sections = tuple(
        Section(start, end, tuple(lane(one, start) for side in ("left", "center", "right") for one in e.findall(f"{side}/lane")))
        for e, start, end in zip(elements, starts, [*starts[1:], length], strict=True)
    )
    if any(not 0 <= start <= length for start in starts):
        raise files.fail(here, f"lane sections at {starts} of a road of {length} m", "start every section on the road")
    view = element.find("planView")
    records = tuple(geometry(r) for r in (view.findall("geometry") if view is not None else []))
    return Road(
        str(element.get("id")), length, element.get("junction", "-1"), element.get("rule") == "LHT", records,
        cubics(element.find("elevationProfile"), "elevation"), cubics(element.find("lateralProfile"), "superelevation"),
        cubics(lanes, "laneOffset"), sections, _link(element, "successor"), _link(element, "predecessor"),
    )  # fmt: skip


def _integer(files: SourceFiles, where: Path | str, element: Element, name: str) -> int:
    try:
        return int(str(element.get(name)))
    except ValueError as error:
        raise files.fail(where, f"<{element.tag}> with {name} = {element.get(name)!r}", "give an integer") from error


def _link(road: Element, tag: str) -> RoadLink | None:
    found = road.find(f"link/{tag}")
    if found is None:
        return None
    return RoadLink(found.get("elementType", "road"), str(found.get("elementId")), found.get("contactPoint", "start") == "start")


def _drop_namespaces(root: Element) -> None:
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]


def lane_key(road: Road, section: int, lane_id: int) -> str:
    """Return the id under which a lane of a section enters a lane map."""
    return f"{road.road_id}.{section}.{lane_id}"


def curved(records: Sequence[Geometry]) -> bool:
    """Return whether any record is curved."""
    return any(one.kind != "line" for one in records)
