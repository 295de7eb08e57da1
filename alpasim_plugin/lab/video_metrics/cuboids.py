"""Cuboid F1: how much of the image vehicles cover in a video and in the true one, by the same
detector: ``2 P R / (P + R)`` with ``P = I / A_made`` and ``R = I / A_true``, areas and intersection
summed over a clip (the paper's appendix on metrics). An overlap of projected masks, not of boxes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.types import F64, I64, U8, Bool
from alpasim_plugin.fixers.semantic_map.style import BOX_COLOURS
from alpasim_plugin.lab.video_metrics.road import faces_of_boxes, is_marking

FOCAL_PX = 1266.42  # of the front camera that the published detector was trained with
SCORE = 0.10
VEHICLES = (0, 1, 2, 3, 4)  # car, truck, trailer, bus, construction vehicle
NEAREST_M = 0.5
OFF = 4.0  # of a pixel from the colours of a box, levels
OFF_SHARE = 0.06  # further, as a share of the pixel's length
DRAWN = ("car", "truck")  # classes of the semantic map that are vehicles


@dataclass(frozen=True)
class Boxes:
    """What a detector finds in a frame.

    Attributes:
        boxes: ``(N, 7)``, camera axes (`detectors`).
        scores: ``(N,)``.
        labels: ``(N,)``.
        K: ``(3, 3)``, pixels of the image that was searched.
        size: Its height and width, pixels.
    """

    boxes: F64
    scores: F64
    labels: I64
    K: F64
    size: tuple[int, int]

    def mask(self) -> Bool:
        """Return the pixels that vehicles cover ``(H, W)``: the hulls of their projected corners."""
        canvas = np.zeros(self.size, dtype=np.uint8)
        chosen = (self.scores >= SCORE) & np.isin(self.labels, VEHICLES)
        for box in self.boxes[chosen]:
            corners = corners_of(box)
            if corners[:, 2].min() < NEAREST_M:
                continue
            pixels = corners @ self.K.T
            outline = np.rint(pixels[:, :2] / pixels[:, 2:]).astype(np.int32)
            cv2.fillConvexPoly(canvas, cv2.convexHull(outline), 1)
        return canvas.astype(bool)


def corners_of(box: F64) -> F64:
    """Return the corners ``(8, 3)`` of a box ``(7,)``, metres, camera axes.

    Example:
        >>> corners_of(np.array([0.0, 0.0, 10.0, 4.0, 1.5, 2.0, 0.0])).min(axis=0).tolist()
        [-2.0, -0.75, 9.0]
    """
    middle, (length, height, width), yaw = box[:3], box[3:6], box[6]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    x, y, z = (signs * np.array([length, height, width]) / 2).T
    turned = [x * np.cos(yaw) + z * np.sin(yaw), y, z * np.cos(yaw) - x * np.sin(yaw)]
    return np.asarray(middle + np.stack(turned, axis=-1))


@dataclass(frozen=True)
class Overlap:
    """Areas of masks summed over a clip, pixels."""

    intersection: int
    made: int
    true: int

    @property
    def f1(self) -> float | None:
        """``2 I / (A_made + A_true)``; None where neither has any."""
        return 2 * self.intersection / (self.made + self.true) if self.made + self.true else None

    @property
    def precision(self) -> float | None:
        """``I / A_made``; None where nothing was found."""
        return self.intersection / self.made if self.made else None

    @property
    def recall(self) -> float | None:
        """``I / A_true``; None where there is nothing to find."""
        return self.intersection / self.true if self.true else None


def overlap(made: Iterable[Bool], true: Iterable[Bool]) -> Overlap:
    """Sum areas and intersections of masks ``(H, W)``, frame by frame."""
    intersection = area_made = area_true = 0
    for a, b in zip(made, true, strict=True):
        intersection += int((a & b).sum())
        area_made += int(a.sum())
        area_true += int(b.sum())
    return Overlap(intersection, area_made, area_true)


def drawn_vehicles(sdmap: U8, size: tuple[int, int]) -> Bool:
    """Return the pixels of a semantic map ``(H, W, 3)`` on which vehicles are drawn, scaled to
    another height and width.

    A box has a non-negative mixture of its front and back colour, darker with distance.
    """
    pixels = sdmap.astype(np.float32)
    length = np.linalg.norm(pixels, axis=-1)
    mask = np.zeros(sdmap.shape[:2], dtype=bool)
    for name in DRAWN:
        colours = np.array(BOX_COLOURS[name], dtype=np.float32)  # (2, 3)
        shares = pixels @ np.linalg.pinv(colours)
        small = OFF / np.linalg.norm(colours[0])  # rounding may make a zero share slightly negative
        off = np.linalg.norm(pixels - shares @ colours, axis=-1)
        mask |= (shares >= -small).all(axis=-1) & (off <= OFF + OFF_SHARE * length) & (length > 0)
    # Untyped lane lines have nearly the colour of a car, and are as narrow as no near one
    mask &= faces_of_boxes(sdmap) | ~is_marking(sdmap)
    height, width = size
    scaled = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(scaled, dtype=bool)
