"""Lanelets of a CommonRoad file (versions 2018b and 2020a) as a lane map."""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, some_of
from alpasim_plugin.core.geometry import centre_line, heading_of
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import F64, Lane, LaneMap, LaneMarkType, Signal
from scenarios.map_borders import lane_borders
from scenarios.map_lines import MEET_M, is_left_of, predecessors
from scenarios.recorded import near

# Line markings of version 2020a; the format has no colour, so lines are white.
MARK_TYPES: dict[str, LaneMarkType] = {
    "solid": "solid_white",
    "broad_solid": "solid_white",
    "solid_solid": "solid_white",
    "solid_dashed": "solid_white",
    "dashed_solid": "solid_white",
    "dashed": "dashed_white",
    "broad_dashed": "dashed_white",
    "dashed_dashed": "dashed_white",
    "curb": "none",
    "lowered_curb": "none",
    "no_marking": "none",
    "unknown": "unknown",
}
COLOURS = {
    "red": "red",
    "redYellow": "red_yellow",
    "yellow": "yellow",
    "green": "green",
    "inactive": "inactive",
}
# Phases in microseconds, and when the first begins.
Cycle = tuple[tuple[tuple[str, int], ...], int]
KINDS = {"shoulder": "shoulder", "busLane": "bus", "bicycleLane": "bike", "parking": "parking"}
CARS = {"vehicle", "car", "taxi"}  # among the users that a lanelet may name
NOT_FOR_CARS = {"sidewalk", "crosswalk"}
_FOR_CARS = """urban interstate country highway exitRamp accessRamp mainCarriageWay driveWay
    intersection busStop"""
TYPES = {*KINDS, *NOT_FOR_CARS, *_FOR_CARS.split()}
# Maximum speed in the countries of CommonRoad, as its documentation numbers the signs.
MAX_SPEED_SIGNS = ("274", "R2-1", "R15", "C43", "B31", "B14", "\u03a1-32", "3.24", "r301")
# The additional value is in m/s unless it states another unit.
SPEED_UNITS_MPS = {"": 1.0, "m/s": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "mph": 0.44704}
# A lanelet covered to this share by lanelets it is not linked to lies in an intersection.
CROSSING_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class Lanelet:
    """A lanelet as its file has it.

    Attributes:
        element: The lanelet's element.
        lane_id: The lanelet's id.
        location: File and id, for messages.
        types: The lanelet's types, none of them checked.
        left: The left bound ``(N, 3)``, metres, local.
        right: The right bound ``(M, 3)``, metres, local.
    """

    element: Element
    lane_id: str
    location: str
    types: tuple[str, ...]
    left: F64
    right: F64

    @property
    def users(self) -> set[str]:
        """Return the road users that it is for, in one direction or both; none where it names none."""
        named = [*self.element.findall("userOneWay"), *self.element.findall("userBidirectional")]
        return {str(user.text) for user in named}

    @property
    def kind(self) -> str | None:
        """Return the kind of its lane; None where no vehicle drives on it."""
        if NOT_FOR_CARS & {*self.types}:
            return None
        by_type = next((KINDS[name] for name in self.types if name in KINDS), None)
        if by_type is not None or not self.users or self.users & CARS:
            return by_type or "vehicle"
        if self.users <= {"pedestrian", "train"}:
            return None
        return "bike" if self.users <= {"bicycle", "pedestrian"} else "bus"

    def linked(self, tag: str) -> list[str]:
        """Return the ids of its successors or predecessors."""
        return [str(link.get("ref")) for link in self.element.findall(tag)]


def read_lanelets(path: Path, root: Element, origin: F64) -> tuple[LaneMap, tuple[str, ...]]:
    """Read all lanelets around ``origin (3,)``, with notes.

    Raises:
        InputError: There is no lanelet for vehicles, or one lacks a bound.
    """
    signs = _speed_signs(root)
    lights, light_notes = _traffic_lights(path, root)
    lanelets = [_lanelet(path, element, origin) for element in root.findall("lanelet")]
    exchanged = _exchanged([lanelet for lanelet in lanelets if lanelet.kind is not None])
    roads = [
        _with_bounds_in_order(lanelet, exchanged)
        for lanelet in lanelets
        if lanelet.kind is not None
    ]
    if not roads:
        raise InputError(
            f"{path}: {len(lanelets)} lanelets, none for vehicles", "use a scenario with a road"
        )
    lanes: dict[str, Lane] = {}
    stop_lines: list[F64] = []
    signals: list[Signal] = []
    for lanelet in roads:
        with parsing(lanelet.location, "correct the lanelet"):
            lane = _lane(lanelet, signs)
            lanes[lanelet.lane_id] = lane
            waiting_line = _waiting_line(lanelet, origin)
            signals += _signals(lanelet, lane.centre, waiting_line, lights)
            if _has_stop_line(lanelet):
                stop_lines.append(waiting_line)
    lane_map = LaneMap(
        lanes=mark_intersections(lanes),
        road_edges=lane_borders(lanes),
        crosswalks=tuple(_ring(lanelet) for lanelet in lanelets if "crosswalk" in lanelet.types),
        stop_lines=tuple(stop_lines),
        signals=tuple(signals) or None,
    )
    notes = [*_lanelet_notes(root, lanelets, len(exchanged)), *_user_notes(lanelets)]
    return lane_map, (*light_notes, *notes, *_sign_notes(root))


