"""Lay out a scene seen from above: lanes, the logged drive, what each rollout drove, and where it
went wrong.

Only geometry is made here, as SVG path data in small integers (one unit is about a quarter of a
screen pixel); colours, strokes and hover texts belong to the template. The map is turned so that
the logged drive runs from left to right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.geometry import rectangle_corners
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


class Drawing:
    """The turn, shift and scale from world metres to drawing units, and what of it is seen.

    Args:
        log: ``(N, 2)`` the logged drive, metres, world.
        paths: Other lines that the drawing shows, as far as they stay near the log.
    """

    def __init__(self, log: F64, paths: Sequence[F64]) -> None:
        self.log_at = log[0]
        angle = chord_angle(log)
        c, s = math.cos(angle), math.sin(angle)
        self.turn = np.array([[c, s], [-s, c]])  # world to drawing, still metres and y up
        self.north_deg = round(math.degrees(angle), 1)
        on_log = self._turned(log)
        low, high = on_log.min(0) - STRAY_M, on_log.max(0) + STRAY_M
        all_xy = np.concatenate([on_log, *(np.clip(self._turned(p), low, high) for p in paths)])
        low, high = all_xy.min(0) - MARGIN_M, all_xy.max(0) + MARGIN_M
        lacking = max(MIN_ASPECT * (high[0] - low[0]) - (high[1] - low[1]), 0.0)
        self.corner = np.array([low[0], high[1] + lacking / 2])  # upper left
        self.scale = UNITS_ACROSS / float(high[0] - low[0])
        self.height = math.ceil(float(high[1] - low[1] + lacking) * self.scale)

    def _turned(self, xy: F64) -> F64:
        turned: F64 = (xy - self.log_at) @ self.turn.T
        return turned

    def units(self, xy: F64) -> F64:
        """Map ``(N, 2)`` world metres to drawing units, y down."""
        return (self._turned(xy) - self.corner) * (self.scale, -self.scale)

    def path(self, xy: F64, closed: bool = False, tolerance: float = 1.5) -> str:
        """Return the SVG path data of a line ``(N, 2)`` in world metres; empty where its bounds do
        not touch the drawing.
        """
        units = self.units(xy)
        (x0, y0), (x1, y1) = units.min(0), units.max(0)
        is_seen = x1 >= 0 and y1 >= 0 and x0 <= UNITS_ACROSS and y0 <= self.height
        return path_data(units, closed, tolerance) if is_seen else ""

    def box(self, centre: F64, yaw_rad: float, size_m: tuple[float, float]) -> str:
        """Return the outline of a box of some length and width."""
        corners = rectangle_corners(centre[None], np.array([yaw_rad]), np.array([size_m]))
        return self.path(corners[0], True, 0.0)


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
    times_us: list[int] = []
    for rollout in rollouts:
        own = series.get(rollout.cell, {})
        if "ego_x_m" in own and "ego_y_m" in own:
            (t_us, x), (_, y) = own["ego_x_m"], own["ego_y_m"]
            driven.append((rollout, np.column_stack([x, y])))
            times_us += [int(t_us[0]), int(t_us[-1])]
    drawing = Drawing(log, [path for _, path in driven])
    names_policy = len({rollout.policy for rollout in rollouts}) > 1

    def label(rollout: Rollout) -> str:
        names = [rollout.renderer, rollout.policy] if names_policy else [rollout.renderer]
        return " \u00b7 ".join([*names, f"seed {rollout.seed}"])

    tracks = [
        Track(
            *variant_of[rollout.renderer, rollout.policy],
            label(rollout),
            path_data(drawing.units(path)),
        )
        for rollout, path in driven
    ]
    first_us, last_us = min(times_us, default=0), max(times_us, default=0)
    zero_us = clock_zero_us(content, first_us)
    events = [event for rollout in rollouts for event in events_of(rollout, series)]
    marks = []
    for event in events:
        colour, _ = variant_of[event.rollout.renderer, event.rollout.policy]
        marks.append(_mark(event, drawing, content, colour, label(event.rollout), zero_us))
    # road users are drawn at the scene's first event, else half way through
    at_us, moment = (first_us + last_us) // 2, "half way"
    known = [(event.t_us, event.what) for event in events if event.t_us is not None]
    if known:
        at_us, what = min(known)
        moment = f"when the first {what} happens"
    bar_m = next((b for b in BARS_M if b * drawing.scale > 0.08 * UNITS_ACROSS), BARS_M[-1])
    shapes = drawn_map(content)
    # rings all turn the same way, so that overlapping ones add up instead of cutting holes
    lanes, crosswalks = (
        "".join(
            drawing.path(xy if shapely.is_ccw(shapely.linearrings(xy)) else xy[::-1], True)
            for xy in shapes[kind]
        )
        for kind in ("lanes", "crosswalks")
    )
    lines, edges = (  # a line that two lanes share is drawn once
        "".join(dict.fromkeys(map(drawing.path, shapes[kind]))) for kind in ("paint", "edges")
    )
    return SceneView(
        scene=scene,
        source=str(content.get("source") or ""),
        width=UNITS_ACROSS,
        height=drawing.height,
        lanes=lanes,
        lines=lines,
        edges=edges,
        crosswalks=crosswalks,
        log=drawing.path(log),
        tracks=tuple(tracks),
        marks=tuple(marks),
        bar_units=round(bar_m * drawing.scale),
        bar_label=f"{bar_m}\u00a0m",
        north_deg=drawing.north_deg,
        road_users=road_users(content, at_us, log, drawing),
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


def _mark(
    event: Event, drawing: Drawing, content: JsonView, colour: int, label: str, zero_us: int
) -> Mark:
    """Return the mark of an event; at the middle of the ego's box where its heading is logged."""
    text, folder = f"{label}: {event.what}", event.rollout.path
    if event.t_us is None:
        return Mark(colour, event.kind, f"{text} at a time that no step shows", folder)
    text += f" at {fixed((event.t_us - zero_us) * 1e-6, 1)}\u00a0s"
    if event.x_m is None or event.y_m is None or event.yaw_rad is None:
        return Mark(colour, event.kind, text, folder)
    vehicle = content["vehicle"]
    ahead = np.array([math.cos(event.yaw_rad), math.sin(event.yaw_rad)])
    centre = np.array([event.x_m, event.y_m]) + vehicle["rear_axle_to_centre_m"] * ahead
    footprint = drawing.box(centre, event.yaw_rad, (vehicle["length_m"], vehicle["width_m"]))
    text += f", x {fixed(centre[0], 1)}, y {fixed(centre[1], 1)}\u00a0m"
    x, y = np.rint(drawing.units(centre[None])[0]).astype(int).tolist()
    return Mark(colour, event.kind, text, folder, x, y, footprint)


