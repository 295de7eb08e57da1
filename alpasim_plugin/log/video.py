"""Write and read camera frames as MP4 (H.264, yuv420p): small, playable anywhere, exactly timed, but lossy."""

from __future__ import annotations

import os
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np

from alpasim_plugin.errors import InfrastructureError, InputError
from alpasim_plugin.types import I64, U8

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
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        count = _encode(partial, path, frames, rate, crf)
        partial.replace(path)
    except (OSError, av.FFmpegError) as error:
        raise InfrastructureError("writing a video", str(path), str(error), "check that the folder exists and has room") from error
    finally:
        partial.unlink(missing_ok=True)
    return count


def read_mp4(path: Path | str) -> Video:
    """Read a whole video; frames of padded odd sizes keep the padding.

    Raises:
        InputError: Missing file, no video in it, or damage.
    """
    path = Path(path)
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            decoded = [(frame.to_ndarray(format="rgb24"), frame.pts * frame.time_base) for frame in container.decode(stream)]
            rate = Fraction(stream.average_rate)
    except (OSError, IndexError, av.FFmpegError) as error:
        raise InputError("reading a video", str(path), str(error) or "no video stream", "give a whole MP4 file") from error
    if not decoded:
        raise InputError("reading a video", str(path), "no frames", "give a whole MP4 file")
    t_us = np.array([round(t * 1_000_000) for _, t in decoded], dtype=np.int64)
    return Video(np.stack([image for image, _ in decoded]), t_us, rate)


def _encode(partial: Path, path: Path, frames: Iterable[U8], rate: Fraction, crf: int) -> int:
    count, size = 0, None
    with av.open(str(partial), mode="w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": str(crf), "preset": "veryfast"})
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = 1 / rate
        stream.thread_count = 1  # the run's thread budget counts worker processes, not encoder threads
        for image in frames:
            size = size or image.shape
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.shape != size:
                found = f"frame {count}: {image.shape} {image.dtype}, the first is {size}"
                raise InputError("writing a video", str(path), found, "give frames (H, W, 3) uint8 of one size")
            even = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
            if count == 0:
                stream.height, stream.width = even.shape[:2]
            frame = av.VideoFrame.from_ndarray(even, format="rgb24")
            frame.pts, frame.time_base = count, 1 / rate
            container.mux(stream.encode(frame))
            count += 1
        if count:
            container.mux(stream.encode())
    if not count:
        raise InputError("writing a video", str(path), "no frames", "record at least one frame")
    return count
