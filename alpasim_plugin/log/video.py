"""Write and read camera frames as MP4 (H.264, yuv420p): small, playable anywhere, exactly timed,
but lossy.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.files import check_regular
from alpasim_plugin.core.files.atomic import temporary_path
from alpasim_plugin.core.files.limits import ARCHIVE_BYTES
from alpasim_plugin.core.types import I64, U8

UNSPECIFIED = 2  # of ITU-T H.273: matrix, primaries and transfer that a video does not state
GIVE = "give a whole video file (MP4, MOV, MKV, WebM, AVI, ...)"
SQUARE = 1e-3  # by how much a turn may miss a quarter
# Matrices of ITU-T H.273
BT601 = 5
BT709 = 1
# Stated matrix -> the one to convert with
WRITABLE = {
    UNSPECIFIED: BT601,
    BT709: BT709,
    4: 4,
    BT601: BT601,
    6: BT601,
    7: 7,
    9: 9,
}
_MAX_DENOMINATOR = 1001  # covers whole rates and the 1001 family (29.97 = 30000/1001)


def load_av() -> Any:
    """Return the module ``av``.

    Args:

    Raises:
        InfrastructureError: It is not installed, or does not load.
    """
    try:
        import av
        import av.video.reformatter
    except ImportError as missing:
        raise InfrastructureError(
            f"PyAV: it does not load ({missing})", 'pip install "av>=14"'
        ) from missing
    return av


def exact_conversion(av: Any) -> Any:
    """Return the scaler's settings for colour conversion. Its faster ones darken images by a grey
    level; these are exact to a tenth.
    """
    flags = av.video.reformatter.Interpolation
    return flags.BILINEAR | flags.ACCURATE_RND | flags.FULL_CHR_H_INP | flags.FULL_CHR_H_INT


class TimedFrame(NamedTuple):
    """One image ``(H, W, 3)`` uint8 sRGB, shown from ``time`` for ``duration``, both in units of
    the video's ``time_base``.
    """

    image: U8
    time: int
    duration: int


@dataclass(frozen=True)
class VideoFormat:
    """What a video states about itself; images are upright, so width and height are those after
    the quarter turns and mirrors of its display matrix.

    Attributes:
        width, height: Pixels.
        rate: Frames per second on average, None where unknown.
        time_base: Seconds of one tick of its frames' times.
        frames: Number of frames that the container claims, None where it claims none.
        pixel_aspect: Width of a pixel over its height.
        colour: Matrix, primaries and transfer as numbered by ITU-T H.273; 2 where not stated.
        left_out: What the file holds besides and is not read.
    """

    width: int
    height: int
    rate: Fraction | None
    time_base: Fraction
    frames: int | None
    pixel_aspect: Fraction
    colour: tuple[int, int, int]
    left_out: tuple[str, ...] = ()


class VideoReader:
    """Iterate once over the frames of a video file; use it in a ``with`` statement.

    Times strictly increase: a frame without one follows its predecessor by one frame of the average
    rate.

    Args:
        path: The file.

    Raises:
        InputError: Missing or unreadable file, no video in it, no frames, damage, a changing
            image size, times that go back.

    Example:
        >>> with VideoReader("drive.mp4") as video:                           # doctest: +SKIP
        ...     print(video.format.rate, [frame.time for frame in video])
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        check_regular(self.path, ARCHIVE_BYTES)
        self._av = load_av()
        try:
            # Up to PyAV 18 text that is not UTF-8 is an error unless it is replaced; later, never.
            is_strict = int(self._av.__version__.partition(".")[0]) < 19
            replaced = {"metadata_errors": "replace"} if is_strict else {}
            self._container = self._av.open(str(self.path), **replaced)
        except (OSError, self._av.FFmpegError) as error:
            raise self._refusal(error.strerror or str(error)) from error
        try:
            self._begin()
        except BaseException:
            self._container.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._container.close()

    def __iter__(self) -> Iterator[TimedFrame]:
        step = (
            1
            if self.format.rate is None
            else max(1, round(1 / (self.format.rate * self.format.time_base)))
        )
        last: int | None = None
        for index, frame in enumerate(itertools.chain([self._first], self._decoded)):
            time = frame.pts if frame.pts is not None else 0 if last is None else last + step
            if last is not None and time <= last:
                problem = f"frame {index} at {float(time * self.format.time_base):.6f} s, not after the one before"
                raise self._refusal(
                    problem,
                    "rewrite its time stamps, for example with ffmpeg -i IN -vf setpts=N/FR/TB OUT",
                )
            image = self._upright(frame)
            if image.shape[:2] != (self.format.height, self.format.width):
                problem = f"frame {index} is {image.shape[1]}x{image.shape[0]}, the first is {self.format.width}x{self.format.height}"
                raise self._refusal(problem, "cut it where the size changes")
            yield TimedFrame(image, time, frame.duration or step)
            last = time
        # A file that was cut short: fewer frames than it claims, and an end well before that.
        claimed = self.format.frames
        length = self._stream.duration
        if (
            claimed
            and index + 1 < claimed
            and length
            and time + 2 * step < (self._stream.start_time or 0) + length
        ):
            raise self._refusal(f"it stops after frame {index + 1} of {claimed}")

    def _begin(self) -> None:
        if not self._container.streams.video:
            kinds = ", ".join(sorted({stream.type for stream in self._container.streams}))
            raise self._refusal(f"no video stream ({kinds} only)" if kinds else "no streams at all")
        # The track that players choose: neither a cover nor a preview.
        self._stream = self._container.streams.best("video")
        self._stream.thread_type = "AUTO"
        self._decoded = self._decode()
        first = next(self._decoded, None)
        if first is None:
            raise self._refusal("no frames")
        self._first: Any = first
        height, width = self._upright(first).shape[:2]
        turned = (width, height) != (first.width, first.height)
        aspect = Fraction(self._stream.sample_aspect_ratio or 1)
        others = [
            stream for stream in self._container.streams.video if stream.index != self._stream.index
        ]
        tracks = [
            f"video track {stream.index} ({stream.width}x{stream.height})" for stream in others
        ]
        self.format = VideoFormat(
            width=width,
            height=height,
            rate=Fraction(self._stream.average_rate) if self._stream.average_rate else None,
            time_base=Fraction(self._stream.time_base),
            frames=self._stream.frames or None,
            pixel_aspect=1 / aspect if turned else aspect,
            colour=(int(first.colorspace), int(first.color_primaries), int(first.color_trc)),
            left_out=(*tracks, "sound") if self._container.streams.audio else tuple(tracks),
        )

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
        image: U8 = frame.to_ndarray(
            format="rgb24", interpolation=exact_conversion(self._av), threads=1
        )
        return np.ascontiguousarray(self._displayed(frame, image))

    def _displayed(self, frame: Any, image: U8) -> U8:
        """Return an image under the frame's display matrix: quarter turns and mirrors.

        The matrix, of 32 bits fixed point, takes a pixel (x, y) to (a x + c y, b x + d y).
        """
        stated = frame.side_data.get("DISPLAYMATRIX")
        if stated is None:
            return image
        matrix = np.frombuffer(bytes(stated), dtype=np.int32).reshape(3, 3)[:2, :2]
        turn = matrix / max(int(np.abs(matrix).max()), 1)
        (a, b), (c, d) = np.rint(turn).tolist()
        if np.abs(turn - np.rint(turn)).max() > SQUARE or abs(a * d - b * c) != 1:
            raise self._refusal(
                f"a display matrix {turn.round(3).tolist()}, which is neither a quarter turn nor a mirror",
                "rewrite it upright, for example with ffmpeg -i IN OUT",
            )
        if a == 0:
            image, a, d = image.swapaxes(0, 1), c, b
        return image[:: int(d), :: int(a)]

    def _refusal(self, problem: str, do: str = GIVE) -> InputError:
        return InputError(f"{self.path}: {problem}", do)


