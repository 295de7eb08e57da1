"""Lay out a scene seen from above: lanes, the logged drive, what each rollout drove, and where it
went wrong.

Only geometry is made here, as SVG path data in small integers (one unit is about a quarter of a
screen pixel); colours, strokes and hover texts belong to the template. The map is turned so that
the logged drive runs from left to right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.core.types import F64
from alpasim_plugin.log.run_folder.rows import Rollout, Series
from evaluators.numbers import fixed
from evaluators.report.rollouts import Event, clock_zero_us, events_of

# (renderer, policy) -> (colour index, dash index)
Variants = Mapping[tuple[str, str], tuple[int, int]]
UNITS_ACROSS = 4000  # width of the drawing in integer units
MARGIN_M = 10.0
STRAY_M = 40.0  # how far from the log's bounds the view follows a rollout
MIN_ASPECT = 0.12  # height / width
BARS_M = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
LEAST_PATH_M = 1.0
MAX_ACTORS = 60  # the nearest ones to the logged drive


@dataclass(frozen=True)
class Track:
    """One rollout's path: SVG path data and what to say on hover."""

    variant: int
    dash: int
    label: str
    d: str


@dataclass(frozen=True)
class Mark:
    """One event on the map, in drawing units; without a place where no step shows it."""

    variant: int
    kind: str
    text: str
    folder: str  # of the rollout
    x: int | None = None
    y: int | None = None
    footprint: str = ""


@dataclass(frozen=True)
class SceneView:
    """Everything that the template draws for one scene."""

    scene: str
    source: str
    width: int
    height: int
    unit_per_m: float
    lanes: str
    lines: str
    edges: str
    crosswalks: str
    log: str
    tracks: tuple[Track, ...]
    marks: tuple[Mark, ...]
    bar_units: int
    bar_label: str
    north_deg: float
    road_users: list[dict[str, str]]
    road_users_at: str  # when the road users are drawn

    @property
    def is_wide(self) -> bool:
        """Return whether the drawing should take the full width of the page."""
        return self.height < 0.45 * self.width


def chord_angle(log: F64) -> float:
    """Return the direction in radians from the first to the last of ``(N, 2)`` points; 0 where they
    are hardly apart.
    """
    chord = log[-1] - log[0]
    return math.atan2(chord[1], chord[0]) if float(np.hypot(*chord)) > 1.0 else 0.0


class _Frame:
    """The turn, shift and scale from world metres to drawing units."""

    def __init__(self, log: F64, paths: Sequence[F64]) -> None:
        self.log_at = log[0]
        angle = chord_angle(log)
        c, s = math.cos(angle), math.sin(angle)
        self.turn = np.array([[c, s], [-s, c]])  # world to drawing, still metres and y up
        self.north_deg = math.degrees(angle)
        on_log = self._turned(log)
        low, high = on_log.min(0) - STRAY_M, on_log.max(0) + STRAY_M
        all_xy = np.concatenate([on_log, *(np.clip(self._turned(p), low, high) for p in paths)])
        low, high = all_xy.min(0) - MARGIN_M, all_xy.max(0) + MARGIN_M
        lacking = MIN_ASPECT * (high[0] - low[0]) - (high[1] - low[1])
        if lacking > 0:
            low[1], high[1] = low[1] - lacking / 2, high[1] + lacking / 2
        self.low, self.high = low, high
        self.scale = UNITS_ACROSS / float(high[0] - low[0])
        self.height = math.ceil(float(high[1] - low[1]) * self.scale)

    def _turned(self, xy: F64) -> F64:
        turned: F64 = (xy - self.log_at) @ self.turn.T
        return turned

    def units(self, xy: F64) -> F64:
        """Map ``(N, 2)`` world metres to drawing units, y down."""
        metres = self._turned(xy)
        return np.stack(
            [(metres[:, 0] - self.low[0]) * self.scale, (self.high[1] - metres[:, 1]) * self.scale],
            1,
        )

    def sees(self, units: F64) -> bool:
        """Return whether the bounds of a line touch the drawing."""
        (x0, y0), (x1, y1) = units.min(0), units.max(0)
        return bool(x1 >= 0 and y1 >= 0 and x0 <= UNITS_ACROSS and y0 <= self.height)


def path_data(units: F64, closed: bool = False, tolerance: float = 1.5) -> str:
    """Write a polyline as compact relative SVG path data, dropping points nearer than ``tolerance``
    units to the line.

    Args:
        units: ``(N, 2)`` drawing units.
    """
    if len(units) < 2:
        return ""
    whole = np.rint(units)
    whole = whole[np.concatenate([[True], np.any(np.diff(whole, axis=0) != 0, axis=1)])]
    if len(whole) < 2:
        return ""
    kept = shapely.get_coordinates(
        shapely.simplify(shapely.linestrings(whole), tolerance, preserve_topology=False)
    ).astype(int)
    steps = np.diff(kept, axis=0)
    body = " ".join(f"{dx} {dy}" for dx, dy in steps)
    return f"M{kept[0, 0]} {kept[0, 1]}l{body}" + ("z" if closed else "")


