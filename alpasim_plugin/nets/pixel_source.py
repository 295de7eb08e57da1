"""The source of a generator in pixels: the render, with noise where nothing was drawn (OneFixer, Eq. 1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.types import F32, I64

HOLE = 0.5  # opacity below which noise enters the source


def hole_mask(opacity: Tensor) -> Tensor:
    """Return the mask m of Eq. 1, hardened: 1 above half opacity, falling to 0 where nothing is drawn.

    With m = opacity, noise would enter the half of a picture that is nearly opaque, and a small network would have to take it out again.
    """
    return (opacity / HOLE).clamp(max=1)


def pixel_source(render: Tensor, opacity: Tensor, eps: Tensor) -> Tensor:
    """Return z_1 = m r + (1 - m) eps (Eq. 1) for images ``(..., C)`` and an opacity of one channel."""
    m = hole_mask(opacity)
    return m * render + (1 - m) * eps


def sparse_source(render: Tensor, opacity: Tensor, draw: Callable[[int, I64], F32]) -> Tensor:
    """Return `pixel_source` with noise that is drawn only where it has weight.

    Args:
        render: ``(B, H, W, 3)``.
        opacity: ``(B, H, W, 1)``.
        draw: Called per image that has a hole with its place in the batch and row-major indices ``(N,)``; returns ``(N, 3)``.
    """
    source = render
    for b, alpha in enumerate(opacity[..., 0].flatten(1)):
        holes = (alpha < HOLE).nonzero()[:, 0]
        if not len(holes):
            continue
        source = source.clone() if source is render else source
        eps = torch.from_numpy(draw(b, holes.cpu().numpy().astype(np.int64))).to(render.device)
        pixels = source[b].view(-1, render.shape[-1])
        pixels[holes] = pixel_source(pixels[holes], alpha[holes, None], eps)
    return source
