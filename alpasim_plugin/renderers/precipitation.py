"""Rain and snow in an image: light lost on the way, what falls before the camera, and ground that is
wet.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64

WATER_INDEX = 1.33  # of refraction
FILM_SHARE = 0.15  # of wet ground that is smooth enough for a mirror
SHELLS_M = (4.0, 3.0, 2.2, 1.6, 1.2, 0.85, 0.6)  # about the camera, of particles that are drawn
SUBPIXEL_BITS = 4  # sixteenths


@dataclass(frozen=True)
class Precipitation:
    """What falls, by its rate R in mm/h of water.

    Attributes:
        name: The environment's key.
        attenuation: ``a, b`` of ``a R^b`` dB/km of light (ITU-R P.1814, 2007).
        density: ``n, p`` of ``n R^p`` particles a cubic metre and millimetre at diameter 0.
        slope: ``s, q`` of ``s R^q``, by which their number falls exponentially with a millimetre of
            the water's diameter.
        size_m: What a particle over 1 mm of water is drawn as.
        fallen_m: How far it falls while a camera exposes, 2 ms.
    """

    name: str
    attenuation: tuple[float, float]
    density: tuple[float, float]
    slope: tuple[float, float]
    size_m: float
    fallen_m: float

    def extinction(self, rate_mm_per_h: float) -> float:
        """Return the share of light that is lost a metre."""
        factor, power = self.attenuation
        return factor * rate_mm_per_h**power * np.log(10) / 10_000

    def covered(
        self, shape: tuple[int, int], K: F64, rate_mm_per_h: float, rng: np.random.Generator
    ) -> F32:
        """Return by how much falling particles cover each pixel of an upright camera ``(H, W)``, 0
        to 1: the mean over the pixel and the exposure.

        Args:
            shape: Rows and columns.
            K: ``(3, 3)`` intrinsics, pixels.
            rate_mm_per_h: Above 0.
            rng: Draws the particles of one frame.
        """
        per_mm = self.slope[0] * rate_mm_per_h ** self.slope[1]
        per_m3 = self.density[0] * rate_mm_per_h ** self.density[1] / per_mm * np.exp(-per_mm)
        area = shape[0] * shape[1] / (K[0, 0] * K[1, 1])  # of the view at 1 m
        cover = np.zeros(shape, dtype=np.float32)
        for far_m, near_m in pairwise(SHELLS_M):
            px_per_m = K[1, 1] * 2 / (far_m + near_m)
            size_px = px_per_m * self.size_m
            fallen_px = px_per_m * self.fallen_m
            share = min(size_px, 1) * min(size_px / max(fallen_px, 1), 1)
            count = rng.poisson(per_m3 * area * (far_m**3 - near_m**3) / 3)
            begin = rng.random((count, 2)) * shape[::-1]
            lines = np.rint(
                16 * np.stack([begin, begin + np.array([0, fallen_px])], axis=1)
            ).astype(np.int32)
            width_px = max(1, int(size_px))
            cv2.polylines(cover, list(lines), False, share, width_px, cv2.LINE_8, SUBPIXEL_BITS)
        return cover


# Drops: Marshall and Palmer, 1948; speed 5.5 m/s (Atlas et al., 1973). Flakes: Gunn and Marshall,
# 1958, dry snow in green light; 1 m/s, the size of an aggregate.
RAIN = Precipitation("rain", (1.076, 0.67), (8000, 0), (4.1, -0.21), 0.0015, 0.011)
SNOW = Precipitation("snow", (5.53, 1.38), (3800, -0.87), (2.55, -0.48), 0.004, 0.002)


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
