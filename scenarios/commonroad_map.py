"""Lanelets of a CommonRoad file (versions 2018b and 2020a) as a lane map."""

import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.geometry import centre_line, heading_of
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import F64, Lane, LaneMap, LaneMarkType, Signal
from scenarios.map_lines import border_lines, is_left_of, lane_edges, merge_areas, predecessors
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


def read_lanelets(path: Path, root: Element, origin: F64) -> tuple[LaneMap, tuple[str, ...]]:
    """Read all lanelets around ``origin (3,)``, with notes.

    Raises:
        InputError: There is no lanelet for vehicles, or one lacks a bound.
    """
    elements = root.findall("lanelet")
    signs = _speed_signs(root)
    lights, notes = _traffic_lights(path, root)
    signals = []
    lanes: dict[str, Lane] = {}
    crosswalks = []
    stop_lines = []
    left_out: Counter[str] = Counter()
    strange: Counter[str] = Counter()
    swapped = 0
    for element in elements:
        lane_id = str(element.get("id"))
        where = f"{path}, lanelet {lane_id}"
        with parsing(where, "correct the lanelet"):
            left, right = (
                near(where, _line(element, side, 2) - origin)
                for side in ("leftBound", "rightBound")
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
            waits = np.stack([left[-1], right[-1]])
            if element.find("stopLine") is not None:
                points = _line(element, "stopLine", 0)
                waits = points - origin if len(points) == 2 else waits
                stop_lines.append(waits)
            centre = centre_line(left, right)
            ahead = centre[-1] - centre[-2]
            heading = float(heading_of(ahead))
            refs = [
                str(ref.get("ref"))
                for place in ("trafficLightRef", "stopLine/trafficLightRef")
                for ref in element.findall(place)
            ]
            signals += [
                Signal(waits, heading, *lights[ref]) for ref in dict.fromkeys(refs) if ref in lights
            ]
            neighbours = {
                beside.tag: str(beside.get("ref"))
                for beside in element
                if beside.get("drivingDir") == "same"
            }
            lanes[lane_id] = Lane(
                lane_id=lane_id,
                centre=centre,
                left=left,
                right=right,
                kind=next((KINDS[t] for t in types if t in KINDS), "vehicle"),
                successors=tuple(str(s.get("ref")) for s in element.findall("successor")),
                left_neighbour=neighbours.get("adjacentLeft"),
                right_neighbour=neighbours.get("adjacentRight"),
                left_mark_type=MARK_TYPES.get(
                    str(element.findtext("leftBound/lineMarking")), "unknown"
                ),
                right_mark_type=MARK_TYPES.get(
                    str(element.findtext("rightBound/lineMarking")), "unknown"
                ),
                is_intersection="intersection" in types,
                speed_limit_mps=_speed_limit(element, signs),
            )
    if not lanes:
        raise InputError(
            f"{path}: {len(elements)} lanelets, none for vehicles", "use a scenario with a road"
        )
    notes += [
        f"{n} lanelets of type {t} carry no vehicles and are no lanes"
        for t, n in sorted(left_out.items())
    ]
    notes += [
        f"{n} lanelets of type {t} are taken as lanes for vehicles"
        for t, n in sorted(strange.items())
    ]
    if swapped:
        notes.append(f"{swapped} lanelets had left and right bound exchanged and were put right")
    if root.find("lanelet/*/lineMarking") is None:
        notes.append("the file has no line markings: those of all lane edges are unknown")
    notes.append(
        "road edges are the border of the union of the lanelets, seams up to 0.1 m closed; where the map ends, its border is an edge too"
    )
    surface = merge_areas([lane_polygon(lane) for lane in lanes.values()])
    return LaneMap(
        lanes=mark_intersections(lanes),
        road_edges=border_lines(surface, np.concatenate(lane_edges(lanes))),
        crosswalks=tuple(crosswalks),
        stop_lines=tuple(stop_lines),
        signals=tuple(signals) or None,
    ), tuple(notes)


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
    points = [point(one) for one in element.findall(f"{name}/point")]
    if len(points) < least:
        raise ValueError(f"{name} with {len(points)} points, at least {least} are needed")
    return np.array(points, np.float64)


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
    found: dict[str, Cycle] = {}
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
            found[key] = tuple(phases), round(number(light, "cycle/timeOffset", 0.0) * step_us)
    left_out = len(lights) - len(found)
    return found, [
        f"{left_out} traffic lights are off, without a cycle or for some directions only, and are not used"
    ] if left_out else []


def _speed_signs(root: Element) -> dict[str, float]:
    """Return the speed of each maximum-speed sign in m/s by sign id (2020a)."""
    speeds: dict[str, float] = {}
    for sign in root.findall("trafficSign"):
        for part in sign.findall("trafficSignElement"):
            if part.findtext("trafficSignID") in MAX_SPEED_SIGNS:
                with contextlib.suppress(ValueError):  # "30 mph zone" is no number to rely on
                    speeds[str(sign.get("id"))] = number(part, "additionalValue")
    return speeds


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
        others = [polygons[m] for m in np.sort(tree.query(polygons[n])) if ids[m] not in friends]
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
