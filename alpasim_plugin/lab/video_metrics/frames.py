"""PSNR and SSIM of every frame of two stacks of one size."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core import image_metrics
from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import F64, U8


def psnr_db(made: U8, truth: U8) -> F64:
    """Return the PSNR of every frame ``(T,)``, dB, at most 100; stacks ``(T, H, W, 3)``.

    Raises:
        EvaluatorError: Stacks that do not belong together.
    """
    check_stacks(made, truth)
    return np.array([image_metrics.psnr_db(a, b) for a, b in zip(made, truth, strict=True)])


def ssim(made: U8, truth: U8) -> F64:
    """Return the mean structural similarity of every frame ``(T,)``, 1 for equal ones; stacks ``(T,
    H, W, 3)``.

    Raises:
        EvaluatorError: Stacks that do not belong together.
    """
    check_stacks(made, truth)
    return np.array([image_metrics.ssim(a, b) for a, b in zip(made, truth, strict=True)])


def check_stacks(made: U8, truth: U8) -> None:
    """Refuse anything but two equal stacks ``(T, H, W, 3)`` uint8 with at least one frame.

    Raises:
        EvaluatorError: With what was found.
    """
    for name, frames in (("made", made), ("truth", truth)):
        check_stack(name, frames)
    if made.shape != truth.shape:
        raise EvaluatorError(
            f"two videos: shapes {made.shape} and {truth.shape}",
            "give videos of the same frames at one size",
        )


def check_stack(name: str, frames: U8) -> None:
    """Refuse anything but ``(T, H, W, 3)`` uint8 with at least one frame.

    Raises:
        EvaluatorError: With what was found.
    """
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not len(frames):
        raise EvaluatorError(
            f"the video {name!r}: {frames.dtype} {frames.shape}",
            "give (T, H, W, 3) uint8, at least one frame",
        )
