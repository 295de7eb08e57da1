"""Structural similarity and signal-to-noise ratio of images as torch sees them: any device, differentiable, plain."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW, SIGMA = 11, 1.5  # Wang et al. 2004
C1, C2 = 0.01**2, 0.03**2  # for values 0..1


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean structural similarity of images ``(H, W, 3)`` 0..1; zeros lie beyond the border, as in the published 3DGS code."""
    x, y = a.permute(2, 0, 1), b.permute(2, 0, 1)
    stack = torch.cat([x, y, x * x, y * y, x * y])[:, None]  # (15, 1, H, W)
    kernel = _kernel(a.device, a.dtype)
    pad = WINDOW // 2
    blurred = conv2d(conv2d(stack, kernel[None, None, :, None], padding=(pad, 0)), kernel[None, None, None, :], padding=(0, pad))
    mx, my, mxx, myy, mxy = blurred[:, 0].reshape(5, 3, *a.shape[:2])
    top = (2 * mx * my + C1) * (2 * (mxy - mx * my) + C2)
    bottom = (mx * mx + my * my + C1) * (mxx - mx * mx + myy - my * my + C2)
    mean: Tensor = (top / bottom).mean()
    return mean


def psnr_db(a: Tensor, b: Tensor) -> float:
    """Return the peak signal-to-noise ratio of images 0..1, decibel."""
    return float(-10 * torch.log10((a.detach() - b.detach()).square().mean().clamp(min=1e-12)))


@lru_cache(maxsize=8)
def _kernel(device: torch.device, dtype: torch.dtype) -> Tensor:
    x = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weight = torch.exp(-(x**2) / (2 * SIGMA**2))
    return (weight / weight.sum()).to(device, dtype)
