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

from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.log.run_folder.rows import Rollout, Series
from evaluators.report.numbers import fixed
from evaluators.report.rollouts import Event, clock_zero_us, events_of

Variants = Mapping[
    tuple[str, str], tuple[int, int]
]  # (renderer, policy) -> (colour index, dash index)
UNITS_ACROSS = 4000  # width of the drawing in integer units
MARGIN_M = 10.0
MAX_OFFSET_M = (
    5.0  # one rollout that is far away must not flatten the others; the map shows where it went
)
STRAY_M = 40.0  # how far from the log's bounds the view follows a rollout
MIN_ASPECT = 0.12  # height / width


@dataclass(frozen=True)
class Track:
    """One rollout's path: SVG path data and what to say on hover."""

    variant: int
    dash: int
    label: str
    d: str


@dataclass(frozen=True)
class Mark:
    """One event on the map, in drawing units."""

    variant: int
    kind: str
    text: str
    x: int | None
    y: int | None
    footprint: str = ""
    folder: str = ""  # of the rollout


@dataclass(frozen=True)
class OffsetChart:
    """Signed distance from the logged path over time; width 1000, height 200, zero in the
    middle.
    """

    tracks: tuple[Track, ...]
    reach: str
    end_s: str


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
    offset: OffsetChart | None
    road_users: tuple[RoadUser, ...] = ()
    road_users_at: str = ""  # when the road users are drawn

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
    content: Mapping[str, Any],
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
    log = np.stack([np.asarray(content["ego_log"][k], float) for k in ("x_m", "y_m")], 1)
    if len(log) < 2:
        return None
    driven: dict[tuple[str, str, str, int], F64] = {}
    for r in rollouts:
        own = series.get(r.cell, {})
        if "ego_x_m" in own and "ego_y_m" in own:
            (tx, x), (ty, y) = own["ego_x_m"], own["ego_y_m"]
            if len(x) > 1 and np.array_equal(tx, ty):
                driven[r.cell] = np.stack([x, y], 1)
    frame = _Frame(log, list(driven.values()))
    names_policy = len({r.policy for r in rollouts}) > 1

    def label(rollout: Rollout) -> str:
        return " \u00b7 ".join(
            [rollout.renderer, *([rollout.policy] if names_policy else []), f"seed {rollout.seed}"]
        )

    tracks = [
        Track(*variant_of[r.renderer, r.policy], label(r), path_data(frame.units(driven[r.cell])))
        for r in rollouts
        if r.cell in driven and (r.renderer, r.policy) in variant_of
    ]
    vehicle = content.get("vehicle") or {}
    logged = [series[r.cell]["ego_x_m"][0] for r in rollouts if "ego_x_m" in series.get(r.cell, {})]
    zero_us = clock_zero_us(content, min((int(t_us[0]) for t_us in logged), default=0))
    bar_m = next(
        b
        for b in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 1e9)
        if b * frame.scale > 0.08 * UNITS_ACROSS
    )
    lanes = content.get("lanes") or []
    events = [event for rollout in rollouts for event in events_of(rollout, series)]
    at_us, at_text = _moment(logged, events, zero_us)

    def draw(xy: F64, closed: bool) -> str:
        units = frame.units(xy)
        return (
            path_data(units, closed, tolerance=0.0 if closed else 1.5) if frame.sees(units) else ""
        )

    return SceneView(
        scene=scene,
        source=str(content.get("source") or ""),
        width=UNITS_ACROSS,
        height=frame.height,
        unit_per_m=frame.scale,
        lanes=_areas([lane_ring(lane) for lane in lanes], frame),
        lines=_lines([edge for lane in lanes for edge in painted_edges(lane)], frame),
        edges=_lines(content.get("road_edges") or [], frame),
        crosswalks=_areas(content.get("crosswalks") or [], frame),
        log=path_data(frame.units(log)),
        tracks=tuple(tracks),
        marks=tuple(
            _mark(event, frame, vehicle, variant_of, label(event.rollout), zero_us)
            for event in events
        ),
        bar_units=round(bar_m * frame.scale),
        bar_label=f"{bar_m:.0f}\u00a0m",
        north_deg=round(frame.north_deg, 1),
        offset=_offset_chart(rollouts, series, variant_of, label),
        road_users=tuple(road_users(content, at_us, log, draw)),
        road_users_at=at_text,
    )


