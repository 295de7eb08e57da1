"""The style judge: is a frame of a clear day, night, fog or snow?

It is trained on clean frames and their targets by fixed formulas (`training/appearance.py`), at
128x72.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.block_fixers.settings import STYLES
from alpasim_plugin.core.types import F32, F64, U8

HEIGHT, WIDTH = 72, 128


class StyleNet(nn.Module):
    """Logits of the styles.

    Example:
        >>> StyleNet()(torch.zeros(1, 3, 72, 128)).shape
        torch.Size([1, 4])
    """

    def __init__(self, widths: tuple[int, int, int] = (16, 32, 48)) -> None:
        super().__init__()
        one, two, three = widths
        self.layers = nn.ModuleList(
            [nn.Conv2d(3, one, 4, 4), nn.Conv2d(one, two, 3, 2, 1), nn.Conv2d(two, three, 3, 2, 1)]
        )
        self.head = nn.Linear(2 * three, len(STYLES))

    def forward(self, image: Tensor) -> Tensor:
        """Map ``(B, 3, 72, 128)`` in [-1, 1] to ``(B, 4)``."""
        x = image
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.1)
        out: Tensor = self.head(torch.cat([x.mean((2, 3)), x.amax((2, 3))], dim=1))
        return out


def style_input(frame: U8) -> F32:
    """Return ``(3, 72, 128)`` in [-1, 1] of a frame ``(H, W, 3)``."""
    small = cv2.resize(np.asarray(frame), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return np.asarray(
        np.moveaxis(small, -1, 0).astype(np.float32) / np.float32(127.5) - 1, dtype=np.float32
    )


def style_probabilities(net: StyleNet, frames: U8, batch: int = 32) -> F64:
    """Return the probabilities ``(T, 4)`` of the styles for frames ``(T, H, W, 3)``."""
    inputs = np.stack([style_input(frame) for frame in frames])
    with torch.inference_mode():
        parts = [
            torch.softmax(net(torch.from_numpy(inputs[i : i + batch])), dim=1)
            for i in range(0, len(inputs), batch)
        ]
    return np.asarray(torch.cat(parts).double().numpy())
