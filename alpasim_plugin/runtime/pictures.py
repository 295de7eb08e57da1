"""The pictures of a rollout: a strip of a few frames always, a video on request. They show the policy's first camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from alpasim_plugin.atomic import write_bytes
from alpasim_plugin.clock import Clock
from alpasim_plugin.log import encode_image, write_mp4
from alpasim_plugin.types import U8, Frame

STRIP_NAME, VIDEO_NAME = "strip.jpg", "front.mp4"
STRIP_SHARES = (0.1, 0.37, 0.63, 0.9)  # when the strip's frames are taken, as shares of the rollout


class Pictures:
    """Keeps the frames that will be shown.

    Args:
        clock: The rollout's clock.
        camera: The camera to show.
        all_frames: Keep every frame for a video, or only those of the strip.
    """

    def __init__(self, clock: Clock, camera: str, all_frames: bool) -> None:
        self._camera, self._all, self._period_us = camera, all_frames, clock.rates.camera_us
        self._wanted_us = [clock.start_us + round(share * clock.n_steps) * clock.rates.control_us for share in STRIP_SHARES]
        self._kept: list[tuple[int, U8]] = []

    def add(self, frame: Frame) -> None:
        """Keep a frame if it will be shown."""
        if frame.camera == self._camera and (self._all or self._in_strip(frame.t_us)):
            self._kept.append((frame.t_us, frame.rgb))

    @property
    def strip_us(self) -> list[int]:
        """Give the times of the frames in the strip."""
        return [t_us for t_us, _ in self._strip()]

    def save(self, folder: Path, video: bool) -> None:
        """Write the strip, and the video if asked for; a rollout without frames leaves none."""
        strip = [rgb for _, rgb in self._strip()]
        if strip:
            write_bytes(folder / STRIP_NAME, encode_image(np.concatenate(strip, axis=1), "jpeg", 90))
        if video and self._kept:
            write_mp4(folder / VIDEO_NAME, [rgb for _, rgb in self._kept], 1e6 / self._period_us)

    def _in_strip(self, t_us: int) -> bool:
        return any(abs(t_us - wanted) * 2 < self._period_us for wanted in self._wanted_us)

    def _strip(self) -> list[tuple[int, U8]]:
        return [(t_us, rgb) for t_us, rgb in self._kept if self._in_strip(t_us)]
