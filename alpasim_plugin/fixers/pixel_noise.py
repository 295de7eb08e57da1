"""Noise for the transparent pixels of a render: every value is a function of rollout, camera, frame, step and pixel."""

from __future__ import annotations

import hashlib

import numpy as np

from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.core.types import F32, I64, U8

ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Steele et al., 2014, SplitMix64)
MIX = ((np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)), (np.uint64(27), np.uint64(0x94D049BB133111EB)))
LAST = np.uint64(31)
CHANNELS = 3


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
