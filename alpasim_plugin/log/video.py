"""Write and read camera frames as MP4 (H.264, yuv420p): small, playable anywhere, exactly timed, but lossy."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import I64, U8
from alpasim_plugin.log.video_reader import VideoReader
from alpasim_plugin.log.video_writer import VideoWriter

_MAX_DENOMINATOR = 1001  # covers whole rates and the 1001 family (29.97 = 30000/1001)


class Video(NamedTuple):
    """Decoded frames ``(N, H, W, 3)`` uint8 sRGB, their times ``(N,)`` in microseconds, and the frame rate."""

    frames: U8
    t_us: I64
    fps: Fraction


def write_mp4(path: Path | str, frames: Iterable[U8], fps: float | Fraction, crf: int = 18) -> int:
    """Write frames ``(H, W, 3)`` uint8 sRGB, frame i at exactly i / fps seconds.

    Odd sizes are padded by repeating the last row or column, as yuv420p needs even ones. The file appears under its name only once
    complete.

    Args:
        path: The file.
        frames: All of one size; taken one at a time.
        fps: Frames per second.
        crf: Quality of the encoder, 0 (lossless in yuv) to 51.

    Returns:
        Number of frames written.

    Raises:
        InputError: No frame, frames of changing size or wrong type, or a rate that is not positive.
        InfrastructureError: The disk or the encoder refuses.
    """
    path = Path(path)
    rate = Fraction(fps).limit_denominator(_MAX_DENOMINATOR)
    if rate <= 0:
        raise InputError("writing a video", str(path), f"{fps} frames per second", "give a positive rate")
    with VideoWriter(path, 1 / rate, rate, crf=crf) as video:
        for index, image in enumerate(frames):
            video.write(image, index)
    return video.count


def read_mp4(path: Path | str) -> Video:
    """Read a whole video; frames of padded odd sizes keep the padding.

    Raises:
        InputError: Missing file, no video or frame rate in it, or damage.
    """
    with VideoReader(path) as video:
        decoded, rate, base = list(video), video.format.rate, video.format.time_base
    if rate is None:
        raise InputError("reading a video", str(path), "no frame rate", "give a whole MP4 file")
    t_us = np.array([round(frame.time * base * 1_000_000) for frame in decoded], dtype=np.int64)
    return Video(np.stack([frame.image for frame in decoded]), t_us, rate)
