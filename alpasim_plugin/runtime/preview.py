"""A scenario in one picture, before anything is driven: the map, where everybody goes, what the camera sees of the recorded drive."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, rectangle_corners, yaw_of
from alpasim_plugin.core.types import F64, U8, Actor, RenderRequest, Scenario
from alpasim_plugin.io.atomic import write_bytes
from alpasim_plugin.renderers.background import background_note
from alpasim_plugin.runtime.cell import make_renderer
from alpasim_plugin.runtime.guards import checked_frames

DOING = "previewing a scenario"
MARGIN_M = 15.0
MAX_HEIGHT, MIN_HEIGHT = 5.0, 1.6  # of the map, inches
WIDTH = 13.0
ROAD, PAINT, EDGE, EGO = "#d7dadd", "#ffffff", "#7d858c", "#0b6bb3"
OTHERS = ("#c2540a", "#00806a", "#9a4f8f", "#8a6a00", "#b3344a", "#3f51b5", "#5b6470")


@dataclass(frozen=True)
class Preview:
    """What was drawn.

    Attributes:
        times_s: Of the camera frames and the drawn bodies, after the first frame.
        actors: Road users that are there at some time.
        text: Facts, one a line.
    """

    times_s: tuple[float, ...]
    actors: int
    text: tuple[str, ...]


def draw_preview(scenario: Scenario, path: Path, frames: int = 5, renderer: str = "clean") -> Preview:
    """Draw a scenario into a PNG, or into an HTML page that holds it.

    The drive and all road users are drawn as recorded or scripted; reactive ones go other ways once a policy drives.

    Args:
        scenario: What is drawn.
        path: ``.png`` or ``.html``.
        frames: How many moments, evenly from the first frame to the end.
        renderer: What the camera frames are rendered by.

    Raises:
        InputError: Another suffix, or no such renderer.
        RendererError: It cannot render the scene.
        InfrastructureError: The file cannot be written.
    """
    if path.suffix not in (".png", ".html"):
        raise InputError(DOING, str(path), f"suffix {path.suffix!r}", "name it .png or .html")
    times = [int(t) for t in np.linspace(scenario.start_us, scenario.end_us, frames)]
    there = [actor for actor in scenario.actors if actor.track.t_us[0] <= scenario.end_us and actor.track.t_us[-1] >= scenario.start_us]
    facts = _facts(scenario, there)
    png = _figure(scenario, there, times, _camera_frames(scenario, times, renderer), facts)
    write_bytes(path, png if path.suffix == ".png" else _page(scenario, png, facts))
    return Preview(tuple(round((t - times[0]) * 1e-6, 3) for t in times), len(there), facts)


def _camera_frames(scenario: Scenario, times: Sequence[int], renderer: str) -> list[U8]:
    """Render the first camera along the recorded drive."""
    session, camera = make_renderer(renderer, scenario), scenario.cameras[0]
    images = []
    for t_us in times:
        pose = interpolate(scenario.ego_log, np.array([t_us]))[0] @ camera.T_rig_camera
        there = (a for a in scenario.actors if a.track.t_us[0] <= t_us <= a.track.t_us[-1])
        poses = {actor.actor_id: interpolate(actor.track, int(t_us)) for actor in there}
        request = RenderRequest(int(t_us), camera, np.stack([pose, pose]), poses)
        images.append(checked_frames(session, [request])[0].rgb)
    return images


def _facts(scenario: Scenario, there: Sequence[Actor]) -> tuple[str, ...]:
    log = scenario.ego_log
    inside = (log.t_us >= scenario.start_us) & (log.t_us <= scenario.end_us)
    length_m = float(np.hypot(*np.diff(log.xyz[inside, :2], axis=0).T).sum())
    seconds = (scenario.end_us - scenario.start_us) * 1e-6
    kinds = {label: sum(a.label == label for a in there) for label in dict.fromkeys(a.label for a in there)}
    who = ", ".join(f"{n} {label}" for label, n in kinds.items()) or "nobody else"
    reacting = sum(actor.behaviour.kind != "replay" for actor in there)
    text = [
        f"{scenario.scene_id}: {seconds:.1f} s, {length_m:.0f} m at {length_m / seconds:.1f} m/s; {who}"
        + (f"; {reacting} of them {'reacts' if reacting == 1 else 'react'} once the policy drives" if reacting else ""),
        f"the policy drives from {scenario.warmup_us * 1e-6:.1f} s on; camera {scenario.cameras[0].name}, "
        f"{scenario.cameras[0].width}x{scenario.cameras[0].height}",
    ]
    changes = [f"{key} {_short(old)} -> {_short(new)}" for key, (old, new) in scenario.varied.items()]
    text += [f"scene seed {scenario.seed} varies {', '.join(changes[:6])}{' and more' if len(changes) > 6 else ''}"] if changes else []
    background = background_note(scenario)
    return (*text, *([background] if background else []), *scenario.notes[:4])


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def window(low: F64, high: F64, height_per_width: float) -> tuple[F64, F64]:
    """Return the corners ``(2,)`` of the smallest window of a shape that holds a box, about the box's middle.

    Example:
        >>> [corner.tolist() for corner in window(np.array([0.0, 0.0]), np.array([10.0, 4.0]), 0.5)]
        [[0.0, -0.5], [10.0, 4.5]]
    """
    shape = np.array([1.0, height_per_width])
    half = 0.5 * float(((high - low) / shape).max()) * shape
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def _figure(scenario: Scenario, there: Sequence[Actor], times: Sequence[int], images: Sequence[U8], facts: Sequence[str]) -> bytes:
    start = interpolate(scenario.ego_log, np.array([times[0], times[-1]]))[:, :2, 3]
    chord = start[1] - start[0]
    turn = np.arctan2(chord[1], chord[0]) if np.hypot(*chord) > 1.0 else yaw_of(interpolate(scenario.ego_log, np.array([times[0]]))[0])
    c, s = np.cos(turn), np.sin(turn)
    flat = np.array([[c, s], [-s, c]])  # world to page: the drive runs from left to right

    def place(xy: F64) -> F64:
        return np.asarray((xy[:, :2] - start[0]) @ flat.T)

    log = scenario.ego_log
    inside = (log.t_us >= scenario.start_us) & (log.t_us <= scenario.end_us)
    driven = place(log.xyz[inside])
    low, high = driven.min(axis=0) - MARGIN_M, driven.max(axis=0) + MARGIN_M
    map_height = float(np.clip(WIDTH * (high[1] - low[1]) / (high[0] - low[0]), MIN_HEIGHT, MAX_HEIGHT))
    strip_height = WIDTH / len(images) * images[0].shape[0] / images[0].shape[1] + 0.3
    text_height = 0.22 * len(facts) + 0.2
    height = map_height + strip_height + text_height
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(WIDTH, height), dpi=100)
        for row, line in enumerate(facts):
            figure.text(0.01, 1 - (0.2 + 0.22 * row) / height, line[:190], va="center", weight="bold" if row == 0 else "normal")
        axes = figure.add_axes((0.0, strip_height / height, 1.0, map_height / height))
        _draw_road(axes, scenario, place)
        _draw_users(axes, scenario, there, times, place, turn)
        (x0, y0), (x1, y1) = window(low, high, map_height / WIDTH)
        axes.set_xlim(x0, x1)
        axes.set_ylim(y0, y1)
        axes.set_aspect("equal")
        axes.set_axis_off()
        for k, (t_us, image) in enumerate(zip(times, images, strict=True)):
            cell = figure.add_axes((k / len(images) + 0.002, 0.0, 1 / len(images) - 0.004, (strip_height - 0.28) / height))
            cell.imshow(image)
            cell.set_title(f"{(t_us - times[0]) * 1e-6:.1f} s", fontsize=9, pad=2)
            cell.set_axis_off()
        buffer = io.BytesIO()
        FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()


def _draw_road(axes: Axes, scenario: Scenario, place: Any) -> None:
    lanes = [lane for lane in scenario.lane_map.lanes.values() if lane.left is not None and lane.right is not None]
    rings = [np.concatenate([place(lane.left), place(lane.right)[::-1]]) for lane in lanes]
    axes.add_collection(PolyCollection(rings, facecolor=ROAD, edgecolor="none", zorder=1))
    painted = [
        place(line) for lane in lanes for line, paint in ((lane.left, lane.left_paint), (lane.right, lane.right_paint)) if paint != "none"
    ]
    axes.add_collection(LineCollection(painted, colors=PAINT, linewidths=1.0, zorder=2))
    axes.add_collection(LineCollection([place(edge) for edge in scenario.lane_map.road_edges], colors=EDGE, linewidths=1.1, zorder=2))


def _draw_users(axes: Axes, scenario: Scenario, there: Sequence[Actor], times: Sequence[int], place: Any, turn: float) -> None:
    """Draw ways as lines and bodies at each moment, later ones darker; the ego last."""
    log, vehicle = scenario.ego_log, scenario.vehicle
    shades = np.linspace(0.25, 0.95, len(times))
    for k, actor in enumerate(there):
        colour = OTHERS[k % len(OTHERS)]
        inside = (actor.track.t_us >= times[0]) & (actor.track.t_us <= times[-1])
        if not actor.is_static and inside.sum() > 1:
            axes.plot(*place(actor.track.xyz[inside]).T, color=colour, linewidth=1.0, alpha=0.8, zorder=3)
        for t_us, shade in zip(times[-1:] if actor.is_static else times, shades[-1:] if actor.is_static else shades, strict=True):
            if actor.is_static or actor.track.t_us[0] <= t_us <= actor.track.t_us[-1]:
                at = int(np.clip(t_us, actor.track.t_us[0], actor.track.t_us[-1]))
                pose = interpolate(actor.track, np.array([at]))[0]
                _body(axes, place(pose[None, :3, 3])[0], yaw_of(pose) - turn, (actor.box.length_m, actor.box.width_m), colour, shade)
    inside = (log.t_us >= times[0]) & (log.t_us <= times[-1])
    axes.plot(*place(log.xyz[inside]).T, color=EGO, linewidth=1.6, zorder=5)
    for t_us, shade in zip(times, shades, strict=True):
        pose = interpolate(log, np.array([t_us]))[0]
        centre = pose[:3, 3] + pose[:3, 0] * vehicle.rear_axle_to_centre_m
        _body(axes, place(centre[None])[0], yaw_of(pose) - turn, (vehicle.box.length_m, vehicle.box.width_m), EGO, shade)


def _body(axes: Axes, at: F64, yaw: float, size: tuple[float, float], colour: str, shade: float) -> None:
    corners = rectangle_corners(at[None], np.array([yaw]), np.array([size]))[0]
    axes.add_collection(PolyCollection([corners], facecolor=colour, edgecolor=colour, alpha=shade, linewidth=0.8, zorder=6))


def _page(scenario: Scenario, png: bytes, facts: Sequence[str]) -> bytes:
    """Return one page without scripts that holds the picture."""
    picture = base64.b64encode(png).decode()
    name = html.escape(scenario.scene_id)
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    text = "".join(f"<p>{html.escape(line)}</p>" for line in facts)
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{name}</title>'
    )
    image = f'<img style="max-width:100%" src="data:image/png;base64,{picture}" alt="Map, road users and camera of {name}">'
    body = f'<body style="font-family:sans-serif"><h1>{name}</h1>{text}{image}</body>'
    return f'<!doctype html><html lang="en"><head>{head}</head>{body}</html>\n'.encode()
