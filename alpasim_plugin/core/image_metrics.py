"""What images are measured by: one definition of PSNR, SSIM and a black image for every stage,
table, report and training log.

SSIM follows Wang et al., IEEE TIP 2004, Eq. 13, in the convention of the 3DGS papers: Gaussian
window 11x11 with sigma 1.5, biased moments, zeros beyond the border, per channel, then the mean
over pixels and channels. Other conventions differ by up to 0.005 on one pair of images.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F32, U8

CAP_DB = 100.0  # of identical images, whose ratio is infinite
WINDOW_PX = 11
SIGMA_PX = 1.5
# Constants of SSIM, for values in 0 to 1.
C1 = 0.01**2
C2 = 0.03**2
# uint8 sRGB value, 0..255: an image is black when no channel of any pixel is above it; AlpaSim's
# img_is_black
BLACK_MAX = 10

Image = npt.NDArray[Any]


def psnr_db(image: Image, truth: Image, peak: float = 255.0) -> float:
    """Return ``10 log10(peak^2 / MSE)``, MSE over all values; at most 100 dB.

    Args:
        image, truth: Arrays of one shape.
        peak: Width of the range of values: 255 for 8 bits, 1 for 0 to 1, 2 for -1 to 1.

    Example:
        >>> black = np.zeros((8, 8, 3), np.uint8)
        >>> round(psnr_db(black + np.uint8(51), black), 4), psnr_db(black, black)
        (13.9794, 100.0)
    """
    mse = float(np.mean(np.square(np.subtract(image, truth, dtype=np.float64))))
    return CAP_DB if mse == 0 else min(CAP_DB, decibels(mse, peak))


def decibels(mse: float, peak: float = 255.0) -> float:
    """Return the PSNR of a mean squared error above 0, without a cap."""
    return 10 * float(np.log10(peak**2 / mse))


def ssim(image: Image, truth: Image, peak: float = 255.0) -> float:
    """Return the mean structural similarity of images ``(H, W, 3)``, 1 for equal ones.

    Example:
        >>> ramp = np.tile(np.arange(0, 240, 10, dtype=np.uint8)[:, None, None], (1, 24, 3))
        >>> round(ssim(ramp, ramp), 6)
        1.0
    """
    a, b = (np.ascontiguousarray(x, dtype=np.float32) / np.float32(peak) for x in (image, truth))
    mu_a = gaussian_blur(a)
    mu_b = gaussian_blur(b)
    mu_ab = mu_a * mu_b
    square_a = mu_a * mu_a
    square_b = mu_b * mu_b
    var_a = gaussian_blur(a * a) - square_a
    var_b = gaussian_blur(b * b) - square_b
    cov = gaussian_blur(a * b) - mu_ab
    value = (2 * mu_ab + C1) * (2 * cov + C2) / ((square_a + square_b + C1) * (var_a + var_b + C2))
    return float(value.mean(dtype=np.float64))


def gaussian_blur(image: F32) -> F32:
    """Return local means ``(H, W, C)`` under SSIM's window."""
    import cv2  # not for those who only ask whether an image is black

    window = cv2.getGaussianKernel(WINDOW_PX, SIGMA_PX, cv2.CV_32F)
    return cv2.sepFilter2D(image, cv2.CV_32F, window, window, borderType=cv2.BORDER_CONSTANT)


def is_black(rgb: U8) -> bool:
    """Return whether every value of ``(H, W, 3)`` pixels is at most `BLACK_MAX`; an image without
    pixels is black.

    Example:
        >>> is_black(np.full((4, 4, 3), 10, np.uint8)), is_black(np.full((4, 4, 3), 11, np.uint8))
        (True, False)
    """
    return int(rgb.max(initial=0)) <= BLACK_MAX
