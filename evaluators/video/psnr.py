"""Peak signal-to-noise ratio of frames."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.types import F64, U8
from evaluators.video.frames import check_stacks

CAP_DB = 100.0  # of identical frames, whose ratio is infinite


def psnr_db(made: U8, truth: U8) -> F64:
    """Return ``10 log10(1 / MSE)`` of every frame, RGB in 0 to 1, MSE over all pixels and channels; at most 100 dB.

    Args:
        made, truth: ``(T, H, W, 3)``.

    Returns:
        ``(T,)`` dB.

    Raises:
        EvaluatorError: Stacks that do not belong together.

    Example:
        >>> grey = np.zeros((1, 8, 8, 3), np.uint8)
        >>> [round(float(psnr_db(grey + level, grey)[0]), 4) for level in (np.uint8(51), np.uint8(0))]
        [13.9794, 100.0]
    """
    check_stacks("computing PSNR", made, truth)
    mse = np.array([np.mean(np.square(np.subtract(a, b, dtype=np.float64))) for a, b in zip(made, truth, strict=True)]) / 255.0**2
    return -10 * np.log10(np.maximum(mse, 10 ** (-CAP_DB / 10)))


def identical_frames(made: U8, truth: U8) -> int:
    """Return how many frames are equal in every value; their PSNR is the cap, which a mean should not hide."""
    check_stacks("counting identical frames", made, truth)
    return int(np.sum(np.all(made == truth, axis=(1, 2, 3))))
