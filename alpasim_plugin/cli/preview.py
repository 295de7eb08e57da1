"""Draw a scenario that has not been driven: map, road users over time, and the camera images along
the recorded path.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D

from alpasim_plugin.cli.output import varied_numbers
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import atomic_file
from alpasim_plugin.core.geometry import interpolate, rectangle_corners, yaw_of
from alpasim_plugin.core.types import Actor, Box, Scenario, Trajectory
from alpasim_plugin.log.run_folder.writer import scene_as_json
from alpasim_plugin.renderers.background import background_note
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.guards import checked_frames
from alpasim_plugin.runs.renderer import make_renderer
from evaluators.pages.birdseye import chord_angle, drawn_map

MOMENTS = 5  # that are shown, evenly from the first frame to the end
MARGIN_M = 15.0
SIZE = (13.0, 7.0)  # inches
SHOWN_CHANGES = 6
SHOWN_NOTES = 4
ROAD = "#d7dadd"
MARKING = "#ffffff"
CROSSWALK = "#c3c8cd"
EDGE = "#7d858c"
EGO = "#0b6bb3"
OTHERS = ("#c2540a", "#00806a", "#9a4f8f", "#8a6a00", "#b3344a", "#3f51b5", "#5b6470")


def draw_preview(scenario: Scenario, path: Path, renderer: str | None = None) -> dict[str, Any]:
    """Draw a scenario into a PNG.

    The ego and all road users are drawn as recorded or scripted; reactive ones go other ways once a
    policy drives.

    Args:
        scenario: What is drawn.
        path: The PNG.
        renderer: Renders the camera images; None: clean, or 3dgs for an imported drive, of which
            clean knows nothing.

    Returns:
        ``times_s`` of the images after the first frame, how many ``actors`` there are, and
        ``facts``, one a line.

    Raises:
        InputError: Another suffix, or no such renderer.
        RendererError: It cannot render the scene.
        InfrastructureError: The file cannot be written.
    """
    if path.suffix != ".png":
        raise InputError(f"{path}: the image is a PNG", "Name a file that ends in .png.")
    end_us = scenario.recorded_until_us
    times = [int(t_us) for t_us in np.linspace(scenario.start_us, end_us, MOMENTS)]
    actors = [
        actor
        for actor in scenario.actors
        if actor.track.t_us[0] <= end_us and actor.track.t_us[-1] >= scenario.start_us
    ]
    facts = _facts(scenario, actors)
    session = make_renderer(renderer or ("3dgs" if scenario.model else "clean"), scenario)
    figure = Figure(SIZE, dpi=100, layout="constrained")
    figure.suptitle("\n".join(line[:190] for line in facts), fontsize=9, x=0.01, ha="left")
    above, below = np.asarray(figure.subfigures(2, 1, height_ratios=[2, 1]))
    _draw_map(above.subplots(), scenario, actors, times)
    for axes, t_us in zip(below.subplots(1, MOMENTS), times, strict=True):
        axes.imshow(checked_frames(session, recorded_requests(scenario, t_us)[:1])[0].rgb)
        axes.set_title(f"{(t_us - times[0]) * 1e-6:.1f} s", fontsize=9)
        axes.set_axis_off()
    with atomic_file(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})
    times_s = [round((t_us - times[0]) * 1e-6, 3) for t_us in times]
    return {"times_s": times_s, "actors": len(actors), "facts": facts}


def _facts(scenario: Scenario, actors: Sequence[Actor]) -> list[str]:
    log = scenario.ego_log
    inside = (log.t_us >= scenario.start_us) & (log.t_us <= scenario.recorded_until_us)
    length_m = float(np.hypot(*np.diff(log.xyz[inside, :2], axis=0).T).sum())
    duration_s = (scenario.recorded_until_us - scenario.start_us) * 1e-6
    kinds = Counter(actor.label for actor in actors)
    users = ", ".join(f"{count} {label}" for label, count in kinds.items()) or "nobody else"
    reacting = sum(actor.behaviour.kind != "replay" for actor in actors)
    if reacting:
        users += f"; of them {reacting} react once the policy drives"
    camera = scenario.cameras[0]
    facts = [
        f"{scenario.scene_id}: {duration_s:.1f} s, {length_m:.0f} m at "
        f"{length_m / duration_s:.1f} m/s; {users}",
        f"the policy drives from {scenario.warmup_us * 1e-6:.1f} s on; camera {camera.name}, "
        f"{camera.width}x{camera.height}",
    ]
    changes = varied_numbers(scenario.varied)
    if changes:
        more = " and more" if len(changes) > SHOWN_CHANGES else ""
        excerpt = ", ".join(changes[:SHOWN_CHANGES])
        facts.append(f"scene seed {scenario.seed} varies {excerpt}{more}")
    background = background_note(scenario)
    if background:
        facts.append(background)
    return [*facts, *scenario.notes[:SHOWN_NOTES]]


def _draw_map(
    axes: Axes, scenario: Scenario, actors: Sequence[Actor], times: Sequence[int]
) -> None:
    """Draw the map, turned so that the drive runs from left to right, and everybody on it."""
    lines = drawn_map(scene_as_json(scenario))
    log = scenario.ego_log
    driven = log.xyz[(log.t_us >= times[0]) & (log.t_us <= times[-1]), :2]
    turn = Affine2D().rotate(-chord_angle(driven))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_axis_off()
    world = turn + axes.transData
    for kind, colour in (("lanes", ROAD), ("crosswalks", CROSSWALK)):
        axes.add_collection(PolyCollection(lines[kind], facecolor=colour, transform=world))
    for kind, colour in (("markings", MARKING), ("edges", EDGE)):
        axes.add_collection(LineCollection(lines[kind], colors=colour, transform=world))
    for number, actor in enumerate(actors):
        colour = OTHERS[number % len(OTHERS)]
        _draw_user(axes, world, actor.track, actor.box, 0.0, times, colour)
    vehicle = scenario.vehicle
    _draw_user(axes, world, log, vehicle.box, vehicle.rear_axle_to_centre_m, times, EGO)
    low = turn.transform(driven).min(axis=0)
    high = turn.transform(driven).max(axis=0)
    axes.set_xlim(low[0] - MARGIN_M, high[0] + MARGIN_M, auto=True)
    axes.set_ylim(low[1] - MARGIN_M, high[1] + MARGIN_M, auto=True)


def _draw_user(
    axes: Axes,
    world: Any,
    track: Trajectory,
    box: Box,
    ahead_m: float,
    times: Sequence[int],
    colour: str,
) -> None:
    """Draw a path, and its body at each moment, later ones darker.

    Args:
        axes: Of the map.
        world: Transform from world to page.
        track: Poses of a road user.
        box: Its size.
        ahead_m: Its centre ahead of its poses, metres.
        times: Moments, microseconds.
        colour: Of the path and the bodies.
    """
    inside = (track.t_us >= times[0]) & (track.t_us <= times[-1])
    axes.plot(*track.xyz[inside, :2].T, color=colour, transform=world, zorder=3)
    for t_us, shade in zip(times, np.linspace(0.25, 0.95, len(times)), strict=True):
        if track.t_us[0] <= t_us <= track.t_us[-1]:
            pose = interpolate(track, t_us)
            centre = pose[:2, 3] + pose[:2, 0] * ahead_m
            size_m = np.array([[box.length_m, box.width_m]])
            body = rectangle_corners(centre[None], np.array([yaw_of(pose)]), size_m)
            axes.fill(*body[0].T, color=colour, alpha=shade, transform=world, zorder=6)
