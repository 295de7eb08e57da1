"""Noise for the transparent parts of a render: one random stream per scene, seed, camera, draw and latent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.seeding import stream


def latent_noise(scene_id: str, seed: int, cameras: Sequence[str], draws: int, latents: range, shape: tuple[int, int, int]) -> list[Tensor]:
    """Draw standard normal latents.

    Args:
        scene_id, seed: Key of the rollout.
        cameras: Names of the views in the batch.
        draws: Per latent: one per flow step, and one for a cache write by a forward.
        latents: Absolute indices in the rollout.
        shape: Channels, height and width of a latent.

    Returns:
        Per draw ``(B, C, T, h, w)`` float32, on the CPU so that every device sees the same numbers.
    """

    def one(draw: int, camera: str, index: int) -> np.ndarray:
        return stream(scene_id, seed, f"fixer/{camera}/{draw}", index).standard_normal(shape, np.float32)

    views = [[np.stack([one(draw, camera, i) for i in latents], axis=1) for camera in cameras] for draw in range(draws)]
    return [torch.from_numpy(np.stack(view)) for view in views]
