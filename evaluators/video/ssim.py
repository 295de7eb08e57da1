"""Structural similarity of frames, in the convention of the 3DGS papers.

Window 11x11, Gaussian with sigma 1.5; biased moments; per channel, then the mean over pixels and channels; borders zero padded; C1 = 0.01^2
and C2 = 0.03^2 for values in 0 to 1 (Wang et al., IEEE TIP 2004, Eq. 13). Other conventions differ by up to 0.005 on one pair of pictures.
"""

from __future__ import annotations

import cv2
import numpy as np

from alpasim_plugin.types import F32, F64, U8
from evaluators.video.frames import check_stacks

SIDE, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


def ssim(made: U8, truth: U8) -> F64:
    """Return the mean structural similarity of every frame, 1 for equal ones.

    Args:
        made, truth: ``(T, H, W, 3)``.

    Returns:
        ``(T,)``.

    Raises:
        EvaluatorError: Stacks that do not belong together.

    Example:
        >>> ramp = np.tile(np.arange(0, 240, 10, dtype=np.uint8)[:, None, None], (1, 24, 3))[None]
        >>> round(float(ssim(ramp, ramp)[0]), 6)
        1.0
    """
    check_stacks("computing SSIM", made, truth)
    return np.array([_frame(a.astype(np.float32) / 255, b.astype(np.float32) / 255) for a, b in zip(made, truth, strict=True)])


def _frame(a: F32, b: F32) -> float:
    mu_a, mu_b = _blurred(a), _blurred(b)
    both = mu_a * mu_b
    square_a, square_b = mu_a * mu_a, mu_b * mu_b
    var_a, var_b, cov = _blurred(a * a) - square_a, _blurred(b * b) - square_b, _blurred(a * b) - both
    value = (2 * both + C1) * (2 * cov + C2) / ((square_a + square_b + C1) * (var_a + var_b + C2))
    return float(value.mean(dtype=np.float64))


def _blurred(image: F32) -> F32:
    kernel = cv2.getGaussianKernel(SIDE, SIGMA, cv2.CV_32F)
    return np.asarray(cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT))
