"""The camera frames of a rollout, from its log or else its video, made small enough for a page, and
where a fixer took them from.
"""

import base64
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import (
    TRUST_CELLS,
    U8,
    LoggedImage,
    RolloutLog,
)
from alpasim_plugin.log import decode_image, read_facts
from alpasim_plugin.log.images import smaller
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import FRAMES_NAME, VIDEO_NAME
from alpasim_plugin.log.video import VideoReader
from evaluators.statistics.opening import Run

JPEG_QUALITY = 76
FRAME_PX = 512  # wider frames are made smaller
NO_FRAMES = "No camera frames were kept: the policy takes none, or the run had --images none. Run it again with --video all."


Rows = Sequence[Mapping[str, Any]]  # facts of the frames, as `frames.jsonl` has them


@dataclass(frozen=True)
class Source:
    """The frames that a rollout has of one camera: encoded ones of a log, or a video's.

    Attributes:
        images: In order of time; empty for a video.
        video: The file, and the time of its first frame in microseconds.
    """

    camera: str
    images: tuple[LoggedImage, ...] = ()
    video: tuple[Path, int] | None = None

    def decoded(self, image: LoggedImage) -> U8:
        """Return the ``(H, W, 3)`` uint8 sRGB of one of the images.

        Raises:
            InputError: It cannot be decoded.
        """
        return decode_image(image.data, f"camera {self.camera!r} at {image.end_us} us")

    def filmed(self) -> Iterator[tuple[int, U8]]:
        """Yield time in microseconds and ``(H, W, 3)`` uint8 sRGB of every frame of the video;
        nothing where there is none.

        Raises:
            InputError: A frame cannot be decoded.
        """
        if self.video is None:
            return
        path, start_us = self.video
        with VideoReader(path) as video:
            for frame in video:
                after_us = round(frame.time * video.format.time_base * 1_000_000)
                yield start_us + after_us, frame.image


def sources(run: Run, rollout: Rollout, log: RolloutLog) -> list[Source]:
    """Return the cameras of a rollout that have frames, in the log's order; empty where none was
    kept.
    """
    cameras: dict[str, list[LoggedImage]] = {}
    for image in log.images:
        cameras.setdefault(image.camera, []).append(image)
    video = run.file_of(rollout, VIDEO_NAME)
    if cameras or video is None:
        return [Source(name, tuple(images)) for name, images in cameras.items()]
    filmed = sorted({row["camera"] for row in frame_rows(run, rollout)})
    return [Source(", ".join(filmed) or "all cameras", video=(video, log.render_start_us))]


def encoded(source: Source, zero_us: int) -> dict[str, Any]:
    """Return a camera's frames for a page: name, size in pixels, times in milliseconds, and JPEG in
    base64.
    """

    def small(image: LoggedImage) -> U8:
        return smaller(source.decoded(image), FRAME_PX)

    with ThreadPoolExecutor() as threads:  # OpenCV does not hold Python's lock
        frames = list(threads.map(small, source.images))
        times_us = [image.end_us for image in source.images]
        for t_us, rgb in source.filmed():
            frames.append(smaller(rgb, FRAME_PX))
            times_us.append(t_us)
        data = list(threads.map(jpeg, frames))
    height, width = frames[-1].shape[:2] if frames else (0, 0)
    t_ms = [round((t_us - zero_us) / 1000) for t_us in times_us]
    return {"name": source.camera, "width": width, "height": height, "t": t_ms, "jpeg": data}


def jpeg(rgb: U8) -> str:
    """Encode an image ``(H, W, 3)`` for a page, as base64."""
    # Halved colour resolution and optimised tables: a page is looked at, not measured.
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise InputError(
            f"array {rgb.shape}: the encoder refused",
            "use smaller images",
        )
    return base64.b64encode(data.tobytes()).decode()


def frame_rows(run: Run, rollout: Rollout) -> Rows:
    """Return the facts of a rollout's camera frames; none where the run kept none."""
    path = run.file_of(rollout, FRAMES_NAME)
    return read_facts(path) if path is not None else []


def trust_by_time(rows: Rows, camera: str) -> dict[int, str]:
    """Return the text of `fixers.trust.trust_cells` of a camera's frames by time, microseconds."""
    return {
        int(row["t_us"]): str(row[TRUST_CELLS])
        for row in rows
        if row.get("camera") == camera and TRUST_CELLS in row
    }