def scene_view(
    scene: str,
    content: JsonView,
    rollouts: Sequence[Rollout],
    series: Series,
    variant_of: Variants,
) -> SceneView | None:
    """Lay out one scene.

    Args:
        content: ``scenes/SCENE.json``.
        rollouts: The scene's rollouts.
        series: Pose and event series, by cell.
        variant_of: (renderer, policy) -> (colour index, dash index).

    Returns:
        The drawing; None where the scene has no logged drive of at least two points.
    """
    log = np.column_stack([content["ego_log"]["x_m"], content["ego_log"]["y_m"]]).astype(float)
    if len(log) < 2:
        return None
    driven: list[tuple[Rollout, F64]] = []
    for rollout in rollouts:
        own = series.get(rollout.cell, {})
        if "ego_x_m" in own and "ego_y_m" in own:
            (t_us, x), (ty_us, y) = own["ego_x_m"], own["ego_y_m"]
            if len(x) > 1 and np.array_equal(t_us, ty_us):
                driven.append((rollout, np.column_stack([x, y])))
    frame = _Frame(log, [path for _, path in driven])
    several = len({rollout.policy for rollout in rollouts}) > 1

    def label(rollout: Rollout) -> str:
        names = [rollout.renderer, rollout.policy] if several else [rollout.renderer]
        return " \u00b7 ".join([*names, f"seed {rollout.seed}"])

    tracks = []
    for rollout, path in driven:
        variant = variant_of.get((rollout.renderer, rollout.policy))
        if variant is not None:
            tracks.append(Track(*variant, label(rollout), path_data(frame.units(path))))
    times_us = [
        series[rollout.cell]["ego_x_m"][0]
        for rollout in rollouts
        if "ego_x_m" in series.get(rollout.cell, {})
    ]
    first_us = min((int(t_us[0]) for t_us in times_us), default=0)
    zero_us = clock_zero_us(content, first_us)
    events = [event for rollout in rollouts for event in events_of(rollout, series)]
    known = [event for event in events if event.t_us is not None]
    # road users are drawn at the scene's first event, else half way through
    if known and times_us:
        first = min(known, key=lambda event: event.t_us or 0)
        at_us, moment = int(first.t_us or 0), f"when the first {first.what} happens"
    else:
        last_us = max((int(t_us[-1]) for t_us in times_us), default=0)
        at_us, moment = (first_us + last_us) // 2, "half way"
    bar_m = next((b for b in BARS_M if b * frame.scale > 0.08 * UNITS_ACROSS), BARS_M[-1])
    shapes = drawn_map(content)
    vehicle = content.get("vehicle") or {}

    def draw(xy: F64, closed: bool) -> str:
        units = frame.units(xy)
        tolerance = 0.0 if closed else 1.5
        return path_data(units, closed, tolerance) if frame.sees(units) else ""

    return SceneView(
        scene=scene,
        source=str(content.get("source") or ""),
        width=UNITS_ACROSS,
        height=frame.height,
        unit_per_m=frame.scale,
        lanes=_areas(shapes["lanes"], frame),
        lines=_lines(shapes["paint"], frame),
        edges=_lines(shapes["edges"], frame),
        crosswalks=_areas(shapes["crosswalks"], frame),
        log=path_data(frame.units(log)),
        tracks=tuple(tracks),
        marks=tuple(
            _mark(event, frame, vehicle, variant_of, label(event.rollout), zero_us)
            for event in events
        ),
        bar_units=round(bar_m * frame.scale),
        bar_label=f"{bar_m}\u00a0m",
        north_deg=round(frame.north_deg, 1),
        road_users=road_users(content, at_us, log, draw),
        road_users_at=f"at {fixed((at_us - zero_us) * 1e-6, 1)}\u00a0s, {moment}",
    )


def drawn_map(content: JsonView) -> dict[str, list[F64]]:
    """Return what every view from above draws of a map: ``lanes``, ``paint`` (edges of lanes that
    carry markings), ``edges`` and ``crosswalks``.

    Args:
        content: ``scenes/SCENE.json``.

    Returns:
        Lines, and rings of areas without their first point again, each ``(N, 2)`` metres, world.
    """
    rings, painted = [], []
    for lane in content.get("lanes") or []:
        left, right = lane.get("left"), lane.get("right")
        if left and right:
            rings.append([*left, *reversed(right)])
        paint = lane.get("paint") or ("unknown", "unknown")
        painted += [edge for edge, kind in zip((left, right), paint, strict=True) if kind != "none"]

    def arrays(lines: Sequence[Any], least: int) -> list[F64]:
        """Return the lines of at least so many points."""
        return [
            np.asarray(line, dtype=np.float64)[:, :2]
            for line in lines
            if line is not None and len(line) >= least
        ]

    return {
        "lanes": arrays(rings, 3),
        "paint": arrays(painted, 2),
        "edges": arrays(content.get("road_edges") or [], 2),
        "crosswalks": arrays(content.get("crosswalks") or [], 3),
    }


