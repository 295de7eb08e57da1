"""Layers that the judges share."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

GROUPS = 4


class ResidualPair(nn.Module):
    """Two normalised convolutions around a skip connection, at one resolution.

    Args:
        channels: In and out.
        first, second: Kernel sizes ``(rows, columns)``, odd.
        dilation: Of the first one, along its rows.
    """

    def __init__(
        self,
        channels: int,
        first: tuple[int, int] = (3, 3),
        second: tuple[int, int] = (3, 3),
        dilation: int = 1,
    ) -> None:
        super().__init__()
        pad = (first[0] // 2 * dilation, first[1] // 2)
        self.norm = nn.GroupNorm(GROUPS, channels)
        self.one = nn.Conv2d(channels, channels, first, padding=pad, dilation=(dilation, 1))
        self.two = nn.Conv2d(channels, channels, second, padding=(second[0] // 2, second[1] // 2))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, C, H, W)`` to the same shape."""
        change: Tensor = self.two(F.leaky_relu(self.one(F.leaky_relu(self.norm(x), 0.1)), 0.1))
        return x + change


def initialise(module: nn.Module, seed: int) -> None:
    """Set convolutions and linear layers after He et al. (2015) from a seed; biases are zero, norms
    the identity.
    """
    generator = torch.Generator().manual_seed(seed)
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Conv3d | nn.Linear):
            fan_in = layer.weight[0].numel()
            with torch.no_grad():
                layer.weight.copy_(
                    torch.randn(layer.weight.shape, generator=generator) * (2.0 / fan_in) ** 0.5
                )
                if layer.bias is not None:
                    layer.bias.zero_()
        if isinstance(layer, ResidualPair):
            with torch.no_grad():
                layer.two.weight.mul_(0.1)  # a block begins near the identity
