"""Lanelets of a CommonRoad file (versions 2018b and 2020a) as a lane map."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import centre_line
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import F64, Lane, LaneMap, Paint, Signal
from scenarios.map_lines import border_lines, is_left_of, lane_edges, merge_areas, predecessors
from scenarios.recorded import SourceFiles

# Line markings of version 2020a; the format has no colour, so lines are white.
PAINTS: dict[str, Paint] = {
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
Cycle = tuple[tuple[tuple[str, int], ...], int]  # phases in microseconds, and when the first begins
KINDS = {"shoulder": "shoulder", "busLane": "bus", "bicycleLane": "bike", "parking": "parking"}
NOT_FOR_CARS = ("sidewalk", "crosswalk")
_FOR_CARS = """urban interstate country highway exitRamp accessRamp mainCarriageWay driveWay
    intersection busStop"""
KNOWN = {*KINDS, *NOT_FOR_CARS, *_FOR_CARS.split()}
MAX_SPEED_SIGNS = ("274", "R2-1")  # German and US maximum speed; the additional value is in m/s
CROSSING_SHARE = (
    0.1  # a lanelet covered to this share by lanelets it is not linked to lies in an intersection
)


def read_lanelets(
    files: SourceFiles, path: Path, root: Element, origin: F64
) -> tuple[LaneMap, tuple[str, ...]]:
    """Read all lanelets around ``origin (3,)``, with notes.

    Raises:
        InputError: There is no lanelet, or one lacks a bound.
    """
    elements = root.findall("lanelet")
    if not elements:
        raise InputError(
            f"{path}: a map without lanelets", "use a scenario with at least one lanelet"
        )
    signs = _speed_signs(root)
    lights, light_notes = _traffic_lights(files, path, root)
    signals: list[Signal] = []
    lanes: dict[str, Lane] = {}
    crosswalks: list[F64] = []
    stop_lines: list[F64] = []
    left_out: Counter[str] = Counter()
    strange: Counter[str] = Counter()
    swapped = 0
    for element in elements:
        lane_id = str(element.get("id"))
        where = f"{path}, lanelet {lane_id}"
        left, right = (
            _bound(files, where, element, side, origin) for side in ("leftBound", "rightBound")
        )
        types = [str(t.text) for t in element.findall("laneletType")]
        if any(t in NOT_FOR_CARS for t in types):
            left_out.update(t for t in types if t in NOT_FOR_CARS)
            if "crosswalk" in types:
                crosswalks.append(np.concatenate([left, right[::-1], left[:1]]))
            continue
        strange.update(t for t in types if t not in KNOWN)
        if is_left_of(right, left):  # bounds exchanged
            left, right, swapped = right, left, swapped + 1
        stop_line = _stop_line(files, where, element, left, right, origin)
        stop_lines += stop_line
        waits = stop_line[0] if stop_line else np.stack([left[-1], right[-1]])
        refs = [
            str(ref.get("ref"))
            for ref in (
                *element.findall("trafficLightRef"),
                *element.findall("stopLine/trafficLightRef"),
            )
        ]
        ends = centre_line(left, right)[-2:, :2]
        heading = float(np.arctan2(*(ends[1] - ends[0])[::-1]))
        signals += [
            Signal(waits, heading, *lights[ref]) for ref in dict.fromkeys(refs) if ref in lights
        ]
        beside = {
            side: n
            for side in ("left", "right")
            if (n := element.find(f"adjacent{side.capitalize()}")) is not None
        }
        same = {
            side: str(n.get("ref")) for side, n in beside.items() if n.get("drivingDir") == "same"
        }
        lanes[lane_id] = Lane(
            lane_id=lane_id,
            centre=centre_line(left, right),
            left=left,
            right=right,
            kind=next((KINDS[t] for t in types if t in KINDS), "vehicle"),
            successors=tuple(str(s.get("ref")) for s in element.findall("successor")),
            left_neighbour=same.get("left"),
            right_neighbour=same.get("right"),
            left_paint=_marking(element, "leftBound"),
            right_paint=_marking(element, "rightBound"),
            is_intersection="intersection" in types,
            speed_limit_mps=_speed_limit(files, where, element, signs),
        )
    if not lanes:
        raise InputError(
            f"{path}: {len(elements)} lanelets, none for vehicles", "use a scenario with a road"
        )
    notes = [
        f"{n} lanelets of type {t} carry no vehicles and are no lanes"
        for t, n in sorted(left_out.items())
    ]
    notes += [
        f"{n} lanelets of type {t} are taken as lanes for vehicles"
        for t, n in sorted(strange.items())
    ]
    if swapped:
        notes.append(f"{swapped} lanelets had left and right bound exchanged and were put right")
    notes += light_notes
    lanes = mark_intersections(lanes)
    if (
        root.find("lanelet/leftBound/lineMarking") is None
        and root.find("lanelet/rightBound/lineMarking") is None
    ):
        notes.append("the file has no line markings: the paint of all lane edges is unknown")
    surface = merge_areas([lane_polygon(lane) for lane in lanes.values()])
    edges = border_lines(surface, np.concatenate(lane_edges(lanes)))
    notes.append(
        "road edges are the border of the union of the lanelets, seams up to 0.1 m closed; where the map ends, its border is an edge too"
    )
    known = tuple(signals) if signals else None
    return LaneMap(
        lanes=lanes,
        road_edges=edges,
        crosswalks=tuple(crosswalks),
        stop_lines=tuple(stop_lines),
        signals=known,
    ), tuple(notes)


def point(files: SourceFiles, where: str, element: Element) -> tuple[float, float, float]:
    """Read ``x``, ``y`` and, where given, ``z`` of a point element in metres."""
    x, y = (number(files, where, element.find(axis), axis) for axis in ("x", "y"))
    height = element.find("z")
    return x, y, 0.0 if height is None else number(files, where, height, "z")


def number(files: SourceFiles, where: str, element: Element | None, what: str) -> float:
    """Read a finite number out of an element's text.

    Raises:
        InputError: The element is missing or holds no finite number.
    """
    if element is None:
        raise InputError(f"{where}: no {what}", f"add {what}")
    try:
        value = float(str(element.text))
    except ValueError as error:
        raise InputError(f"{where}: {what} = {element.text!r}", "give a number") from error
    if not np.isfinite(value):
        raise InputError(f"{where}: {what} = {element.text!r}", "give a finite number")
    return value


def _bound(files: SourceFiles, where: str, element: Element, side: str, origin: F64) -> F64:
    bound = element.find(side)
    points = (
        []
        if bound is None
        else [point(files, f"{where}, {side}", p) for p in bound.findall("point")]
    )
    if len(points) < 2:
        raise InputError(
            f"{where}: {side} with {len(points)} points",
            "give each lanelet two bounds of at least 2 points",
        )
    return files.near(f"{where}, {side}", np.array(points, dtype=np.float64) - origin)


def _marking(element: Element, side: str) -> Paint:
    text = element.findtext(f"{side}/lineMarking")
    return PAINTS.get(str(text), "unknown")


def _stop_line(
    files: SourceFiles, where: str, element: Element, left: F64, right: F64, origin: F64
) -> list[F64]:
    line = element.find("stopLine")
    if line is None:
        return []
    points = [point(files, f"{where}, stopLine", p) for p in line.findall("point")]
    return [np.array(points) - origin if len(points) == 2 else np.stack([left[-1], right[-1]])]


def _traffic_lights(
    files: SourceFiles, path: Path, root: Element
) -> tuple[dict[str, Cycle], list[str]]:
    """Return the cycle of each traffic light that is on and holds back all directions, by id
    (2020a), with a note on the others.

    A cycle begins at its time offset with its first element (Maierhofer and others, CommonRoad
    documentation of XML 2020a).

    Raises:
        InputError: A colour that the format does not have, or a duration that is no number of time
            steps.
    """
    step_us = float(str(root.get("timeStepSize"))) * 1e6  # the reader has checked it
    found: dict[str, Cycle] = {}
    lights = root.findall("trafficLight")
    for light in lights:
        where = f"{path}, trafficLight {light.get('id')}"
        cycle = light.find("cycle")
        if (
            cycle is None
            or light.findtext("active") == "false"
            or light.findtext("direction") not in (None, "all")
        ):
            continue
        phases = []
        for part in cycle.findall("cycleElement"):
            colour = COLOURS.get(str(part.findtext("color")))
            steps = number(files, where, part.find("duration"), "duration")
            if colour is None or steps <= 0:
                said = f"color {part.findtext('color')!r}, duration {steps:g}"
                raise InputError(
                    f"{where}: {said}",
                    f"use {', '.join(COLOURS)} and durations above 0, in time steps",
                )
            phases.append((colour, round(steps * step_us)))
        offset = cycle.find("timeOffset")
        if phases:
            found[str(light.get("id"))] = (
                tuple(phases),
                0
                if offset is None
                else round(number(files, where, offset, "timeOffset") * step_us),
            )
    left_out = len(lights) - len(found)
    return found, [
        f"{left_out} traffic lights are off, without a cycle or for some directions only, and are not used"
    ] if left_out else []


def _speed_signs(root: Element) -> dict[str, float]:
    """Return the speed of each maximum-speed sign in m/s by sign id (2020a)."""
    speeds: dict[str, float] = {}
    for sign in root.findall("trafficSign"):
        for part in sign.findall("trafficSignElement"):
            value = part.findtext("additionalValue")
            if part.findtext("trafficSignID") in MAX_SPEED_SIGNS and value is not None:
                try:
                    speeds[str(sign.get("id"))] = float(value)
                except ValueError:
                    continue  # a textual value ("30 mph zone") is no number to rely on
    return speeds


def _speed_limit(
    files: SourceFiles, where: str, element: Element, signs: dict[str, float]
) -> float | None:
    given = element.find("speedLimit")
    if given is not None and (given.text or "").strip():
        return number(files, where, given, "speedLimit")
    limits = [
        signs[ref] for s in element.findall("trafficSignRef") if (ref := str(s.get("ref"))) in signs
    ]
    return min(limits) if limits else None


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
        covered = [
            polygons[m]
            for m in tree.query(polygons[n], predicate="intersects")
            if ids[m] not in friends
        ]
        shared = (
            shapely.area(shapely.intersection(polygons[n], shapely.union_all(covered)))
            if covered
            else 0.0
        )
        crossing = lane.is_intersection or bool(shared > CROSSING_SHARE * polygons[n].area)
        marked[key] = replace(lane, is_intersection=crossing)
    return marked