def _moment(logged: Sequence[I64], events: Sequence[Event], zero_us: int) -> tuple[int, str]:
    """Return when road users are drawn: at the scene's first event, else half way through.

    Args:
        logged: Times of each rollout's poses.
        events: Of all rollouts.
        zero_us: The instant that the scene's times count from.
    """
    firsts = [(event.t_us, event.what) for event in events if event.t_us is not None]
    if not logged:
        return 0, ""
    if firsts:
        t_us, what = min(firsts)
        return t_us, f"at {fixed((t_us - zero_us) * 1e-6, 1)}\u00a0s, when the first {what} happens"
    middle_us = (min(int(t[0]) for t in logged) + max(int(t[-1]) for t in logged)) // 2
    return middle_us, f"at {fixed((middle_us - zero_us) * 1e-6, 1)}\u00a0s, half way"


def lane_ring(lane: Mapping[str, Any]) -> list[list[float]]:
    """Return a lane's outline, its left edge first; empty where an edge is not known."""
    left, right = lane.get("left"), lane.get("right")
    return [*left, *reversed(right)] if left and right else []


def painted_edges(lane: Mapping[str, Any]) -> list[list[list[float]] | None]:
    """List a lane's edges without those that carry no paint, such as the paths across an
    intersection.
    """
    sides = zip(
        (lane.get("left"), lane.get("right")),
        lane.get("paint") or ("unknown", "unknown"),
        strict=True,
    )
    return [edge for edge, paint in sides if paint != "none"]


def _lines(lines: Sequence[Sequence[Sequence[float]] | None], frame: _Frame) -> str:
    drawn = []
    for line in lines:
        if line is not None and len(line) > 1:
            units = frame.units(np.asarray(line, float)[:, :2])
            if frame.sees(units):
                drawn.append(path_data(units))
    return "".join(dict.fromkeys(drawn))  # a boundary shared by two lanes is drawn once


def _areas(rings: Sequence[Sequence[Sequence[float]]], frame: _Frame) -> str:
    """Write rings into one path, all turning the same way, so that overlapping rings add up instead
    of cutting holes.
    """
    drawn = []
    for ring in rings:
        if len(ring) < 3:
            continue
        units = frame.units(np.asarray(ring, float)[:, :2])
        if frame.sees(units):
            x, y = units.T
            turns_left = float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) > 0
            drawn.append(path_data(units if turns_left else units[::-1], closed=True))
    return "".join(drawn)


def _mark(
    event: Event,
    frame: _Frame,
    vehicle: Mapping[str, Any],
    variant_of: Variants,
    label: str,
    zero_us: int,
) -> Mark:
    variant = variant_of.get((event.rollout.renderer, event.rollout.policy), (0, 0))[0]
    when = (
        f"at {fixed((event.t_us - zero_us) * 1e-6, 1)}\u00a0s"
        if event.t_us is not None
        else "at a time that no step shows"
    )
    if event.x_m is None or event.y_m is None:
        return Mark(
            variant,
            event.kind,
            f"{label}: {event.what} {when}",
            None,
            None,
            folder=event.rollout.path,
        )
    yaw = event.yaw_rad or 0.0
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    ahead = float(vehicle.get("rear_axle_to_centre_m") or 0.0) if event.yaw_rad is not None else 0.0
    centre = np.array([[ahead, 0.0]]) @ turn + [event.x_m, event.y_m]
    at = frame.units(centre)[0]
    footprint = ""
    if event.yaw_rad is not None and vehicle.get("length_m"):
        box = corners(centre[0], event.yaw_rad, vehicle["length_m"], vehicle["width_m"])
        footprint = path_data(frame.units(box), closed=True, tolerance=0.0)
    where = f"x {fixed(centre[0, 0], 1)}, y {fixed(centre[0, 1], 1)}\u00a0m"
    return Mark(
        variant,
        event.kind,
        f"{label}: {event.what} {when}, {where}",
        round(at[0]),
        round(at[1]),
        footprint,
        event.rollout.path,
    )


