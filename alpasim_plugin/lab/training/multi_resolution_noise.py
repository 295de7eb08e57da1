"""Noise with structure at several scales (Marigold's annealed multi-resolution noise), for latents.

    n = w_0 + sum_i s^i up(w_i),   w_i white of size / r^i,   s = strength t,   divided by its standard deviation

At t = 0 it is white; towards t = 1 large scales are added, so that a network has to find a latent's
mean, which white noise leaves visible.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

STRENGTH = 0.9
RATIOS = (2.0, 4.0)  # r is uniform between


def multi_resolution_noise(
    rng: np.random.Generator,
    shape: tuple[int, int, int, int, int],
    t: Tensor,
    strength: float = STRENGTH,
) -> Tensor:
    """Draw noise of unit variance for every sample.

    Args:
        rng: Source of all draws.
        shape: ``(B, C, T, H, W)``.
        t: ``(B,)``, times 0 to 1.
        strength: Share of the next scale at t = 1.

    Returns:
        ``shape``, float32.
    """
    return torch.stack([_one(rng, shape[1:], strength * float(time)) for time in t])


def _one(rng: np.random.Generator, shape: tuple[int, int, int, int], share: float) -> Tensor:
    c, frames, height, width = shape
    ratio = float(rng.uniform(*RATIOS))
    noise = torch.zeros(c, frames, height, width)
    for i in range(int(np.log(max(height, width)) / np.log(RATIOS[0])) + 1):
        size = max(int(height / ratio**i), 1), max(int(width / ratio**i), 1)
        white = torch.from_numpy(rng.standard_normal((c, frames, *size), dtype=np.float32))
        noise += share**i * F.interpolate(
            white, size=(height, width), mode="bilinear", align_corners=False
        )
        if 1 in size:
            break
    return noise / noise.std()
