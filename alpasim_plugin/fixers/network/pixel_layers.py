"""Layers of the generator in pixels: cells of pixels as channels, residual blocks, upsampling that
begins as a copy of each pixel.

Images are ``(B, H, W, C)``: 2D convolutions of a CPU are fastest on them, a 1x1 convolution is a
matrix product, and a cell of pixels becomes channels by copying contiguous runs.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SLOPE = 0.1  # of the leaky activation
SMALL = 0.1  # scale of a branch's initial output: the network starts near the identity


def activation(x: Tensor, inplace: bool = False) -> Tensor:
    """Apply the leaky rectifier; ``inplace`` where nothing else reads ``x``."""
    return F.leaky_relu(x, SLOPE, inplace)


def cells(x: Tensor, side: int) -> Tensor:
    """Turn cells of ``side x side`` pixels into channels: ``(B, H, W, C)`` to ``(B, H / side, W /
    side, side * side * C)``.

    Channels are ordered by row, column and channel of the pixel.
    """
    b, h, w, c = x.shape
    parts = x.reshape(b, h // side, side, w // side, side * c)
    return parts.transpose(2, 3).reshape(b, h // side, w // side, side * side * c)


def pixels(x: Tensor, side: int) -> Tensor:
    """Undo `cells`: ``(B, H, W, side * side * C)`` to ``(B, side * H, side * W, C)``."""
    b, h, w, c = x.shape
    parts = x.reshape(b, h, w, side, c // side)
    return parts.transpose(2, 3).reshape(b, h * side, w * side, c // (side * side))


class Conv3(nn.Conv2d):
    """3x3 convolution with zero padding."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3, padding=1)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, H, W, inputs)`` to ``(B, H, W, outputs)``."""
        return super().forward(input.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


class ResidualBlock(nn.Module):
    """``x + conv(act(conv(x)))``, without a norm.

    Args:
        channels: Of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = Conv3(channels, channels)
        self.second = small(Conv3(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, H, W, channels)`` to the same shape."""
        branch: Tensor = self.second(activation(self.first(x), inplace=True))
        return branch.add_(x)


class Downsample(nn.Linear):
    """Halve the resolution: cells of 2x2 pixels through a linear layer.

    Args:
        inputs, outputs: Channels before and after.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(4 * inputs, outputs)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, H, W, inputs)`` to ``(B, H / 2, W / 2, outputs)``."""
        return super().forward(cells(input, 2))


class Upsample(nn.Linear):
    """Double the resolution: a linear layer, then `pixels`.

    The four pixels of a cell start with equal weights (Aitken et al., 2017, ICNR), so that no
    pattern of the cell is there to be unlearned.

    Args:
        inputs, outputs: Channels before and after.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, 4 * outputs)
        repeat_per_pixel(self, 2)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, H, W, inputs)`` to ``(B, 2 H, 2 W, outputs)``."""
        return pixels(super().forward(input), 2)


def small(conv: Conv3) -> Conv3:
    """Scale a convolution's initial weights by `SMALL` and clear its bias."""
    with torch.no_grad():
        conv.weight.mul_(SMALL)
        assert conv.bias is not None
        conv.bias.zero_()
    return conv


def repeat_per_pixel(layer: Conv3 | nn.Linear, side: int) -> None:
    """Give the ``side * side`` pixels that `pixels` makes of a cell equal initial weights."""
    with torch.no_grad():
        assert layer.bias is not None
        for value in (layer.weight, layer.bias):
            value.copy_(
                value[: value.shape[0] // (side * side)].repeat(
                    side * side, *(1,) * (value.ndim - 1)
                )
            )
