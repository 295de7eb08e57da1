"""Perceptual distance of frames by a network that is handed in: `perceptual-syn`, or LPIPS where
its weights are on disk.

Networks come from `alpasim_plugin.lab.video_metrics.image_distance.load_distance`; torch is loaded
only when one is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.lab.video_metrics.frames import check_stacks

if TYPE_CHECKING:
    from torch import Tensor

BATCH = 8  # frames at a time


class ImageDistance(Protocol):
    """A frozen network that measures the perceptual distance of images."""

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return ``(B,)`` for pictures ``(B, 3, H, W)`` in [-1, 1]."""
        ...


def picture_distances(net: ImageDistance, made: U8, truth: U8) -> F64:
    """Return a network's distance of every frame to the true one.

    Args:
        net: The network.
        made, truth: ``(T, H, W, 3)``.

    Returns:
        ``(T,)``.

    Raises:
        EvaluatorError: Stacks that do not belong together.
    """
    import torch

    check_stacks(made, truth)

    def pictures(frames: U8) -> Tensor:
        return torch.from_numpy(np.array(frames)).permute(0, 3, 1, 2).float() / 127.5 - 1

    with torch.inference_mode():
        parts = [
            net.distance(pictures(made[i : i + BATCH]), pictures(truth[i : i + BATCH]))
            for i in range(0, len(made), BATCH)
        ]
    return np.asarray(torch.cat(parts).double().numpy())
