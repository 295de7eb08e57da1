"""The source of a generator in pixels: the render, with noise where nothing was drawn (OneFixer, Eq. 1).

Every value of the noise is a function of rollout, camera, frame, step and pixel.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.core.types import F32, I64, U8

HOLE = 0.5  # opacity below which noise enters the source
ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Steele et al., 2014, SplitMix64)
MIX = ((np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)), (np.uint64(27), np.uint64(0x94D049BB133111EB)))
LAST = np.uint64(31)
CHANNELS = 3


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


def pixel_noise(scene_id: str, seed: int, camera: str, draw: int, frame: int, pixels: I64) -> F32:
    """Draw standard normal values for some pixels of a frame; a pixel's values do not depend on which others are asked for.

    Drawing whole frames would take longer than the network: holes are about one pixel in a hundred.

    Args:
        scene_id, seed, camera: Key of the stream.
        draw: Flow step.
        frame: Index in the rollout, or `content_key`.
        pixels: ``(N,)`` row-major indices in the image.

    Returns:
        ``(N, 3)``.

    Example:
        >>> few, many = (pixel_noise("s", 0, "front", 0, 3, np.array(p)) for p in ([7], [5, 7]))
        >>> bool((few[0] == many[1]).all())
        True
    """
    key = np.uint64(derive_seed(scene_id, seed, f"fixer/{camera}/{draw}", frame))
    index = (pixels[:, None] * CHANNELS + np.arange(CHANNELS)).astype(np.uint64) * np.uint64(2)
    with np.errstate(over="ignore"):  # arithmetic modulo 2^64
        u, v = (_uniform(key + (index + np.uint64(i + 1)) * ODD) for i in range(2))
    normal: F32 = (np.sqrt(-2 * np.log(u)) * np.cos(2 * np.pi * v)).astype(np.float32)  # Box and Muller, 1958
    return normal


def content_key(t_us: int, rgb: U8) -> int:
    """Return a frame's number as its content gives it: the same render at the same time has the same noise in every rollout."""
    return int.from_bytes(hashlib.blake2b(rgb.tobytes(), digest_size=8, salt=t_us.to_bytes(8, "little")).digest(), "little")


def _uniform(x: np.ndarray) -> np.ndarray:
    """Mix 64-bit counters into uniform values in (0, 1]."""
    for shift, factor in MIX:
        x = (x ^ (x >> shift)) * factor
    x = x ^ (x >> LAST)
    return ((x >> np.uint64(11)).astype(np.float64) + 1) * 2.0**-53
