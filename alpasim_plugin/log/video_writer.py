"""Write a video frame by frame (H.264, yuv420p, MP4): any times, any length, complete or not there at all."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.types import U8
from alpasim_plugin.io.atomic import temporary_path
from alpasim_plugin.log.pyav import exact_conversion, load_av
from alpasim_plugin.log.video_reader import UNSPECIFIED

BT601, BT709 = 5, 1  # matrices of ITU-T H.273
WRITABLE = {UNSPECIFIED: BT601, BT709: BT709, 4: 4, BT601: BT601, 6: BT601, 7: 7, 9: 9}  # stated matrix -> the one to convert with
DOING = "writing a video"


class VideoWriter:
    """Take frames one by one; use it in a ``with`` statement.

    The file appears under its name once the block ends well; until then, and for good if it fails, there is only a temporary file, which is
    removed. Odd sizes are padded by repeating the last row or column, as yuv420p needs even ones.

    Args:
        path: The file.
        time_base: Seconds of one tick of the frames' times.
        rate: Frames per second, for players that ask; times are what counts.
        colour: Matrix, primaries and transfer that the pictures follow (ITU-T H.273); they are stated in the file.
        pixel_aspect: Width of a pixel over its height.
        crf: Quality of the encoder, 0 (lossless in yuv) to 51.

    Raises:
        InputError: No frame, or frames of changing size or wrong type.
        InfrastructureError: The disk or the encoder refuses.

    Example:
        >>> with VideoWriter("a.mp4", Fraction(1, 25), Fraction(25)) as video:     # doctest: +SKIP
        ...     video.write(image, time=0)
    """

    def __init__(
        self,
        path: Path | str,
        time_base: Fraction,
        rate: Fraction,
        colour: tuple[int, int, int] = (UNSPECIFIED, UNSPECIFIED, UNSPECIFIED),
        pixel_aspect: Fraction = Fraction(1),
        crf: int = 18,
    ) -> None:
        self.path, self.count = Path(path), 0
        self._time_base, self._colour, self._pixel_aspect = time_base, colour, pixel_aspect
        self._matrix = WRITABLE.get(colour[0], BT709)
        self._size: tuple[int, ...] | None = None
        self._partial = temporary_path(self.path)
        self._av = load_av(DOING)
        try:
            self._container = self._av.open(str(self._partial), mode="w", format="mp4")
        except (OSError, self._av.FFmpegError) as error:
            raise self._failure(error) from error
        self._stream = self._container.add_stream("libx264", rate=rate, options={"crf": str(crf), "preset": "veryfast"})
        self._stream.pix_fmt = "yuv420p"
        self._stream.time_base = self._stream.codec_context.time_base = time_base
        self._stream.thread_count = 1  # the thread budget counts workers and networks, not encoder threads

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if error is None and self.count:
                self._container.mux(self._stream.encode())
            if error is None or self.count:
                self._container.close()
            if error is None and not self.count:
                raise InputError(DOING, str(self.path), "no frames", "give at least one frame")
            if error is None:
                self._partial.replace(self.path)
        except (OSError, self._av.FFmpegError) as failure:
            raise self._failure(failure) from (error or failure)
        finally:
            self._partial.unlink(missing_ok=True)

    def write(self, image: U8, time: int, duration: int = 1) -> None:
        """Append one frame ``(H, W, 3)`` uint8 sRGB, shown from ``time`` for ``duration`` ticks."""
        self._size = self._size or image.shape
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.shape != self._size:
            found = f"frame {self.count}: {image.shape} {image.dtype}, the first is {self._size}"
            raise InputError(DOING, str(self.path), found, "give frames (H, W, 3) uint8 of one size")
        even = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
        if self.count == 0:
            self._state_format(*even.shape[:2])
        rgb = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
        frame = rgb.reformat(format="yuv420p", dst_colorspace=self._matrix, interpolation=exact_conversion(self._av), threads=1)
        frame.pts, frame.time_base, frame.duration = time, self._time_base, duration
        try:
            self._container.mux(self._stream.encode(frame))
        except (OSError, self._av.FFmpegError) as error:
            raise self._failure(error) from error
        self.count += 1

    def _state_format(self, height: int, width: int) -> None:
        codec = self._stream.codec_context
        codec.height, codec.width = height, width
        matrix, primaries, transfer = self._colour
        codec.colorspace = matrix if matrix in WRITABLE else self._matrix
        codec.color_primaries, codec.color_trc = primaries, transfer
        if self._pixel_aspect != 1:
            codec.sample_aspect_ratio = self._pixel_aspect

    def _failure(self, error: Exception) -> InfrastructureError:
        return InfrastructureError(DOING, str(self.path), str(error), "check that the folder exists and has room")
