"""Perceptual distance of frames: `perceptual-syn`, and LPIPS where its weights are on disk. Torch is loaded only when one is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from alpasim_plugin.types import F64, U8
from evaluators.video.frames import check_stacks

if TYPE_CHECKING:
    from alpasim_plugin.nets.picture_distance import PictureDistance

BATCH = 8  # frames at a time


def picture_distances(net: PictureDistance, made: U8, truth: U8) -> F64:
    """Return a network's distance of every frame to the true one.

    Args:
        net: From `alpasim_plugin.nets.picture_distance.load_distance`.
        made, truth: ``(T, H, W, 3)``.

    Returns:
        ``(T,)``.

    Raises:
        EvaluatorError: Stacks that do not belong together.
    """
    import torch

    check_stacks("computing a perceptual distance", made, truth)

    def pictures(frames: U8) -> torch.Tensor:
        return torch.from_numpy(np.array(frames)).permute(0, 3, 1, 2).float() / 127.5 - 1

    with torch.inference_mode():
        parts = [net.distance(pictures(made[i : i + BATCH]), pictures(truth[i : i + BATCH])) for i in range(0, len(made), BATCH)]
    return torch.cat(parts).double().numpy()
