"""How far a render can be trusted where its renderer does not say: an upstream's images come without opacity.

The fixer reads opacity as trust: from 0.98 on an opaque pixel is kept against a large change without support, below 0.9 the generator is
free, below 0.5 noise enters. So the estimate of a whole frame falls linearly from 1 to `FAR` while the rig moves away from the recorded
path, from `NEAR_M` to `FAR_M` (a reconstruction knows what the recording saw), and a mask lowers it further where it is dark:

    opacity(pixel) = min(path(distance), mask(pixel) / 255)
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import project
from alpasim_plugin.core.types import F32, F64, U8
from alpasim_plugin.io.reading.images import read_image

NEAR_M, FAR_M = 0.25, 3.0  # distance from the recorded path where trust begins to fall, and where it has fallen
FAR = 0.6  # above 0.5: a hole is never invented
DOING = "estimating the reliability of an upstream's frame"


def path_reliability(path_xy: F64, xy: F64) -> float:
    """Return the trust in a frame seen from ``xy`` ``(2,)`` beside the recorded path ``(N, 2)``, metres.

    Example:
        >>> path = np.array([[0.0, 0.0], [100.0, 0.0]])
        >>> [round(path_reliability(path, np.array([50.0, y])), 3) for y in (0.1, 1.625, -9.0)]
        [1.0, 0.8, 0.6]
    """
    away = abs(project(path_xy, xy)[1])
    share = min(max((away - NEAR_M) / (FAR_M - NEAR_M), 0.0), 1.0)
    return 1.0 - share * (1.0 - FAR)


def read_masks(named: Mapping[str, Path]) -> dict[str, U8]:
    """Read grey masks ``(H, W)`` by camera: 255 is trusted.

    Raises:
        InputError: A file that is no picture.
    """
    return {camera: np.asarray(read_image(path, DOING, flag=cv2.IMREAD_GRAYSCALE)) for camera, path in named.items()}


def opacity(trust: float, mask: U8 | None, height: int, width: int) -> F32:
    """Return the opacity ``(H, W)`` that stands for a frame's trust."""
    if not 0.0 <= trust <= 1.0:
        raise InputError(DOING, "the reliability", f"{trust}", "give a number from 0 to 1")
    out = np.full((height, width), trust, dtype=np.float32)
    if mask is not None:
        out = np.minimum(out, cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0)
    return out
