"""Run a fixer over a stream of frames of one camera: any length, constant memory, timed."""

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from alpasim_plugin.core.image_metrics import decibels
from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.core.types import U8, Frame

UNLIKE = (
    "unlike"  # event of frames that passed through since the fixer does not know this kind of video
)


@dataclass(frozen=True)
class FixedBlock:
    """One block: input, output, the fixer's time, and the least PSNR of what was refused, where
    something was.
    """

    frames: tuple[Frame, ...]
    fixed: tuple[Frame, ...]
    seconds: float
    refused_psnr_db: float | None = None


@dataclass(frozen=True)
class ChangeLimit:
    """How much a fixer may change a frame that was given as reliable, before it is taken not to
    know this kind of video.

    A fixer trained on one kind of image damages others, and says nothing of it. What it should
    repair is marked by a low opacity; a whole video without opacity is declared reliable, so a
    frame that comes out very different is damage.

    Attributes:
        least_psnr_db: A frame changed by more than this passes through unrefined, as do all after
            it.
    """

    least_psnr_db: float = 32.0


def refine_frames(
    frames: Iterable[tuple[Frame, U8 | None]], fixer: Fixer, limit: ChangeLimit | None = None
) -> Iterator[FixedBlock]:
    """Fix a stream block by block; the last block may be shorter.

    Args:
        frames: Frames of one camera, oldest first, each with its semantic map, or all with None.
        fixer: A session at the start of a rollout.
        limit: From the first frame that the fixer changes by more on, the frames pass through as
            they are, with the event `UNLIKE`; None: whatever the fixer makes is taken.

    Yields:
        Blocks as they are done; only one is held at a time.
    """
    stream = iter(frames)
    index = 0
    is_unlike = False
    while pairs := list(islice(stream, fixer.blocks.frames(index))):
        rendered = tuple(frame for frame, _ in pairs)
        maps = tuple(image for _, image in pairs if image is not None)
        begin = time.perf_counter()
        fixed = rendered if is_unlike else tuple(fixer.step(rendered, maps))
        took_s = time.perf_counter() - begin
        refused_psnr_db = None
        if limit is not None and not is_unlike:
            worst = min(_psnr_db(*pair) for pair in zip(rendered, fixed, strict=True))
            is_unlike = worst < limit.least_psnr_db
            refused_psnr_db = worst if is_unlike else None
        fixed = (
            tuple(replace(frame, events=(*frame.events, UNLIKE)) for frame in rendered)
            if is_unlike
            else fixed
        )
        yield FixedBlock(rendered, fixed, took_s, refused_psnr_db)
        index += 1


def _psnr_db(rendered: Frame, fixed: Frame) -> float:
    difference = Difference()
    difference.add(rendered.rgb, fixed.rgb)
    return difference.psnr_db


@dataclass
class Difference:
    """Accumulated difference of two streams of images: mean and largest in grey levels, and PSNR
    over all values.

    Example:
        >>> difference = Difference()
        >>> difference.add(np.zeros((2, 2, 3), np.uint8), np.full((2, 2, 3), 51, np.uint8))
        >>> difference.mean_levels, difference.max_levels, round(difference.psnr_db, 2)
        (51.0, 51, 13.98)
    """

    values: int = 0
    absolute: int = 0
    squared: int = 0
    max_levels: int = 0

    def add(self, a: U8, b: U8) -> None:
        """Add one pair of uint8 images of one shape."""
        levels = np.bincount(np.abs(a.astype(np.int16) - b).ravel(), minlength=256)
        scale = np.arange(256)
        self.values += a.size
        self.absolute += int(levels @ scale)
        self.squared += int(levels @ scale**2)
        self.max_levels = max(self.max_levels, int(np.flatnonzero(levels)[-1]))

    @property
    def mean_levels(self) -> float:
        """Mean absolute difference, grey levels."""
        return self.absolute / self.values

    @property
    def psnr_db(self) -> float:
        """Peak signal-to-noise ratio of all values together; infinite for equal streams."""
        return float("inf") if self.squared == 0 else decibels(self.squared / self.values)


@dataclass
class StreamStats:
    """Statistics of a refined stream: times per frame, difference from the input, guard events."""

    frames: int = 0
    ms_per_frame: list[float] = field(default_factory=list)  # one per block
    difference: Difference = field(default_factory=Difference)
    events: Counter[str] = field(default_factory=Counter)
    refused_psnr_db: float | None = None

    def add(self, block: FixedBlock) -> None:
        """Add one block."""
        self.frames += len(block.frames)
        self.refused_psnr_db = (
            block.refused_psnr_db if self.refused_psnr_db is None else self.refused_psnr_db
        )
        self.ms_per_frame.append(block.seconds * 1e3 / len(block.frames))
        for frame, fixed in zip(block.frames, block.fixed, strict=True):
            self.difference.add(frame.rgb, fixed.rgb)
            self.events.update(fixed.events)
