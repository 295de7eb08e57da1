"""Rain in an image: light lost on the way, ground that is wet, and the drops before the camera."""

from __future__ import annotations

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64

WATER_INDEX = 1.33  # of refraction
FILM_SHARE = 0.15  # of wet ground that is smooth enough for a mirror
LEAST_MM = 1.0  # smaller drops are in the extinction alone
NEAR_M, FAR_M = 0.6, 4.0  # distances of the drops that are drawn
EXPOSURE_S = 0.002
SUBPIXEL_BITS = 4
CLASSES = 6  # of drops by how much they cover


def extinction(rain_mm_per_h: float) -> float:
    """Return the share of light that rain takes away a metre (ITU-R P.1814, 2007, after Carbonneau:
    ``1.076 R^0.67`` dB/km).
    """
    return 1.076 * rain_mm_per_h**0.67 * np.log(10) / 10 / 1000


def wet_albedo(dry: F32) -> F32:
    """Return the albedo of a rough ground under a film of water (Lekner and Dorf, Applied Optics 27,
    1988): light is reflected inside of the film and meets the ground again.
    """
    outside = np.float32(0.066)  # of diffuse light, at the film's upper side
    inside = 1 - (1 - outside) / np.float32(WATER_INDEX**2)
    return (1 - outside) * (1 - inside) * dry / (1 - inside * dry)


def mirrored_share(down: F32) -> F32:
    """Return what wet ground reflects as a mirror does (Schlick, 1994), from the downward part of
    unit rays.
    """
    straight = ((WATER_INDEX - 1) / (WATER_INDEX + 1)) ** 2
    fresnel = straight + (1 - straight) * (1 - np.clip(down, 0, 1)) ** 5
    return np.asarray(FILM_SHARE * fresnel, np.float32)


def streaks(
    shape: tuple[int, int], K: F64, down: F64, rain_mm_per_h: float, rng: np.random.Generator
) -> F32:
    """Return by how much falling drops cover each pixel.

    Sizes follow Marshall and Palmer (1948), speeds Atlas et al. (1973). A drop covers a pixel of
    its path for the share of the exposure in which it is there.

    Args:
        shape: Rows and columns.
        K: ``(3, 3)`` intrinsics, pixels.
        down: ``(3,)`` direction in which drops fall, camera frame.
        rain_mm_per_h: The rate.
        rng: Draws the drops of one frame.

    Returns:
        ``(H, W)``, 0 to 1.
    """
    height, width = shape
    slope_per_mm = 4.1 * rain_mm_per_h**-0.21
    drops_per_m3 = 8000 / slope_per_mm * np.exp(-slope_per_mm * LEAST_MM)
    area = width * height / (K[0, 0] * K[1, 1])  # of the view at 1 m
    count = rng.poisson(drops_per_m3 * area * (FAR_M**3 - NEAR_M**3) / 3)
    z = np.cbrt(rng.uniform(NEAR_M**3, FAR_M**3, count))
    begin = rng.random((count, 2)) * (width, height)
    size_mm = LEAST_MM + rng.exponential(1 / slope_per_mm, count)
    fallen_m = (9.65 - 10.3 * np.exp(-0.6 * size_mm)) * EXPOSURE_S
    focal = K[[0, 1], [0, 1]]
    ray = (begin - K[:2, 2]) / focal
    moved = fallen_m[:, None] * (down[:2] - ray * down[2]) * focal / z[:, None]
    wide = size_mm / 1000 * focal[0] / z
    covered = np.minimum(wide, 1) * np.minimum(size_mm / 1000 / fallen_m, 1)
    lines = np.stack([begin - 0.5, begin - 0.5 + moved], axis=1) * (1 << SUBPIXEL_BITS)
    total = np.zeros(shape, np.float32)
    order = np.argsort(covered)
    for members in np.array_split(order, CLASSES):
        if not len(members):
            continue
        drawn = np.zeros(shape, np.uint8)
        ends = np.rint(lines[members]).astype(np.int32)
        cv2.polylines(drawn, list(ends), False, 255, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        total += drawn * np.float32(covered[members].mean() / 255)
    return np.minimum(total, 1)
