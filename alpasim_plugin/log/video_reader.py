"""Read any video frame by frame: constant memory, exact times, upright pictures in the video's own colours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import U8
from alpasim_plugin.io.limits import ARCHIVE_BYTES
from alpasim_plugin.io.reading import check_regular
from alpasim_plugin.log.pyav import exact_conversion, load_av

UNSPECIFIED = 2  # of ITU-T H.273: matrix, primaries and transfer that a video does not state
GIVE = "give a whole video file (MP4, MOV, MKV, WebM, AVI, ...)"


class TimedFrame(NamedTuple):
    """One picture ``(H, W, 3)`` uint8 sRGB, shown from ``time`` for ``duration``, both in units of the video's ``time_base``."""

    image: U8
    time: int
    duration: int


@dataclass(frozen=True)
class VideoFormat:
    """What a video states about itself; pictures are upright, so width and height are those after the rotation in its metadata.

    Attributes:
        width, height: Pixels.
        rate: Frames per second on average, None where unknown.
        time_base: Seconds of one tick of its frames' times.
        frames: Number of frames that the container claims, None where it claims none.
        pixel_aspect: Width of a pixel over its height.
        colour: Matrix, primaries and transfer as numbered by ITU-T H.273; 2 where not stated.
        audio: Whether sound comes with it.
    """

    width: int
    height: int
    rate: Fraction | None
    time_base: Fraction
    frames: int | None
    pixel_aspect: Fraction
    colour: tuple[int, int, int]
    audio: bool


class VideoReader:
    """Iterate once over the frames of a video file; use it in a ``with`` statement.

    Times strictly increase: a frame without one follows its predecessor by one frame of the average rate.

    Args:
        path: The file.
        doing: For messages.

    Raises:
        InputError: Missing or unreadable file, no video in it, no frames, damage, a changing picture size, times that go back.

    Example:
        >>> with VideoReader("drive.mp4") as video:                           # doctest: +SKIP
        ...     print(video.format.rate, [frame.time for frame in video])
    """

    def __init__(self, path: Path | str, doing: str = "reading a video") -> None:
        self.path, self._doing = Path(path), doing
        check_regular(self.path, doing, ARCHIVE_BYTES)
        self._av = load_av(doing)
        try:
            self._container = self._av.open(str(self.path), metadata_errors="replace")
        except (OSError, self._av.FFmpegError) as error:
            raise self._refusal(error.strerror or str(error)) from error
        try:
            self._begin()
        except BaseException:
            self._container.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._container.close()

    def __iter__(self) -> Iterator[TimedFrame]:
        step = 1 if self.format.rate is None else max(1, round(1 / (self.format.rate * self.format.time_base)))
        last: int | None = None
        for index, frame in enumerate(self._all()):
            time = frame.pts if frame.pts is not None else 0 if last is None else last + step
            if last is not None and time <= last:
                found = f"frame {index} at {float(time * self.format.time_base):.6f} s, not after the one before"
                raise self._refusal(found, "rewrite its time stamps, for example with ffmpeg -i IN -vf setpts=N/FR/TB OUT")
            image = self._upright(frame)
            if image.shape[:2] != (self.format.height, self.format.width):
                found = f"frame {index} is {image.shape[1]}x{image.shape[0]}, the first is {self.format.width}x{self.format.height}"
                raise self._refusal(found, "cut it where the size changes")
            yield TimedFrame(image, time, frame.duration or step)
            last = time
        self._check_end(index + 1, time + 2 * step)

    def _begin(self) -> None:
        if not self._container.streams.video:
            kinds = ", ".join(sorted({stream.type for stream in self._container.streams}))
            raise self._refusal(f"no video stream ({kinds} only)" if kinds else "no streams at all")
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._decoded = self._decode()
        first = next(self._decoded, None)
        if first is None:
            raise self._refusal("no frames")
        self._first: Any = first
        height, width = self._upright(first).shape[:2]
        turned = (width, height) != (first.width, first.height)
        aspect = Fraction(self._stream.sample_aspect_ratio or 1)
        self.format = VideoFormat(
            width=width,
            height=height,
            rate=Fraction(self._stream.average_rate) if self._stream.average_rate else None,
            time_base=Fraction(self._stream.time_base),
            frames=self._stream.frames or None,
            pixel_aspect=1 / aspect if turned else aspect,
            colour=(int(first.colorspace), int(first.color_primaries), int(first.color_trc)),
            audio=bool(self._container.streams.audio),
        )

    def _check_end(self, count: int, reached: int) -> None:
        """Refuse a file that was cut short: fewer frames than it claims, and an end well before the one it claims."""
        claimed, length = self.format.frames, self._stream.duration
        if claimed and count < claimed and length and reached < (self._stream.start_time or 0) + length:
            raise self._refusal(f"it stops after frame {count} of {claimed}")

    def _all(self) -> Iterator[Any]:
        yield self._first
        self._first = None
        yield from self._decoded

    def _decode(self) -> Iterator[Any]:
        count = 0
        try:
            for frame in self._container.decode(self._stream):
                yield frame
                count += 1
        except self._av.FFmpegError as error:
            raise self._refusal(f"damage after frame {count}: {error.strerror or error}") from error

    def _upright(self, frame: Any) -> U8:
        # By the matrix that the frame states; BT.601 where it states none.
        image: U8 = frame.to_ndarray(format="rgb24", interpolation=exact_conversion(self._av), threads=1)
        turns = round(frame.rotation / 90) % 4  # counter-clockwise
        return np.ascontiguousarray(np.rot90(image, turns)) if turns else image

    def _refusal(self, found: str, do: str = GIVE) -> InputError:
        return InputError(self._doing, str(self.path), found, do)
