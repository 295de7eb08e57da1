"""Soft cut-outs: GSFix3D's augmentation, which hides parts of the render that the network then has
to find.
"""

from __future__ import annotations

import cv2
import numpy as np
from torch import Tensor

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.types import F32

CHANCE = 0.3  # of each of two cut-outs
LARGEST = 0.1  # share of the image that one covers, before its edge is blurred
SIGMA_PX = 10.0  # of the blurred edge


def cut_out(rng: np.random.Generator, render: Tensor, tries: int = 2) -> Tensor:
    """Turn soft-edged parts of images black: ``tries`` times with probability 0.3 each.

    Args:
        rng: Source of the draws.
        render: ``(B, 3, T, H, W)`` in [-1, 1]; a sample's frames lose the same parts.
        tries: Cut-outs at most.

    Returns:
        Like ``render``.
    """
    height, width = render.shape[-2:]
    keep = np.ones((len(render), height, width), dtype=np.float32)
    for image_weight in keep:
        for _ in range(tries):
            if rng.random() < CHANCE:
                image_weight *= 1 - soft_mask(rng, height, width)
    return (render + 1) * upload(keep, render.device)[:, None, None] - 1


def soft_mask(rng: np.random.Generator, height: int, width: int) -> F32:
    """Draw an ellipse of at most a tenth of the image ``(H, W)``, 1 inside, with an edge blurred by
    10 pixels.
    """
    area = float(rng.uniform(0, LARGEST)) * height * width
    aspect = float(np.exp(rng.uniform(-1, 1)))
    axes = np.sqrt(area * aspect / np.pi), np.sqrt(area / aspect / np.pi)
    centre = float(rng.uniform(0, width)), float(rng.uniform(0, height))
    mask = np.zeros((height, width), dtype=np.float32)
    cv2.ellipse(
        mask,
        (centre, (2 * float(axes[0]), 2 * float(axes[1])), float(rng.uniform(0, 180))),
        1.0,
        -1,
    )
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), SIGMA_PX), dtype=np.float32)