def _lanelet(path: Path, element: Element, origin: F64) -> Lanelet:
    """Read id, types and bounds of a lanelet.

    Raises:
        InputError: A bound is missing, or a point is not finite or far away.
    """
    lane_id = str(element.get("id"))
    location = f"{path}, lanelet {lane_id}"
    with parsing(location, "correct the lanelet"):
        return Lanelet(
            element=element,
            lane_id=lane_id,
            location=location,
            types=tuple(str(kind.text) for kind in element.findall("laneletType")),
            left=near(location, _line(element, "leftBound", 2) - origin),
            right=near(location, _line(element, "rightBound", 2) - origin),
        )


def _exchanged(lanelets: Sequence[Lanelet]) -> set[str]:
    """Return the ids of the lanelets whose left bound the file names right and whose right one left.

    The outline of a lanelet that is shorter than it is wide may be knotted. So one whose ends meet
    those of a linked lanelet is taken as it is written where that one's bounds are in order.
    """
    by_outline = {
        lanelet.lane_id for lanelet in lanelets if is_left_of(lanelet.right, lanelet.left)
    }
    in_order = {
        lanelet.lane_id: lanelet for lanelet in lanelets if lanelet.lane_id not in by_outline
    }
    confirmed = set()
    for lanelet in lanelets:
        after = [in_order[name] for name in lanelet.linked("successor") if name in in_order]
        before = [in_order[name] for name in lanelet.linked("predecessor") if name in in_order]
        if any(_meet(lanelet, other) for other in after) or any(
            _meet(other, lanelet) for other in before
        ):
            confirmed.add(lanelet.lane_id)
    return by_outline - confirmed


def _meet(lanelet: Lanelet, following: Lanelet) -> bool:
    """Return whether both bounds of a lanelet end where those of the following one begin."""
    left = lanelet.left[-1] - following.left[0]
    right = lanelet.right[-1] - following.right[0]
    return max(float(np.linalg.norm(gap[:2])) for gap in (left, right)) <= MEET_M


def _with_bounds_in_order(lanelet: Lanelet, exchanged: Collection[str]) -> Lanelet:
    """Return a lanelet whose left bound is on the left; ``exchanged`` holds the ids of the others."""
    if lanelet.lane_id in exchanged:
        return replace(lanelet, left=lanelet.right, right=lanelet.left)
    return lanelet


def _ring(lanelet: Lanelet) -> F64:
    """Return the closed outline ``(N, 3)`` of a lanelet."""
    return np.concatenate([lanelet.left, lanelet.right[::-1], lanelet.left[:1]])


def _lane(lanelet: Lanelet, signs: dict[str, float]) -> Lane:
    """Return a lanelet as a lane; ``signs`` holds speed limits, m/s, by the id of their sign."""
    element = lanelet.element
    neighbours = {
        neighbour.tag: str(neighbour.get("ref"))
        for neighbour in element
        if neighbour.get("drivingDir") == "same"
    }
    return Lane(
        lane_id=lanelet.lane_id,
        centre=centre_line(lanelet.left, lanelet.right),
        left=lanelet.left,
        right=lanelet.right,
        kind=str(lanelet.kind),
        successors=tuple(lanelet.linked("successor")),
        left_neighbour=neighbours.get("adjacentLeft"),
        right_neighbour=neighbours.get("adjacentRight"),
        left_mark_type=_mark_type(element, "leftBound"),
        right_mark_type=_mark_type(element, "rightBound"),
        is_intersection="intersection" in lanelet.types,
        speed_limit_mps=_speed_limit(element, signs),
    )


def _mark_type(element: Element, bound: str) -> LaneMarkType:
    return MARK_TYPES.get(str(element.findtext(f"{bound}/lineMarking")), "unknown")


