"""Damage of a recorded video by lost resolution: blur, cells of few pixels, and holes. Milder than
splats, so more of it can be repaired.

A reconstruction far from its training views is out of focus in one place and made of large splats
in another; what never was seen is transparent. All of it stays in place during an episode, as a
fault of the reconstruction would for a camera that stands still.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.types import F32

BLUR_PX = (0.6, 3.0)
CELLS_PX = (2, 4)
HOLES = (0, 3)
RADIUS_PX = (4.0, 18.0)
STRETCH = (0.6, 2.0)
PATCH_PX = 12  # size of the patches that are blurred or made of cells
DEPTH = 0.9  # transparency in the middle of a hole


@dataclass(frozen=True)
class LostResolution:
    """What is lost, in crops of one size.

    Attributes:
        blur_px: Standard deviation of the blur.
        cell_px: Side of the cells.
        blurred: ``(h, w)`` in [0, 1], the share of the blur; the rest is cells.
        opacity: ``(h, w)`` in [0, 1].
    """

    blur_px: float
    cell_px: int
    blurred: F32
    opacity: F32

    def apply(self, frames: F32) -> F32:
        """Return frames ``(T, 3, h, w)`` in [-1, 1], damaged; black shows through the holes."""
        height, width = self.opacity.shape
        coarse = (max(width // self.cell_px, 1), max(height // self.cell_px, 1))
        # In C order, whatever the frames' own is: the loop writes into a view of it
        out = np.empty(frames.shape, dtype=frames.dtype)
        for image, made in zip(
            frames.reshape(-1, height, width), out.reshape(-1, height, width), strict=True
        ):
            soft = cv2.GaussianBlur(image, (0, 0), self.blur_px)
            cells = cv2.resize(
                cv2.resize(image, coarse, interpolation=cv2.INTER_AREA), (width, height)
            )
            made[:] = (soft * self.blurred + cells * (1 - self.blurred) + 1) * self.opacity - 1
        return out


def draw_lost_resolution(rng: np.random.Generator, height: int, width: int) -> LostResolution:
    """Draw a damage for crops of ``height`` x ``width`` pixels."""
    patches = rng.random((max(height // PATCH_PX, 1), max(width // PATCH_PX, 1)), np.float32)
    blurred = cv2.GaussianBlur(cv2.resize(patches, (width, height)), (0, 0), PATCH_PX / 3)
    opacity = np.ones((height, width), dtype=np.float32)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    for _ in range(int(rng.integers(HOLES[0], HOLES[1] + 1))):
        radius = rng.uniform(*RADIUS_PX)
        stretch = rng.uniform(*STRETCH)
        distance = ((y - rng.uniform(0, height)) / radius) ** 2 + (
            (x - rng.uniform(0, width)) / (radius * stretch)
        ) ** 2
        opacity *= 1 - np.float32(DEPTH) * np.exp(-distance)
    cell_px = int(rng.integers(CELLS_PX[0], CELLS_PX[1] + 1))
    return LostResolution(
        float(rng.uniform(*BLUR_PX)), cell_px, blurred, opacity.astype(np.float32)
    )
