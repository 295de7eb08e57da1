"""Refine a video file or a folder of images: read, fix block by block, write; optionally with
opacity and semantic map.

Only the current block is held in memory. The result is renamed to its final name when it is
complete. A folder of PNG images may stand in the place of a video: no codec between a frame and
what is made of it.
"""

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from fractions import Fraction
from itertools import zip_longest
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.files import natural_order, real
from alpasim_plugin.core.files.atomic import atomic_folder, write_bytes
from alpasim_plugin.core.files.images import read_image
from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.core.types import F32, U8, Frame
from alpasim_plugin.fixers.refine import ChangeLimit, StreamStats, refine_frames
from alpasim_plugin.log.video import UNSPECIFIED, TimedFrame, VideoFormat, VideoReader, VideoWriter

CAMERA = "video"
SAME_RATE = 5e-4  # relative; 29.97 and 30 differ by twice that
PERIOD = Fraction(1, 10)  # seconds from image to image: they have no times of their own
GREY_LEVELS = 40  # channels of an opacity video may differ by this much, because of compression


class ImageFolderReader:
    """Iterate over the ``.png`` files of a folder in natural order of their names; like `log.video.VideoReader`.

    Args:
        path: The folder.

    Raises:
        InputError: No such folder, no image in it, an image that cannot be read or is not of 8
            bits, or a changing size.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        names = (file.name for file in self.path.glob("*.png"))
        self.names = tuple(sorted(names, key=natural_order))
        if not self.names:
            raise self._refusal(
                "no .png files", "give a folder of images named in order, such as 000000.png"
            )
        height, width = self._read(self.names[0]).shape[:2]
        unstated = (UNSPECIFIED, UNSPECIFIED, UNSPECIFIED)
        self.format = VideoFormat(
            width, height, None, PERIOD, len(self.names), Fraction(1), unstated
        )

    def __iter__(self) -> Iterator[TimedFrame]:
        for index, name in enumerate(self.names):
            image = self._read(name)
            if image.shape[:2] != (self.format.height, self.format.width):
                problem = f"{name} is {image.shape[1]}x{image.shape[0]}, the first is {self.format.width}x{self.format.height}"
                raise self._refusal(problem, "give images of one size")
            yield TimedFrame(image, index, 1)

    def _read(self, name: str) -> U8:
        image = read_image(self.path / name, cv2.IMREAD_UNCHANGED)
        if image.dtype != np.uint8:
            raise self._refusal(
                f"{name} has {8 * image.dtype.itemsize} bits a channel", "give images of 8 bits"
            )
        kind = {2: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB}.get(
            image.ndim if image.ndim == 2 or image.shape[2] == 3 else 0
        )
        if kind is None:
            raise self._refusal(
                f"{name} has {image.shape[2]} channels",
                "give grey or colour images without transparency",
            )
        return cv2.cvtColor(image, kind)

    def _refusal(self, problem: str, do: str) -> InputError:
        return InputError(f"{self.path}: {problem}", do)


class ImageFolderWriter:
    """Take frames one by one; the folder appears once the ``with`` block ends well. Like
    `log.video.VideoWriter`.

    Args:
        path: The folder; replaced if it exists.
        names: File names of the frames; None numbers them.

    Raises:
        InputError: No frame.
        InfrastructureError: The disk refuses.
    """

    def __init__(self, path: Path | str, names: tuple[str, ...] | None = None) -> None:
        self.path, self.count, self._names = Path(path), 0, names
        self._folder: AbstractContextManager[Path] = atomic_folder(self.path)
        self._partial = self._folder.__enter__()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None and not self.count:
            error = InputError(f"{self.path}: no frames", "give at least one frame")
            self._folder.__exit__(type(error), error, None)
            raise error
        self._folder.__exit__(kind, error, trace)

    def write(self, image: U8, time: int, duration: int = 1) -> None:
        """Append one frame ``(H, W, 3)`` uint8 sRGB; a folder keeps no times."""
        del time, duration
        name = f"{self.count:06d}.png" if self._names is None else self._names[self.count]
        done, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        if not done:
            raise InfrastructureError(
                f"{self.path}/{name}: the encoder refused", "check the image's size"
            )
        write_bytes(self._partial / name, png.tobytes())
        self.count += 1


Reader = VideoReader | ImageFolderReader
Writer = VideoWriter | ImageFolderWriter


@dataclass(frozen=True)
class RefineFiles:
    """The files of a refinement.

    Attributes:
        source: The video, or a folder of PNG.
        out: The refined video (MP4), or a folder of PNG where the name has no suffix.
        opacity: Like the source, grey, white where it is reliable; None is opaque everywhere.
        sdmap: Like the source, the semantic map; None is no map.
        compare: Also write source and result side by side here.
        overwrite: Whether existing results may be replaced.
    """

    source: Path
    out: Path
    opacity: Path | None = None
    sdmap: Path | None = None
    compare: Path | None = None
    overwrite: bool = False

    @property
    def inputs(self) -> dict[str, Path]:
        """Give the files to read, by role."""
        named = {"input": self.source, "opacity": self.opacity, "sdmap": self.sdmap}
        return {role: path for role, path in named.items() if path is not None}

    @property
    def results(self) -> dict[str, Path]:
        """Give the files to write, by role."""
        named = {"output": self.out, "compare": self.compare}
        return {role: path for role, path in named.items() if path is not None}


@dataclass(frozen=True)
class RefineSummary:
    """Statistics of a refined video.

    Attributes:
        fixer: The fixer's label.
        trained: Whether its weights were learned.
        frames, width, height: Of the video; odd sizes are padded by one row or column in the file.
        fps: Average frame rate, None where the source states none.
        ms_per_frame_p50, ms_per_frame_p95: Fixer only, over blocks; without the first block where
            there are more.
        ms_per_frame_first: Of the first block.
        wall_s: Total time, files included.
        psnr_db: Result against source, None where they are equal; before the file's compression.
        mean_levels, max_levels: Their absolute difference in grey levels.
        events: Number of frames that a guard replaced by the unrefined ones, by event.
        refused_psnr_db: Where the fixer changed a frame beyond the limit, that frame's PSNR against
            the source; from there on the source's frames were written as they are.
        left_out: What the source holds besides, such as sound; the result has none of it.
    """

    fixer: str
    trained: bool
    frames: int
    width: int
    height: int
    fps: float | None
    ms_per_frame_p50: float
    ms_per_frame_p95: float
    ms_per_frame_first: float
    wall_s: float
    psnr_db: float | None
    mean_levels: float
    max_levels: int
    events: Mapping[str, int]
    refused_psnr_db: float | None
    left_out: tuple[str, ...]


def refine_video(
    files: RefineFiles,
    make_fixer: Callable[[], Fixer],
    on_frames: Callable[[int, int | None], None] | None = None,
    limit: ChangeLimit | None = None,
) -> RefineSummary:
    """Refine a video file.

    Args:
        files: The files to read and write.
        make_fixer: Creates the fixer's session; called after the files are checked.
        on_frames: Called after every block with the frames done and the number that the container
            states.
        limit: How much the fixer may change a frame; beyond it this and all later frames pass
            through as they are.

    Raises:
        InputError: Files that cannot be read or do not match, or results that exist already.
        InfrastructureError: The disk or the encoder fails.
    """
    check_names(files)
    begin = time.perf_counter()
    stats = StreamStats()
    with ExitStack() as stack:
        readers: dict[str, Reader] = {}
        for role, path in files.inputs.items():
            if os.path.isdir(path):
                readers[role] = ImageFolderReader(path)
            else:
                readers[role] = stack.enter_context(VideoReader(path))
        check_formats(readers)
        source = readers["input"].format
        fixer = make_fixer()
        writers: dict[str, Writer] = {}
        for role, path in files.results.items():
            writers[role] = _writer(path, readers["input"])
            stack.enter_context(writers[role])
        timing: list[TimedFrame] = []  # of the current block
        for block in refine_frames(_joined(readers, timing), fixer, limit):
            for timed, source_frame, fixed in zip(timing, block.frames, block.fixed, strict=True):
                writers["output"].write(fixed.rgb, timed.time, timed.duration)
                if "compare" in writers:
                    writers["compare"].write(
                        np.concatenate([source_frame.rgb, fixed.rgb], axis=1),
                        timed.time,
                        timed.duration,
                    )
            timing.clear()
            stats.add(block)
            if on_frames is not None:
                on_frames(stats.frames, source.frames)
    return _summary(fixer, source, stats, time.perf_counter() - begin)


def _summary(fixer: Fixer, source: VideoFormat, stats: StreamStats, wall_s: float) -> RefineSummary:
    later = stats.ms_per_frame[1:] or stats.ms_per_frame
    difference = stats.difference
    return RefineSummary(
        fixer=fixer.label,
        trained=fixer.trained,
        frames=stats.frames,
        width=source.width,
        height=source.height,
        fps=None if source.rate is None else float(source.rate),
        ms_per_frame_p50=float(np.median(later)),
        ms_per_frame_p95=float(np.percentile(later, 95)),
        ms_per_frame_first=stats.ms_per_frame[0],
        wall_s=wall_s,
        psnr_db=difference.psnr_db if difference.squared else None,
        mean_levels=difference.mean_levels,
        max_levels=difference.max_levels,
        events=dict(stats.events),
        refused_psnr_db=stats.refused_psnr_db,
        left_out=source.left_out,
    )


def check_names(files: RefineFiles) -> None:
    """Refuse results that exist, that are inputs or that share one path, and missing folders.

    Raises:
        InputError: Naming the option.
    """
    resolved = {real(path): role for role, path in files.inputs.items()}
    for role, path in files.results.items():
        taken = resolved.get(real(path))
        if taken is not None:
            raise InputError(
                f"{path}: the {role} would be written over the {taken}",
                "give the result a name of its own",
            )
        resolved[real(path)] = role
        if not os.path.isdir(path.parent):
            raise InputError(f"{path}: no folder {path.parent}", "make it first")
        if path.suffix.lower() not in ("", ".mp4"):
            raise InputError(
                f"{path}: suffix {path.suffix!r} of the {role}",
                "results are MP4 files or folders of PNG: name it .mp4, or without a suffix",
            )
        if os.path.isdir(path) and (
            path.suffix or any(file.suffix != ".png" for file in path.iterdir())
        ):
            raise InputError(
                f"{path}: the {role} is a folder with other things than images",
                "name a new folder or file",
            )
        if os.path.exists(path) and not files.overwrite:
            raise InputError(
                f"{path}: the {role} exists already",
                "choose another name, or pass --overwrite",
            )


def _writer(path: Path, source: Reader) -> Writer:
    if not path.suffix:
        return ImageFolderWriter(
            path, source.names if isinstance(source, ImageFolderReader) else None
        )
    stated = source.format
    return VideoWriter(
        path,
        stated.time_base,
        stated.rate or 1 / stated.time_base,
        stated.colour,
        stated.pixel_aspect,
    )


def check_formats(readers: Mapping[str, Reader]) -> None:
    """Refuse opacity and maps of another form, size, frame rate or stated number of frames than the
    source's.

    Raises:
        InputError: With both values.
    """
    source = readers["input"].format
    for role, reader in readers.items():
        role_format = reader.format
        if type(reader) is not type(readers["input"]):
            raise InputError(
                f"{reader.path}: the {role} is a {_form(reader)}, the input a {_form(readers['input'])}",
                "give both as videos, or both as folders of PNG",
            )
        if (role_format.width, role_format.height) != (source.width, source.height):
            raise InputError(
                f"{reader.path}: the {role} is {role_format.width}x{role_format.height}, the input {source.width}x{source.height}",
                "give both at one size",
            )
        if role_format.frames and source.frames and role_format.frames != source.frames:
            raise _lengths_differ(
                role, reader.path, f"{role_format.frames} frames, the input {source.frames}"
            )
        several = (source.frames or 2) > 1  # a single frame has no rate
        if (
            several
            and role_format.rate
            and source.rate
            and abs(role_format.rate / source.rate - 1) > SAME_RATE
        ):
            raise InputError(
                f"{reader.path}: the {role} has {float(role_format.rate):.3f} frames per second, the input {float(source.rate):.3f}",
                "give both at one frame rate",
            )


def _form(reader: Reader) -> str:
    return "folder" if isinstance(reader, ImageFolderReader) else "video"


def _joined(
    readers: Mapping[str, Reader], timing: list[TimedFrame]
) -> Iterator[tuple[Frame, U8 | None]]:
    """Yield the source's frames with opacity and map, and append their times to ``timing``."""
    roles = list(readers)
    starts: list[Fraction] = []
    for index, row in enumerate(zip_longest(*readers.values())):
        ended = [role for role, timed in zip(roles, row, strict=True) if timed is None]
        if ended:
            going = [role for role in roles if role not in ended]
            raise _lengths_differ(
                ended[0], readers[ended[0]].path, f"{index} frames, the {going[0]} more"
            )
        times = [
            timed.time * reader.format.time_base
            for timed, reader in zip(row, readers.values(), strict=True)
        ]
        starts = starts or times
        times_s = dict(
            zip(roles, [t - start for t, start in zip(times, starts, strict=True)], strict=True)
        )
        rate = readers["input"].format.rate
        for role, time_s in times_s.items():
            if rate and abs(time_s - times_s["input"]) > 1 / (2 * rate):
                raise InputError(
                    f"{readers[role].path}: frame {index} of the {role} comes {float(time_s):.3f} s after its first, the input's {float(times_s['input']):.3f} s",
                    "give videos of the same frames at the same times",
                )
        frames_by_role = dict(zip(roles, row, strict=True))
        timed = frames_by_role["input"]
        timing.append(timed)
        alpha = None
        if "opacity" in frames_by_role:
            alpha = _alpha(frames_by_role["opacity"].image, index, readers["opacity"].path)
        sdmap = frames_by_role["sdmap"].image if "sdmap" in frames_by_role else None
        yield Frame(round(times[0] * 1_000_000), CAMERA, timed.image, alpha), sdmap


def _alpha(image: U8, index: int, path: Path) -> F32:
    """Return the opacity ``(H, W)`` in [0, 1] of a grey image.

    Raises:
        InputError: The image is coloured.
    """
    sample = image[::8, ::8].astype(np.int16)
    if int((sample.max(axis=2) - sample.min(axis=2)).max()) > GREY_LEVELS:
        raise InputError(
            f"{path}: frame {index} of the opacity is coloured",
            "give the accumulated opacity as a grey video, white where the input is reliable",
        )
    return image[..., 1].astype(np.float32) / np.float32(255)


def _lengths_differ(role: str, path: Path, counts: str) -> InputError:
    return InputError(f"{path}: the {role} has {counts}", "give videos of the same frames")
