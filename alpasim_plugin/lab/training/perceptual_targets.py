"""Target distances of `perceptual-syn`.

Structure is measured by the similarity of gradient magnitudes (Xue et al., "Gradient magnitude
similarity deviation", IEEE TIP 2014, Eq. 4) on three scales, colour by the difference on a coarse
one. These do not depend on the cause of a difference; the kind of distortion is known here, so a
gain per kind weights it: low for small displacements, high for lost thin structure.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from alpasim_plugin.core.types import F32

SIMILAR_C = 170.0 / 255**2  # of the source, for values in 0 to 1
SCALES = (0.4, 0.3, 0.3)  # weights of full, half and quarter resolution
COLOUR_WEIGHT = 0.8
GAINS: Mapping[str, float] = {
    "blur": 4.0,
    "coarse": 4.0,
    "noise": 0.7,
    "stain": 1.0,
    "ghost": 4.0,
    "erase": 5.0,
    "splat": 1.6,
    "colour": 2.0,
    "jpeg": 3.0,
    "sharpen": 2.0,
    "render": 3.0,
}
MOVED_GAIN_PER_PX, MOVED_GAIN_MAX = 0.35, 1.6  # for geometric kinds


def target_distance(reference: F32, damaged: F32, kind: str, displacement_px: float = 0.0) -> float:
    """Return the target distance of two images ``(H, W, 3)`` in 0 to 1, about 0 to 1.

    Args:
        reference, damaged: The images.
        kind: Of the distortion, a key of `GAINS`, or "shift" or "warp".
        displacement_px: Of pixels, for "shift" and "warp".
    """
    gain = (
        GAINS[kind] if kind in GAINS else min(MOVED_GAIN_PER_PX * displacement_px, MOVED_GAIN_MAX)
    )
    return gain * (
        structure_error(reference, damaged) + COLOUR_WEIGHT * colour_error(reference, damaged)
    )


def structure_error(a: F32, b: F32) -> float:
    """Return one minus the similarity of gradient magnitudes of ``(H, W, 3)`` images in 0 to 1, 0
    (equal) to 1.
    """
    x, y = (
        np.ascontiguousarray(image @ np.array([0.299, 0.587, 0.114], dtype=np.float32))
        for image in (a, b)
    )
    total = 0.0
    for scale_weight in SCALES:
        gx, gy = _gradient(x), _gradient(y)
        similar = (2 * gx * gy + SIMILAR_C) / (gx * gx + gy * gy + SIMILAR_C)
        total += scale_weight * float(1 - similar.mean())
        x, y = (
            cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            for image in (x, y)
        )
    return total


def colour_error(a: F32, b: F32) -> float:
    """Return the mean absolute difference of ``(H, W, 3)`` images in 0 to 1 at an eighth of the
    resolution.
    """
    h, w = a.shape[:2]
    small = [
        cv2.resize(image, (max(1, w // 8), max(1, h // 8)), interpolation=cv2.INTER_AREA)
        for image in (a, b)
    ]
    return float(np.abs(small[0] - small[1]).mean())


def _gradient(image: F32) -> F32:
    kernel = np.array([[1, 0, -1]] * 3, dtype=np.float32) / 3
    gx, gy = (
        cv2.filter2D(image, -1, k, borderType=cv2.BORDER_REFLECT_101) for k in (kernel, kernel.T)
    )
    return np.asarray(np.sqrt(gx * gx + gy * gy), dtype=np.float32)
