"""What the metrics here take: two stacks of frames of one size."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.errors import EvaluatorError
from alpasim_plugin.types import U8


def check_stacks(doing: str, made: U8, truth: U8) -> None:
    """Refuse anything but two equal stacks ``(T, H, W, 3)`` uint8 with at least one frame.

    Raises:
        EvaluatorError: With what was found.
    """
    for name, frames in (("made", made), ("truth", truth)):
        check_stack(doing, name, frames)
    if made.shape != truth.shape:
        raise EvaluatorError(doing, "two videos", f"shapes {made.shape} and {truth.shape}", "give videos of the same frames at one size")


def check_stack(doing: str, name: str, frames: U8) -> None:
    """Refuse anything but ``(T, H, W, 3)`` uint8 with at least one frame.

    Raises:
        EvaluatorError: With what was found.
    """
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not len(frames):
        raise EvaluatorError(doing, f"the video {name!r}", f"{frames.dtype} {frames.shape}", "give (T, H, W, 3) uint8, at least one frame")
