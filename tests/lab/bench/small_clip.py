"""A small driving-like clip, for tests of measuring."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.block_fixers.whole_clip import Clip


def driving_clip(frames: int, width: int = 64, height: int = 48) -> Clip:
    """Return a textured plane that moves, with a hole, and a map with two lines."""
    rng = np.random.default_rng(0)
    wall = np.repeat(np.repeat(rng.integers(30, 220, (height // 4, width // 2, 3)), 4, 0), 4, 1)
    rgb = np.stack([wall[:, i % width : i % width + width] for i in range(frames)]).astype(np.uint8)
    alpha = np.ones(rgb.shape[:3], np.float32)
    alpha[:, height // 4 : height // 2, width // 4 : width // 2] = 0.3
    maps = np.zeros_like(rgb)
    maps[:, :, width // 3] = (255, 255, 255)
    maps[:, :, 2 * width // 3] = (255, 0, 255)
    return Clip("front", np.arange(frames, dtype=np.int64) * 100_000, rgb, alpha, maps)
