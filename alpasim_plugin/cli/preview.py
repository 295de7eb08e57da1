"""A scenario that has not been driven in one image: map, road users over time, and the camera along
the recorded path.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from alpasim_plugin.core.atomic import write_bytes
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, yaw_of
from alpasim_plugin.core.types import F64, U8, Actor, Box, RenderRequest, Scenario, Trajectory
from alpasim_plugin.log.run_folder.writer import scene_as_json
from alpasim_plugin.renderers.background import background_note
from alpasim_plugin.runs.cell import make_renderer
from alpasim_plugin.runs.guards import checked_frames
from evaluators.report.birdseye import chord_angle, corners, drawn_map
from evaluators.viewer.drive_data import recorded_drive

Flatten = Callable[[F64], F64]  # (N, 2 or 3) metres, world -> (N, 2) metres on the page

MOMENTS = 5  # that are shown, evenly from the first frame to the end
MARGIN_M = 15.0
MAX_HEIGHT, MIN_HEIGHT = 5.0, 1.6  # of the map, inches
WIDTH = 13.0
ROAD, PAINT, CROSSWALK, EDGE, EGO = "#d7dadd", "#ffffff", "#c3c8cd", "#7d858c", "#0b6bb3"
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


def draw_preview(scenario: Scenario, path: Path, renderer: str | None = None) -> Preview:
    """Draw a scenario into a PNG, or into an HTML page that holds it.

    The drive and all road users are drawn as recorded or scripted; reactive ones go other ways once
    a policy drives.

    Args:
        scenario: What is drawn.
        path: ``.png`` or ``.html``.
        renderer: What the camera frames are rendered by; None: clean, or 3dgs for an imported
            drive, of which nothing was built.

    Raises:
        InputError: Another suffix, or no such renderer.
        RendererError: It cannot render the scene.
        InfrastructureError: The file cannot be written.
    """
    if path.suffix not in (".png", ".html"):
        raise InputError(f"{path}: suffix {path.suffix!r}", "name it .png or .html")
    times = [int(t) for t in np.linspace(scenario.start_us, scenario.end_us, MOMENTS)]
    there = [
        actor
        for actor in scenario.actors
        if actor.track.t_us[0] <= scenario.end_us and actor.track.t_us[-1] >= scenario.start_us
    ]
    facts = _facts(scenario, there)
    png = _figure(
        scenario,
        there,
        times,
        _camera_frames(scenario, times, renderer or ("3dgs" if scenario.model else "clean")),
        facts,
    )
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
    kinds = {
        label: sum(a.label == label for a in there)
        for label in dict.fromkeys(a.label for a in there)
    }
    who = ", ".join(f"{n} {label}" for label, n in kinds.items()) or "nobody else"
    reacting = sum(actor.behaviour.kind != "replay" for actor in there)
    text = [
        f"{scenario.scene_id}: {seconds:.1f} s, {length_m:.0f} m at {length_m / seconds:.1f} m/s; {who}"
        + (
            f"; {reacting} of them {'reacts' if reacting == 1 else 'react'} once the policy drives"
            if reacting
            else ""
        ),
        f"the policy drives from {scenario.warmup_us * 1e-6:.1f} s on; camera {scenario.cameras[0].name}, "
        f"{scenario.cameras[0].width}x{scenario.cameras[0].height}",
    ]
    changes = [
        f"{key} {_short(old)} -> {_short(new)}" for key, (old, new) in scenario.varied.items()
    ]
    text += (
        [
            f"scene seed {scenario.seed} varies {', '.join(changes[:6])}{' and more' if len(changes) > 6 else ''}"
        ]
        if changes
        else []
    )
    background = background_note(scenario)
    return (*text, *([background] if background else []), *scenario.notes[:4])


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def window(low: F64, high: F64, height_per_width: float) -> tuple[F64, F64]:
    """Return the corners ``(2,)`` of the smallest window of a shape that holds a box, about the
    box's middle.

    Example:
        >>> [corner.tolist() for corner in window(np.array([0.0, 0.0]), np.array([10.0, 4.0]), 0.5)]
        [[0.0, -0.5], [10.0, 4.5]]
    """
    shape = np.array([1.0, height_per_width])
    half = 0.5 * float(((high - low) / shape).max()) * shape
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def _figure(
    scenario: Scenario,
    there: Sequence[Actor],
    times: Sequence[int],
    images: Sequence[U8],
    facts: Sequence[str],
) -> bytes:
    content, log = scene_as_json(scenario), scenario.ego_log
    recorded = recorded_drive(content, scenario.scene_id)
    turn = chord_angle(recorded)
    c, s = np.cos(turn), np.sin(turn)
    flat = np.array([[c, s], [-s, c]])  # world to page: the drive runs from left to right

    def place(xy: F64) -> F64:
        return np.asarray((xy[:, :2] - recorded[0]) @ flat.T)

    driven = place(log.xyz[(log.t_us >= times[0]) & (log.t_us <= times[-1])])
    low, high = driven.min(axis=0) - MARGIN_M, driven.max(axis=0) + MARGIN_M
    map_height = float(
        np.clip(WIDTH * (high[1] - low[1]) / (high[0] - low[0]), MIN_HEIGHT, MAX_HEIGHT)
    )
    strip_height = WIDTH / len(images) * images[0].shape[0] / images[0].shape[1] + 0.3
    height = map_height + strip_height + 0.22 * len(facts) + 0.2
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(WIDTH, height), dpi=100)
        for row, line in enumerate(facts):
            figure.text(
                0.01,
                1 - (0.2 + 0.22 * row) / height,
                line[:190],
                va="center",
                weight="bold" if row == 0 else "normal",
            )
        axes = figure.add_axes((0.0, strip_height / height, 1.0, map_height / height))
        _draw_road(
            axes,
            {kind: [place(line) for line in lines] for kind, lines in drawn_map(content).items()},
        )
        _draw_users(axes, scenario, there, times, place)
        (x0, y0), (x1, y1) = window(low, high, map_height / WIDTH)
        axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
        axes.set_axis_off()
        for k, (t_us, image) in enumerate(zip(times, images, strict=True)):
            cell = figure.add_axes(
                (
                    k / len(images) + 0.002,
                    0.0,
                    1 / len(images) - 0.004,
                    (strip_height - 0.28) / height,
                )
            )
            cell.imshow(image)
            cell.set_title(f"{(t_us - times[0]) * 1e-6:.1f} s", fontsize=9, pad=2)
            cell.set_axis_off()
        buffer = io.BytesIO()
        FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()


def _draw_road(axes: Axes, lines: Mapping[str, Sequence[F64]]) -> None:
    axes.add_collection(PolyCollection(lines["lanes"], facecolor=ROAD, edgecolor="none", zorder=1))
    axes.add_collection(
        PolyCollection(lines["crosswalks"], facecolor=CROSSWALK, edgecolor="none", zorder=2)
    )
    axes.add_collection(LineCollection(lines["paint"], colors=PAINT, linewidths=1.0, zorder=2))
    axes.add_collection(LineCollection(lines["edges"], colors=EDGE, linewidths=1.1, zorder=2))


def _draw_users(
    axes: Axes, scenario: Scenario, there: Sequence[Actor], times: Sequence[int], place: Flatten
) -> None:
    """Draw ways as lines and bodies at each moment, later ones darker; the ego last."""
    moments = list(zip(times, np.linspace(0.25, 0.95, len(times)).tolist(), strict=True))

    def draw_way(track: Trajectory, colour: str) -> None:
        inside = (track.t_us >= times[0]) & (track.t_us <= times[-1])
        axes.plot(*place(track.xyz[inside]).T, color=colour, linewidth=1.2, zorder=3)

    for k, actor in enumerate(there):
        first, last = int(actor.track.t_us[0]), int(actor.track.t_us[-1])
        seen = [(t, shade) for t, shade in moments if first <= t <= last]
        if actor.is_static:
            seen = [(int(np.clip(times[-1], first, last)), moments[-1][1])]
        draw_way(actor.track, OTHERS[k % len(OTHERS)])
        _draw_bodies(axes, actor.track, actor.box, 0.0, seen, place, OTHERS[k % len(OTHERS)])
    vehicle = scenario.vehicle
    draw_way(scenario.ego_log, EGO)
    _draw_bodies(
        axes, scenario.ego_log, vehicle.box, vehicle.rear_axle_to_centre_m, moments, place, EGO
    )


def _draw_bodies(
    axes: Axes,
    track: Trajectory,
    box: Box,
    ahead_m: float,
    moments: Sequence[tuple[int, float]],
    place: Flatten,
    colour: str,
) -> None:
    """Draw a body at moments (time, shade), with its centre so far ahead of the poses of its
    track.
    """
    for t_us, shade in moments:
        pose = interpolate(track, np.array([t_us]))[0]
        centre = pose[:2, 3] + pose[:2, 0] * ahead_m
        body = place(corners(centre, yaw_of(pose), box.length_m, box.width_m))
        axes.add_collection(
            PolyCollection(
                [body], facecolor=colour, edgecolor=colour, alpha=shade, linewidth=0.8, zorder=6
            )
        )


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
