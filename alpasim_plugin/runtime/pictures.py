"""Images of a rollout from the policy's first camera: always a strip of a few frames, on request a video."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.types import U8, Frame
from alpasim_plugin.io.atomic import write_bytes
from alpasim_plugin.log import encode_image, write_mp4
from alpasim_plugin.run_folder.schema import STRIP_NAME, VIDEO_NAME

STRIP_FRACTIONS = (0.1, 0.37, 0.63, 0.9)  # times of the strip's frames, as fractions of the rollout


class Pictures:
    """Collects the frames of the strip and of the video.

    Args:
        clock: The rollout's clock.
        camera: Name of the camera.
        all_frames: Keep every frame for a video, not only those of the strip.
    """

    def __init__(self, clock: Clock, camera: str, all_frames: bool) -> None:
        self._camera, self._all, self._period_us = camera, all_frames, clock.rates.camera_us
        self._strip_us = [clock.start_us + round(fraction * clock.n_steps) * clock.rates.control_us for fraction in STRIP_FRACTIONS]
        self._kept: list[tuple[int, U8]] = []

    def add(self, frame: Frame) -> None:
        """Keep a frame that the strip or the video needs."""
        if frame.camera == self._camera and (self._all or self._in_strip(frame.t_us)):
            self._kept.append((frame.t_us, frame.rgb))

    @property
    def strip_us(self) -> list[int]:
        """Give the times of the frames in the strip."""
        return [t_us for t_us, _ in self._strip()]

    def save(self, folder: Path, video: bool) -> None:
        """Write the strip, and the video if requested; nothing for a rollout without frames."""
        strip = [rgb for _, rgb in self._strip()]
        if strip:
            write_bytes(folder / STRIP_NAME, encode_image(np.concatenate(strip, axis=1), "jpeg", 90))
        if video and self._kept:
            write_mp4(folder / VIDEO_NAME, [rgb for _, rgb in self._kept], 1e6 / self._period_us)

    def _in_strip(self, t_us: int) -> bool:
        return any(abs(t_us - at_us) * 2 < self._period_us for at_us in self._strip_us)

    def _strip(self) -> list[tuple[int, U8]]:
        return [(t_us, rgb) for t_us, rgb in self._kept if self._in_strip(t_us)]