def road_users(content: JsonView, at_us: int, log: F64, drawing: Drawing) -> list[dict[str, str]]:
    """Lay out the road users of a scene, the nearest to the logged drive first.

    Args:
        content: ``scenes/SCENE.json``.
        at_us: Time of the image; a road user that is not there then is drawn at its nearest time.
        log: ``(N, 2)`` the logged drive, metres, world.
        drawing: Where they are drawn.

    Returns:
        Of each that is seen: ``text`` for the hover, ``body`` (its box at that time) and ``way``
        (its path during the scene; empty if it stands) as SVG path data.
    """
    near: list[tuple[float, dict[str, str]]] = []
    for actor in content.get("actors") or []:
        if not actor["x_m"]:
            continue  # it is never there while the scene runs
        xy = np.column_stack([actor["x_m"], actor["y_m"]]).astype(float)
        step = int(np.argmin(np.abs(np.asarray(actor["t_us"]) - at_us)))
        how, way = "stands", ""
        if float(np.ptp(xy, axis=0).max()) > LEAST_PATH_M:
            how = "reacts once the policy drives" if actor["reacts"] else "as recorded or scripted"
            way = drawing.path(xy)
        size_m = actor["length_m"], actor["width_m"]
        body = drawing.box(xy[step], float(actor["yaw_rad"][step]), size_m)
        text = f"{actor['label'] or 'road user'} {actor['id']}, {how}"
        distance_m = float(np.linalg.norm(xy[:, None] - log[None, ::10], axis=2).min())
        near.append((distance_m, {"text": text, "body": body, "way": way}))
    near.sort(key=lambda pair: pair[0])
    return [user for _, user in near[:MAX_ACTORS] if user["body"] or user["way"]]