def _has_stop_line(lanelet: Lanelet) -> bool:
    return lanelet.element.find("stopLine") is not None


def _waiting_line(lanelet: Lanelet, origin: F64) -> F64:
    """Return the line ``(2, 3)``, metres, local, that vehicles on a lanelet wait at.

    It is the stop line; the end of the lanelet where there is no stop line, or one that is not
    given by two points.
    """
    end = np.stack([lanelet.left[-1], lanelet.right[-1]])
    if not _has_stop_line(lanelet):
        return end
    points = _line(lanelet.element, "stopLine", 0)
    return points - origin if len(points) == 2 else end


def _signals(
    lanelet: Lanelet, centre: F64, waiting_line: F64, lights: dict[str, Cycle]
) -> list[Signal]:
    """Return the traffic lights that a lanelet refers to, each once; one without a cycle is left
    out.

    Args:
        lanelet: The lanelet that a light holds back.
        centre: Its centre line ``(N, 3)``, whose end gives the heading of the traffic.
        waiting_line: ``(2, 3)``, where vehicles wait.
        lights: Cycles by the id of their light.
    """
    heading = float(heading_of(centre[-1] - centre[-2]))
    references = [
        *lanelet.element.findall("trafficLightRef"),
        *lanelet.element.findall("stopLine/trafficLightRef"),
    ]
    light_ids = dict.fromkeys(str(reference.get("ref")) for reference in references)
    return [
        Signal(waiting_line, heading, *lights[light_id])
        for light_id in light_ids
        if light_id in lights
    ]


def _lanelet_notes(root: Element, lanelets: Sequence[Lanelet], n_exchanged: int) -> list[str]:
    """Return notes on what was left out, assumed or put right."""
    roads = [lanelet for lanelet in lanelets if lanelet.kind is not None]
    names = Counter(name for lanelet in lanelets for name in lanelet.types)
    road_names = Counter(name for lanelet in roads for name in lanelet.types)
    notes = [
        f"{names[name]} lanelets of type {name} carry no vehicles and are no lanes"
        for name in sorted(names.keys() & NOT_FOR_CARS)
    ]
    notes += [
        f"{road_names[name]} lanelets of type {name} are taken as lanes for vehicles"
        for name in sorted(road_names.keys() - TYPES)
    ]
    if n_exchanged:
        notes.append(
            f"{n_exchanged} lanelets had left and right bound exchanged and were put right"
        )
    if root.find("lanelet/*/lineMarking") is None:
        notes.append("the file has no line markings: those of all lane edges are unknown")
    notes.append(
        "road edges are the border of the union of the lanelets, seams up to 0.1 m closed; where the map ends, its border is an edge too"
    )
    return notes


def _user_notes(lanelets: Sequence[Lanelet]) -> list[str]:
    """Return notes on lanelets that name their users."""
    closed = sum(
        bool(lanelet.users) and not lanelet.users & CARS and not NOT_FOR_CARS & {*lanelet.types}
        for lanelet in lanelets
    )
    both_ways = sum(
        any(user.text in CARS for user in lanelet.element.findall("userBidirectional"))
        for lanelet in lanelets
    )
    notes = []
    if closed:
        notes.append(f"{closed} lanelets name users without cars: no lanes for cars")
    if both_ways:
        notes.append(
            f"{both_ways} lanelets are for cars in both directions: driven in that of their bounds alone"
        )
    return notes


def point(element: Element) -> tuple[float, float, float]:
    """Read ``x``, ``y`` and, where given, ``z`` of a point element in metres."""
    return number(element, "x"), number(element, "y"), number(element, "z", 0.0)


def number(element: Element, place: str, default: float | None = None) -> float:
    """Read a finite number out of an element below another.

    Raises:
        ValueError: The element is missing or holds no finite number.
    """
    text = element.findtext(place)
    if text is None and default is not None:
        return default
    value = float(text or "nan")
    if not np.isfinite(value):
        raise ValueError(f"{place} = {text!r}, which is no finite number")
    return value


def _line(element: Element, name: str, least: int) -> F64:
    points = [point(vertex) for vertex in element.findall(f"{name}/point")]
    if len(points) < least:
        raise ValueError(f"{name} with {len(points)} points, at least {least} are needed")
    return np.array(points, dtype=np.float64)


