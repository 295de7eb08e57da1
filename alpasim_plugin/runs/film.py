"""The film of a rollout whose policy has no camera: rendered afterwards, at its logged poses."""

from __future__ import annotations

from itertools import count
from pathlib import Path

from alpasim_plugin.core.interfaces import BlockRule, Renderer
from alpasim_plugin.core.types import U8, Scenario, SensorSpec
from alpasim_plugin.log import read_asl, write_mp4
from alpasim_plugin.log.run_folder.schema import LOG_NAME, VIDEO_NAME
from alpasim_plugin.runs.cameras import logged_request
from alpasim_plugin.runs.guards import checked_frames


def write_film(folder: Path, scenario: Scenario, renderer: Renderer) -> None:
    """Write ``front.mp4`` of a finished rollout: what a renderer shows in the scenario's first
    camera, at its period and at the logged poses.

    A scenario without a camera has no film, and frames after the last whole block are left out.

    Args:
        folder: Of the rollout, with its log.
        scenario: What was driven.
        renderer: A session for this film alone.

    Raises:
        RendererError: The renderer raised, or a frame does not match its request.
    """
    if not scenario.cameras:
        return
    camera = scenario.cameras[0]
    period_us = scenario.period_us(SensorSpec(camera.name))
    log = read_asl(folder / LOG_NAME)
    times = range(log.render_start_us, int(log.ego.t_us[-1]) + 1, period_us)
    requests = [logged_request(log, camera, t_us) for t_us in times]
    rule = renderer.block or BlockRule(1, 1)
    images: list[U8] = []
    for number in count():
        end = len(images) + rule.frames(number)
        if end > len(requests):
            break
        frames = checked_frames(renderer, requests[len(images) : end])
        images += [frame.rgb for frame in frames]
    if images:
        write_mp4(folder / VIDEO_NAME, images, 1e6 / period_us)