def _offset_chart(
    rollouts: Sequence[Rollout], series: Series, variant_of: Variants, label: Any
) -> OffsetChart | None:
    own = {
        r.cell: series[r.cell]["lateral_bias_m"]
        for r in rollouts
        if "lateral_bias_m" in series.get(r.cell, {})
    }
    if not own:
        return None
    reach = max(0.5, *(float(np.abs(v).max()) for _, v in own.values()))
    shown = next((step for step in (0.5, 1.0, 2.0, 3.0) if reach <= step), MAX_OFFSET_M)
    end_us = max(1, *(int(t[-1] - t[0]) for t, _ in own.values()))
    tracks = []
    for rollout in rollouts:
        if rollout.cell in own and (rollout.renderer, rollout.policy) in variant_of:
            t_us, offset = own[rollout.cell]
            units = np.stack(
                [(t_us - t_us[0]) / end_us * 1000.0, 100.0 - offset / shown * 100.0], 1
            )
            tracks.append(
                Track(
                    *variant_of[rollout.renderer, rollout.policy],
                    label(rollout),
                    path_data(units, tolerance=0.7),
                )
            )
    return OffsetChart(
        tuple(tracks),
        f"{shown:g}\u00a0m" + (" and more" if reach > shown else ""),
        f"{end_us * 1e-6:.1f}",
    )


LEAST_PATH_M = 1.0
MAX_ACTORS = 60  # the nearest ones to the logged drive


@dataclass(frozen=True)
class RoadUser:
    """One road user, in drawing units.

    Attributes:
        text: For the hover.
        body: Its box at the picture's time, as SVG path data.
        way: The path that it goes during the scene; empty if it stands.
    """

    text: str
    body: str
    way: str


def road_users(
    content: Mapping[str, Any], at_us: int, log: F64, draw: Callable[[F64, bool], str]
) -> list[RoadUser]:
    """Lay out the road users of a scene; empty for scene files of earlier versions, which have no
    tracks.

    Args:
        content: ``scenes/SCENE.json``.
        at_us: Time of the picture; a road user that is not there then is drawn at its nearest time.
        log: ``(N, 2)`` the logged drive, metres, world.
        draw: From ``(N, 2)`` world metres and whether the line is closed to SVG path data; empty
            where nothing of it is in the picture.
    """
    known = [
        actor for actor in content.get("actors") or [] if actor.get("x_m") and actor.get("length_m")
    ]

    def distance(actor: Mapping[str, Any]) -> float:
        xy = np.column_stack([actor["x_m"], actor["y_m"]])
        return float(np.min(np.hypot(*(xy[:, None] - log[None, ::10]).transpose(2, 0, 1))))

    nearest = sorted(known, key=distance)[:MAX_ACTORS]
    found = (_road_user(actor, at_us, draw) for actor in nearest)
    return [one for one in found if one.body or one.way]


def _road_user(actor: Mapping[str, Any], at_us: int, draw: Callable[[F64, bool], str]) -> RoadUser:
    xy = np.column_stack([actor["x_m"], actor["y_m"]]).astype(float)
    moves = float(np.ptp(xy, axis=0).max()) > LEAST_PATH_M
    k = int(np.argmin(np.abs(np.asarray(actor["t_us"]) - at_us)))
    body = draw(
        corners(xy[k], float(actor["yaw_rad"][k]), actor["length_m"], actor["width_m"]), True
    )
    how = (
        ("reacts once the policy drives" if actor.get("reacts") else "as recorded or scripted")
        if moves
        else "stands"
    )
    return RoadUser(
        f"{actor.get('label') or 'road user'} {actor.get('id') or ''}, {how}".strip(),
        body,
        draw(xy, False) if moves else "",
    )


def corners(centre: F64 | Sequence[float], yaw_rad: float, length_m: float, width_m: float) -> F64:
    """Return the corners ``(4, 2)`` of a box seen from above."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    half, wide = length_m / 2, width_m / 2
    local = np.array([[-half, -wide], [half, -wide], [half, wide], [-half, wide]])
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + centre)
