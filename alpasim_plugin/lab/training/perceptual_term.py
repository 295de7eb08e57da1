"""The perceptual term of the shared rollout: decode one position causally and compare its frames
with decoded clean latents.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import GROUP
from alpasim_plugin.block_fixers.streaming import State
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE

Distance = Callable[[Tensor, Tensor], Tensor]  # frames (F, 3, H, W) in [-1, 1], twice -> (F,)


@dataclass(frozen=True)
class DecodedDistance:
    """Decode position w of the predictions and of the clean latents, and average a distance over
    its frames.

    The decoder state before w has no gradients: truncation distance 1 (paper, App. A.3).

    Args:
        decoder: Frozen.
        distance: Frozen, differentiable in its first argument.
        z_0: ``(B, C, N, H, W)`` clean latents.
        render: ``(B, 3, 1 + 4 (N - 1), 8H, 8W)`` render for a conditioned decoder, or None.
        opacity: ``(B, 1, ...)`` their opacity, or None.
    """

    decoder: TinyVAE
    distance: Distance
    z_0: Tensor
    render: Tensor | None = None
    opacity: Tensor | None = None

    def __call__(self, predicted: Tensor, w: int) -> Tensor:
        """Return the mean distance of position ``w``'s frames; ``predicted`` includes position
        w.
        """
        with torch.no_grad():
            wanted = self._decode(self.z_0, w)
        made = self._decode(predicted, w)
        return self.distance(flatten_frames(made), flatten_frames(wanted)).mean()

    def _decode(self, z: Tensor, w: int) -> Tensor:
        state = None
        end = 0
        if w > 0:
            end = 1 + GROUP * (w - 1)
            with torch.no_grad():
                state = self._part(z[:, :, :w].detach(), None, slice(0, end))[1]
        return self._part(z[:, :, w : w + 1], state, slice(end, 1 + GROUP * w))[0]

    def _part(self, z: Tensor, state: State | None, frames: slice) -> tuple[Tensor, State]:
        render, opacity = (
            None if x is None else x[:, :, frames] for x in (self.render, self.opacity)
        )
        return self.decoder.decode_next(z, state, render=render, opacity=opacity, clamp=False)


def flatten_frames(video: Tensor) -> Tensor:
    """Flatten clips to frames: ``(B, C, T, H, W)`` to ``(B T, C, H, W)``."""
    return video.transpose(1, 2).flatten(0, 1)