class VideoWriter:
    """Take frames one by one; use it in a ``with`` statement.

    The file appears under its name once the block ends well; until then, and for good if it fails,
    there is only a temporary file, which is removed. Odd sizes are padded by repeating the last row
    or column, as yuv420p needs even ones.

    Args:
        path: The file.
        time_base: Seconds of one tick of the frames' times.
        rate: Frames per second, for players that ask; times are what counts.
        colour: Matrix, primaries and transfer that the images follow (ITU-T H.273); they are
            stated in the file.
        pixel_aspect: Width of a pixel over its height.
        crf: Quality of the encoder, 0 (lossless in yuv) to 51.
        preset: How long the encoder looks for a smaller file.

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
        preset: str = "veryfast",
    ) -> None:
        self.path = Path(path)
        self.count = 0
        self._time_base, self._colour, self._pixel_aspect = time_base, colour, pixel_aspect
        self._matrix = WRITABLE.get(colour[0], BT709)
        self._size: tuple[int, ...] | None = None
        self._partial = temporary_path(self.path)
        self._av = load_av()
        try:
            self._container = self._av.open(str(self._partial), mode="w", format="mp4")
        except (OSError, self._av.FFmpegError) as error:
            raise self._failure(error) from error
        self._stream = self._container.add_stream(
            "libx264", rate=rate, options={"crf": str(crf), "preset": preset}
        )
        self._stream.pix_fmt = "yuv420p"
        self._stream.time_base = self._stream.codec_context.time_base = time_base
        self._stream.thread_count = (
            1  # the thread budget counts workers and networks, not encoder threads
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error is None and self.count:
                self._container.mux(self._stream.encode())
            if error is None or self.count:
                self._container.close()
            if error is None and not self.count:
                raise InputError(f"{self.path}: no frames", "give at least one frame")
            if error is None:
                self._partial.replace(self.path)
        except (OSError, self._av.FFmpegError) as failure:
            raise self._failure(failure) from (error or failure)
        finally:
            self._partial.unlink(missing_ok=True)

    def write(self, image: U8, time: int, duration: int = 1) -> None:
        """Append one frame ``(H, W, 3)`` uint8 sRGB, shown from ``time`` for ``duration`` ticks."""
        self._size = self._size or image.shape
        if (
            image.dtype != np.uint8
            or image.ndim != 3
            or image.shape[2] != 3
            or image.shape != self._size
        ):
            raise InputError(
                f"{self.path}: frame {self.count}: {image.shape} {image.dtype}, the first is {self._size}",
                "give frames (H, W, 3) uint8 of one size",
            )
        even = np.pad(
            image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge"
        )
        if self.count == 0:
            codec = self._stream.codec_context
            codec.height, codec.width = even.shape[:2]
            matrix, primaries, transfer = self._colour
            codec.colorspace = matrix if matrix in WRITABLE else self._matrix
            codec.color_primaries = primaries
            codec.color_trc = transfer
            if self._pixel_aspect != 1:
                codec.sample_aspect_ratio = self._pixel_aspect
        rgb = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
        frame = rgb.reformat(
            format="yuv420p",
            dst_colorspace=self._matrix,
            interpolation=exact_conversion(self._av),
            threads=1,
        )
        frame.pts, frame.time_base, frame.duration = time, self._time_base, duration
        try:
            self._container.mux(self._stream.encode(frame))
        except (OSError, self._av.FFmpegError) as error:
            raise self._failure(error) from error
        self.count += 1

    def _failure(self, error: Exception) -> InfrastructureError:
        return InfrastructureError(
            f"{self.path}: {error}", "check that the folder exists and has room"
        )


class Video(NamedTuple):
    """Decoded frames ``(N, H, W, 3)`` uint8 sRGB, their times ``(N,)`` in microseconds, and the
    frame rate.
    """

    frames: U8
    t_us: I64
    fps: Fraction


def write_mp4(path: Path | str, frames: Iterable[U8], fps: float | Fraction) -> None:
    """Write frames ``(H, W, 3)`` uint8 sRGB, frame i at exactly i / fps seconds.

    Odd sizes are padded by repeating the last row or column, as yuv420p needs even ones. The file
    appears under its name only once complete.

    Args:
        path: The file.
        frames: All of one size; taken one at a time.
        fps: Frames per second.

    Raises:
        InputError: No frame, frames of changing size or wrong type, or a rate that is not positive.
        InfrastructureError: The disk or the encoder refuses.
    """
    path = Path(path)
    rate = Fraction(fps).limit_denominator(_MAX_DENOMINATOR)
    if rate <= 0:
        raise InputError(f"{path}: {fps} frames per second", "give a positive rate")
    with VideoWriter(path, 1 / rate, rate) as video:
        for index, image in enumerate(frames):
            video.write(image, index)


def read_mp4(path: Path | str) -> Video:
    """Read a whole video; frames of padded odd sizes keep the padding.

    Raises:
        InputError: Missing file, no video or frame rate in it, or damage.
    """
    with VideoReader(path) as video:
        decoded = list(video)
        rate = video.format.rate
        base = video.format.time_base
    if rate is None:
        raise InputError(f"{path}: no frame rate", "give a whole MP4 file")
    t_us = np.array([round(frame.time * base * 1_000_000) for frame in decoded], dtype=np.int64)
    return Video(np.stack([frame.image for frame in decoded]), t_us, rate)
