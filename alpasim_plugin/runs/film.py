"""The film of a rollout: all its cameras beside one another. That of a policy without a camera is
rendered afterwards, at the logged poses.
"""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from alpasim_plugin.core.interfaces import BlockRule, Renderer
from alpasim_plugin.core.types import U8, Frame, Scenario, SensorSpec
from alpasim_plugin.log import decode_image, encode_image, read_asl
from alpasim_plugin.log.images import smaller
from alpasim_plugin.log.run_folder.schema import LOG_NAME, VIDEO_NAME
from alpasim_plugin.log.video import VideoWriter
from alpasim_plugin.runs.cameras import logged_request
from alpasim_plugin.runs.guards import checked_frames

SECOND_US = 1_000_000
WIDTH_PX = 640  # of a camera in a film, at most


class Film:
    """The frames of all cameras, by time."""

    def __init__(self) -> None:
        self._shots: dict[int, dict[str, bytes]] = {}

    def add(self, frame: Frame) -> None:
        """Keep a frame, no wider than `WIDTH_PX`, as a JPEG: a long drive has thousands."""
        shot = encode_image(smaller(frame.rgb, WIDTH_PX), "jpeg")
        self._shots.setdefault(frame.t_us, {})[frame.camera] = shot

    def save(self, folder: Path) -> None:
        """Write ``front.mp4``; nothing without frames. A camera without a frame at an instant shows
        its newest one, or else its first. Cameras stand in the order of their first frames.
        """
        times = sorted(self._shots)
        if not times:
            return
        step_us = int(np.diff(times).min(initial=SECOND_US))
        shots: dict[str, bytes] = {}
        for t_us in times:
            for name, shot in self._shots[t_us].items():
                shots.setdefault(name, shot)
        tick = Fraction(1, SECOND_US)
        with VideoWriter(folder / VIDEO_NAME, tick, Fraction(SECOND_US, step_us)) as video:
            for t_us in times:
                shots |= self._shots[t_us]
                images = beside(list(map(decode_image, shots.values())))
                video.write(images, t_us - times[0], step_us)


def beside(images: Sequence[U8]) -> U8:
    """Return images ``(H, W, 3)`` beside one another, black below those that are lower."""
    height = max(len(image) for image in images)
    return np.hstack(
        [np.pad(image, ((0, height - len(image)), (0, 0), (0, 0))) for image in images]
    )


def write_film(folder: Path, scenario: Scenario, renderer: Renderer) -> None:
    """Write ``front.mp4`` of a finished rollout: what a renderer shows in the scenario's cameras, at
    their periods and at the logged poses.

    A scenario without a camera has no film, and frames after the last whole block are left out.

    Args:
        folder: Of the rollout, with its log.
        scenario: What was driven.
        renderer: A session for this film alone.

    Raises:
        RendererError: The renderer raised, or a frame does not match its request.
    """
    log = read_asl(folder / LOG_NAME)
    film = Film()
    rule = renderer.block or BlockRule(1, 1)
    for camera in scenario.cameras:
        period_us = scenario.period_us(SensorSpec(camera.name))
        times = range(log.render_start_us, int(log.ego.t_us[-1]) + 1, period_us)
        requests = [logged_request(log, camera, t_us) for t_us in times]
        size = rule.first
        while size <= len(requests):
            for frame in checked_frames(renderer, requests[:size]):
                film.add(frame)
            requests = requests[size:]
            size = rule.then
    film.save(folder)
