"""Rain in an image: light lost on the way, ground that is wet, and the drops before the camera."""

from __future__ import annotations

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64

WATER_INDEX = 1.33  # of refraction
FILM_SHARE = 0.15  # of wet ground that is smooth enough for a mirror
NEAR_M, FAR_M = 0.6, 4.0  # distances of the drops that are drawn
# Of a drop: its size, and how far it falls while a camera exposes: 2 ms at 5.5 m/s (Atlas et al.,
# 1973).
DROP_M, FALLEN_M = 0.0015, 0.011
SUBPIXEL_BITS = 4  # sixteenths


def extinction(rain_mm_per_h: float) -> float:
    """Return the share of light that rain takes away a metre (ITU-R P.1814, 2007, after Carbonneau:
    ``1.076 R^0.67`` dB/km).
    """
    return 1.076 * rain_mm_per_h**0.67 * np.log(10) / 10_000


def wet_albedo(dry: F32) -> F32:
    """Return the albedo of a rough ground under a film of water (Lekner and Dorf, Applied Optics 27,
    1988): light is reflected inside of the film and meets the ground again.
    """
    outside = np.float32(0.066)  # of diffuse light, at the film's upper side
    through = (1 - outside) / np.float32(WATER_INDEX**2)
    return (1 - outside) * through * dry / (1 - (1 - through) * dry)


def mirrored_share(down: F32) -> F32:
    """Return what wet ground reflects as a mirror does, from the downward part of unit rays
    (Schlick, 1994, without the 2 % at right angles).
    """
    return FILM_SHARE * (1 - np.clip(down, 0, 1)) ** 5


def streaks(shape: tuple[int, int], K: F64, rain_mm_per_h: float, rng: np.random.Generator) -> F32:
    """Return by how much falling drops cover each pixel of an upright camera ``(H, W)``, 0 to 1.

    There are as many drops above 1 mm as Marshall and Palmer (1948) found. A drop covers a pixel of
    its path for the share of the exposure in which it is there.

    Args:
        shape: Rows and columns.
        K: ``(3, 3)`` intrinsics, pixels.
        rain_mm_per_h: The rate.
        rng: Draws the drops of one frame.
    """
    slope_per_mm = 4.1 * rain_mm_per_h**-0.21
    drops_per_m3 = 8000 / slope_per_mm * np.exp(-slope_per_mm)
    area = shape[0] * shape[1] / (K[0, 0] * K[1, 1])  # of the view at 1 m
    count = rng.poisson(drops_per_m3 * area * FAR_M**3 / 3)
    scale = K[1, 1] / np.maximum(FAR_M * np.cbrt(rng.random(count)), NEAR_M)  # pixels a metre
    begin = rng.random((count, 2)) * shape[::-1]
    end = begin + np.outer(scale * FALLEN_M, [0, 1])
    lines = np.rint(16 * np.stack([begin, end], axis=1)).astype(np.int32)
    drawn = np.zeros(shape, np.float32)
    cv2.polylines(drawn, list(lines), False, 1.0, 1, cv2.LINE_8, SUBPIXEL_BITS)
    return drawn * np.float32(min(1.0, DROP_M * scale.mean()) * DROP_M / FALLEN_M)
