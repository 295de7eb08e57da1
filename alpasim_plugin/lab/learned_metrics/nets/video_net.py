"""The video judge's features: what a 3D convolution network sees in 16 frames of 112x64.

It is trained on clean drives to tell their family, speed, yaw rate, vehicles, map classes and the
order of their frames (the last is what makes it see motion). The 128 numbers before those heads are
the feature vector of the Frechet distances `fd_syn_16` and `fd_syn_clip`. It is not I3D, and the
distances are not FVD.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.types import F32, U8

FRAMES = 16
HEIGHT = 64
WIDTH = 112
FEATURES = 128
CHANGE = 4.0  # weight of the difference to the frame before, which is small beside the frame


class VideoNet(nn.Module):
    """Features of a window of frames.

    Example:
        >>> VideoNet()(torch.zeros(1, 3, 16, 64, 112)).shape
        torch.Size([1, 128])
    """

    def __init__(self, widths: tuple[int, int, int] = (24, 48, 80)) -> None:
        super().__init__()
        one, two, three = widths
        self.patches = nn.Conv3d(6, one, (1, 4, 4), (1, 4, 4))
        self.motion = nn.Conv3d(one + 2, one, (3, 3, 3), (2, 1, 1), 1)
        self.two = nn.Conv3d(one, two, 3, 2, 1)
        self.three = nn.Conv3d(two, three, 3, 2, 1)
        self.four = nn.Conv3d(three, FEATURES, (2, 3, 3), (2, 1, 1), (0, 1, 1))
        self.norms = nn.ModuleList([nn.GroupNorm(4, width) for width in (one, one, two, three)])

    def forward(self, video: Tensor) -> Tensor:
        """Map ``(B, 3, 16, 64, 112)`` in [-1, 1] to ``(B, 128)``."""
        change = F.pad(torch.diff(video, dim=2), (0, 0, 0, 0, 1, 0))
        x = F.leaky_relu(
            self.norms[0](self.patches(torch.cat([video, CHANGE * change], dim=1))), 0.1
        )
        x = torch.cat([x, _places(x)], dim=1)
        for layer, norm in zip(
            (self.motion, self.two, self.three), list(self.norms)[1:], strict=True
        ):
            x = F.leaky_relu(norm(layer(x)), 0.1)
        return F.leaky_relu(self.four(x), 0.1).mean((2, 3, 4))


def _places(x: Tensor) -> Tensor:
    """Return where in the image each cell of ``(B, C, T, H, W)`` lies, ``(B, 2, T, H, W)`` in
    -1..1.

    The mean over the image forgets places, and a drive forward differs from one backward in where
    things move which way.
    """
    b, _, t, h, w = x.shape
    y, u = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    return torch.stack([y, u])[None, :, None].expand(b, 2, t, h, w).to(x)


def window_input(frames: U8) -> F32:
    """Return ``(3, T, 64, 112)`` in [-1, 1] of frames ``(T, H, W, 3)``, averaged over areas; the
    small change of aspect is accepted.
    """
    small = np.stack(
        [cv2.resize(np.asarray(f), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for f in frames]
    )
    return np.asarray(
        np.moveaxis(small, -1, 0).astype(np.float32) / np.float32(127.5) - 1, dtype=np.float32
    )


def window_features(net: VideoNet, frames: U8, stride: int = FRAMES, batch: int = 4) -> F32:
    """Return the features ``(N, 128)`` of the windows of 16 frames of a clip, ``stride`` frames
    apart; none where the clip is shorter.
    """
    starts = range(0, len(frames) - FRAMES + 1, stride)
    small = (
        window_input(frames) if len(starts) else np.zeros((3, 0, HEIGHT, WIDTH), dtype=np.float32)
    )
    out = [np.zeros((0, FEATURES), dtype=np.float32)]
    with torch.inference_mode():
        for at in range(0, len(starts), batch):
            windows = np.stack([small[:, s : s + FRAMES] for s in starts[at : at + batch]])
            out.append(net(torch.from_numpy(windows)).numpy())
    return np.concatenate(out)
