"""Cuboid F1: how well the outlines of detected vehicles cover those detected in the reference,
pooled over a clip (paper, App. on metrics).

``P = I / A_made``, ``R = I / A_reference``, ``F1 = 2 P R / (P + R) = 2 I / (A_made +
A_reference)``: a Dice score on pooled areas of filled convex outlines. Boxes with a score below
0.10 or a corner nearer than 0.5 m are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from alpasim_plugin.core.types import F64, Bool
from alpasim_plugin.lab.learned_metrics.types import Cuboid, hull_pixels

LEAST_SCORE = 0.10
KINDS = ("car", "truck", "trailer", "bus", "construction_vehicle")
SUBPIXEL = 4  # bits of an outline's coordinates


def union_mask(cuboids: Sequence[Cuboid], K: F64, size: tuple[int, int]) -> Bool:
    """Return the pixels ``(H, W)`` inside the outline of any counted box."""
    mask = np.zeros(size, dtype=np.uint8)
    for cuboid in cuboids:
        if cuboid.score < LEAST_SCORE or cuboid.label not in KINDS:
            continue
        hull = hull_pixels(cuboid, K)
        if hull is not None:
            # A pixel's middle lies at a half; cv2 counts it at a whole number.
            points = np.clip(np.rint((hull - 0.5) * (1 << SUBPIXEL)), -(1 << 20), 1 << 20).astype(
                np.int32
            )
            cv2.fillConvexPoly(mask, points, 1, cv2.LINE_8, SUBPIXEL)
    return mask.astype(bool)


def cuboid_areas(
    made: Sequence[Sequence[Cuboid]],
    reference: Sequence[Sequence[Cuboid]],
    K: F64,
    size: tuple[int, int],
) -> tuple[int, int, int]:
    """Return the areas of the intersection, of ``made`` and of ``reference``, pixels, summed over
    frames.
    """
    both = a = b = 0
    for one, other in zip(made, reference, strict=True):
        m, r = union_mask(one, K, size), union_mask(other, K, size)
        both = both + int((m & r).sum())
        a = a + int(m.sum())
        b = b + int(r.sum())
    return both, a, b


def cuboid_f1(
    made: Sequence[Sequence[Cuboid]],
    reference: Sequence[Sequence[Cuboid]],
    K: F64,
    size: tuple[int, int],
) -> float | None:
    """Return the F1 of a clip: 0 where only one side has boxes, None where neither has (the clip is
    excluded and counted).

    Args:
        made, reference: Boxes of every frame.
        K: ``(3, 3)`` of the images, pixels.
        size: Height and width of the images.
    """
    both, a, b = cuboid_areas(made, reference, K, size)
    return 2 * both / (a + b) if a + b else None
