"""Run a fixer over a stream of frames of one camera: any length, constant memory, timed."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from alpasim_plugin.image_metrics import decibels
from alpasim_plugin.types import U8, Fixer, Frame


@dataclass(frozen=True)
class FixedBlock:
    """One block: input, output, and the fixer's time."""

    given: tuple[Frame, ...]
    fixed: tuple[Frame, ...]
    seconds: float


def refine_frames(frames: Iterable[tuple[Frame, U8 | None]], fixer: Fixer) -> Iterator[FixedBlock]:
    """Fix a stream block by block; the last block may be shorter.

    Args:
        frames: Frames of one camera, oldest first, each with its semantic map, or all with None.
        fixer: A session at the start of a rollout.

    Yields:
        Blocks as they are done; only one is held at a time.
    """
    stream, index = iter(frames), 0
    while pairs := list(islice(stream, fixer.blocks.frames(index))):
        given = tuple(frame for frame, _ in pairs)
        maps = tuple(image for _, image in pairs if image is not None)
        begin = time.perf_counter()
        fixed = tuple(fixer.step(given, maps))
        yield FixedBlock(given, fixed, time.perf_counter() - begin)
        index += 1


@dataclass
class Difference:
    """Accumulated difference of two streams of images: mean and largest in grey levels, and PSNR over all values.

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

    def add(self, block: FixedBlock) -> None:
        """Add one block."""
        self.frames += len(block.given)
        self.ms_per_frame.append(block.seconds * 1e3 / len(block.given))
        for given, fixed in zip(block.given, block.fixed, strict=True):
            self.difference.add(given.rgb, fixed.rgb)
            self.events.update(fixed.events)