def _lines(lines: Sequence[F64], frame: _Frame) -> str:
    seen = [units for units in map(frame.units, lines) if frame.sees(units)]
    return "".join(dict.fromkeys(map(path_data, seen)))  # shared by two lanes: drawn once


def _areas(rings: Sequence[F64], frame: _Frame) -> str:
    """Write rings into one path, all turning the same way, so that overlapping rings add up instead
    of cutting holes.
    """
    seen = [units for units in map(frame.units, rings) if frame.sees(units)]
    turned = [ring if shapely.is_ccw(shapely.linearrings(ring)) else ring[::-1] for ring in seen]
    return "".join(path_data(ring, closed=True) for ring in turned)


def _mark(
    event: Event,
    frame: _Frame,
    vehicle: JsonView,
    variant_of: Variants,
    label: str,
    zero_us: int,
) -> Mark:
    variant = variant_of.get((event.rollout.renderer, event.rollout.policy), (0, 0))[0]
    text, folder = f"{label}: {event.what}", event.rollout.path
    if event.t_us is None:
        return Mark(variant, event.kind, f"{text} at a time that no step shows", folder)
    text += f" at {fixed((event.t_us - zero_us) * 1e-6, 1)}\u00a0s"
    if event.x_m is None or event.y_m is None:
        return Mark(variant, event.kind, text, folder)
    centre = np.array([event.x_m, event.y_m])
    footprint = ""
    if event.yaw_rad is not None:
        ahead = np.array([math.cos(event.yaw_rad), math.sin(event.yaw_rad)])
        centre = centre + float(vehicle.get("rear_axle_to_centre_m") or 0.0) * ahead
        if vehicle.get("length_m"):
            box = corners(centre, event.yaw_rad, vehicle["length_m"], vehicle["width_m"])
            footprint = path_data(frame.units(box), closed=True, tolerance=0.0)
    text += f", x {fixed(centre[0], 1)}, y {fixed(centre[1], 1)}\u00a0m"
    x, y = np.rint(frame.units(centre[None])[0]).astype(int).tolist()
    return Mark(variant, event.kind, text, folder, x, y, footprint)


def road_users(
    content: JsonView, at_us: int, log: F64, draw: Callable[[F64, bool], str]
) -> list[dict[str, str]]:
    """Lay out the road users of a scene; empty for scene files of earlier versions, which have no
    tracks.

    Args:
        content: ``scenes/SCENE.json``.
        at_us: Time of the image; a road user that is not there then is drawn at its nearest time.
        log: ``(N, 2)`` the logged drive, metres, world.
        draw: From ``(N, 2)`` world metres and whether the line is closed to SVG path data; empty
            where nothing of it is in the image.

    Returns:
        Of each: ``text`` for the hover, ``body`` (its box at that time) and ``way`` (its path during
        the scene; empty if it stands) as SVG path data.
    """
    near: list[tuple[float, dict[str, str]]] = []
    for actor in content.get("actors") or []:
        if not (actor.get("x_m") and actor.get("length_m")):
            continue
        xy = np.column_stack([actor["x_m"], actor["y_m"]]).astype(float)
        step = int(np.argmin(np.abs(np.asarray(actor["t_us"]) - at_us)))
        yaw_rad = float(actor["yaw_rad"][step])
        how, way = "stands", ""
        if float(np.ptp(xy, axis=0).max()) > LEAST_PATH_M:
            how = "as recorded or scripted"
            if actor.get("reacts"):
                how = "reacts once the policy drives"
            way = draw(xy, False)
        body = draw(corners(xy[step], yaw_rad, actor["length_m"], actor["width_m"]), True)
        name = f"{actor.get('label') or 'road user'} {actor.get('id') or ''}".strip()
        distance_m = float(np.linalg.norm(xy[:, None] - log[None, ::10], axis=2).min())
        near.append((distance_m, {"text": f"{name}, {how}", "body": body, "way": way}))
    near.sort(key=lambda pair: pair[0])
    return [user for _, user in near[:MAX_ACTORS] if user["body"] or user["way"]]


def corners(centre: F64 | Sequence[float], yaw_rad: float, length_m: float, width_m: float) -> F64:
    """Return the corners ``(4, 2)`` of a box seen from above."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    half, wide = length_m / 2, width_m / 2
    local = np.array([[-half, -wide], [half, -wide], [half, wide], [-half, wide]])
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + centre)
