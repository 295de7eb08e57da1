"""A folder of PNG pictures in the place of a video: no codec between a frame and what is made of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.types import U8
from alpasim_plugin.io.atomic import atomic_folder, write_bytes
from alpasim_plugin.log.video import UNSPECIFIED, TimedFrame, VideoFormat

PERIOD = Fraction(1, 10)  # seconds from picture to picture: they have no times of their own
WRITING = "writing a folder of pictures"


class PictureFolderReader:
    """Iterate over the ``.png`` files of a folder in order of name; like `log.video.VideoReader`.

    Args:
        path: The folder.
        doing: For messages.

    Raises:
        InputError: No such folder, no picture in it, a picture that cannot be read or is not of 8 bits, or a changing size.
    """

    def __init__(self, path: Path | str, doing: str = "reading a folder of pictures") -> None:
        self.path, self._doing = Path(path), doing
        self.names = tuple(sorted(file.name for file in self.path.glob("*.png")))
        if not self.names:
            raise self._refusal("no .png files", "give a folder of pictures named in order, such as 000000.png")
        height, width = self._read(self.names[0]).shape[:2]
        unstated = (UNSPECIFIED, UNSPECIFIED, UNSPECIFIED)
        self.format = VideoFormat(width, height, None, PERIOD, len(self.names), Fraction(1), unstated, False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        return None

    def __iter__(self) -> Iterator[TimedFrame]:
        for index, name in enumerate(self.names):
            image = self._read(name)
            if image.shape[:2] != (self.format.height, self.format.width):
                found = f"{name} is {image.shape[1]}x{image.shape[0]}, the first is {self.format.width}x{self.format.height}"
                raise self._refusal(found, "give pictures of one size")
            yield TimedFrame(image, index, 1)

    def _read(self, name: str) -> U8:
        image = cv2.imread(str(self.path / name), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise self._refusal(f"{name} is no readable picture", "give complete PNG files")
        if image.dtype != np.uint8:
            raise self._refusal(f"{name} has {8 * image.dtype.itemsize} bits a channel", "give pictures of 8 bits")
        kind = {2: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB}.get(image.ndim if image.ndim == 2 or image.shape[2] == 3 else 0)
        if kind is None:
            raise self._refusal(f"{name} has {image.shape[2]} channels", "give grey or colour pictures without transparency")
        return np.asarray(cv2.cvtColor(image, kind), dtype=np.uint8)

    def _refusal(self, found: str, do: str) -> InputError:
        return InputError(self._doing, str(self.path), found, do)


class PictureFolderWriter:
    """Take frames one by one; the folder appears once the ``with`` block ends well. Like `log.video.VideoWriter`.

    Args:
        path: The folder; replaced if it exists.
        names: File names of the frames; None numbers them.

    Raises:
        InputError: No frame.
        InfrastructureError: The disk refuses.
    """

    def __init__(self, path: Path | str, names: tuple[str, ...] | None = None) -> None:
        self.path, self.count, self._names = Path(path), 0, names
        self._folder: AbstractContextManager[Path] = atomic_folder(self.path, WRITING)
        self._partial = self._folder.__enter__()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None and not self.count:
            error = InputError(WRITING, str(self.path), "no frames", "give at least one frame")
            self._folder.__exit__(type(error), error, None)
            raise error
        self._folder.__exit__(kind, error, trace)

    def write(self, image: U8, time: int, duration: int = 1) -> None:
        """Append one frame ``(H, W, 3)`` uint8 sRGB; a folder keeps no times."""
        del time, duration
        name = f"{self.count:06d}.png" if self._names is None else self._names[self.count]
        done, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        if not done:
            raise InfrastructureError(WRITING, f"{self.path}/{name}", "the encoder refused", "check the picture's size")
        write_bytes(self._partial / name, png.tobytes())
        self.count += 1