def _traffic_lights(path: Path, root: Element) -> tuple[dict[str, Cycle], list[str]]:
    """Return the cycle of each traffic light that is on and holds back all directions, by id
    (2020a), with a note on the others.

    A cycle begins at its time offset with its first element (Maierhofer and others, CommonRoad
    documentation of XML 2020a).

    Raises:
        InputError: A colour that the format does not have, or a duration that is no number of time
            steps.
    """
    step_us = float(str(root.get("timeStepSize"))) * 1e6  # the reader has checked it
    cycles: dict[str, Cycle] = {}
    lights = root.findall("trafficLight")
    for light in lights:
        key = str(light.get("id"))
        parts = light.findall("cycle/cycleElement")
        partly = light.findtext("direction") not in (None, "all")
        if not parts or light.findtext("active") == "false" or partly:
            continue
        do_this = f"use {', '.join(COLOURS)} and durations above 0, in time steps"
        with parsing(f"{path}, trafficLight {key}", do_this):
            phases = []
            for part in parts:
                lasts_us = round(number(part, "duration") * step_us)
                if lasts_us <= 0:
                    raise ValueError(f"a duration of {lasts_us} us")
                phases.append((COLOURS[str(part.findtext("color"))], lasts_us))
            cycles[key] = tuple(phases), round(number(light, "cycle/timeOffset", 0.0) * step_us)
    left_out = len(lights) - len(cycles)
    return cycles, [
        f"{left_out} traffic lights are off, without a cycle or for some directions only, and are not used"
    ] if left_out else []


def _speed_signs(root: Element) -> dict[str, float]:
    """Return the speed of each maximum-speed sign in m/s by sign id (2020a)."""
    speeds: dict[str, float] = {}
    for sign in root.findall("trafficSign"):
        for part in sign.findall("trafficSignElement"):
            speed = _speed_of(part)
            if speed is not None:
                speeds[str(sign.get("id"))] = speed
    return speeds


def _speed_of(part: Element) -> float | None:
    """Return the speed in m/s that a part of a sign states; None where it states none."""
    if part.findtext("trafficSignID") not in MAX_SPEED_SIGNS:
        return None
    stated = re.fullmatch(
        r"([0-9.]+)\s*([a-z/]*)", (part.findtext("additionalValue") or "").strip()
    )
    if stated is None or stated[2] not in SPEED_UNITS_MPS:
        return None
    return float(stated[1]) * SPEED_UNITS_MPS[stated[2]]


def _sign_notes(root: Element) -> list[str]:
    """Return a note that names the signs which are not read, with how many there are."""
    unread = Counter(
        " ".join([str(part.findtext("trafficSignID")), *_values(part)])
        for part in root.findall("trafficSign/trafficSignElement")
        if _speed_of(part) is None
    )
    if not unread:
        return []
    listed = some_of([f"{name} ({count})" for name, count in sorted(unread.items())])
    return [f"traffic signs that are not read: {listed}"]


def _values(part: Element) -> list[str]:
    values = [(value.text or "").strip() for value in part.findall("additionalValue")]
    return [repr(value) for value in values if value]


def _speed_limit(element: Element, signs: dict[str, float]) -> float | None:
    if (element.findtext("speedLimit") or "").strip():
        return number(element, "speedLimit")
    refs = [str(ref.get("ref")) for ref in element.findall("trafficSignRef")]
    return min((signs[ref] for ref in refs if ref in signs), default=None)


def mark_intersections(lanes: dict[str, Lane]) -> dict[str, Lane]:
    """Mark lanelets that overlap others they are neither linked to nor beside: those cross or fork
    inside an intersection.
    """
    ids = list(lanes)
    polygons = [lane_polygon(lanes[i]) for i in ids]
    tree = shapely.STRtree(polygons)
    before = predecessors(lanes)
    marked: dict[str, Lane] = {}
    for n, (key, lane) in enumerate(lanes.items()):
        friends = {key, *lane.successors, *before[key], lane.left_neighbour, lane.right_neighbour}
        others = [
            polygons[number]
            for number in np.sort(tree.query(polygons[n]))
            if ids[number] not in friends
        ]
        crossing = lane.is_intersection or _is_covered(polygons[n], others)
        marked[key] = replace(lane, is_intersection=crossing)
    return marked


def _is_covered(polygon: Any, others: Sequence[Any]) -> bool:
    """Return whether other areas cover more than `CROSSING_SHARE` of an area.

    Each adds to what is covered until that is enough: many lanelets of one place are not all united.
    """
    least_m2 = CROSSING_SHARE * polygon.area
    covered = shapely.Polygon()
    for other in others:
        shared = shapely.intersection(polygon, other)
        if shared.area > 0:
            covered = shapely.union(covered, shared)
            if covered.area > least_m2:
                return True
    return False
