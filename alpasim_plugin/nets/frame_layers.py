"""Per-frame layers on videos ``(B, T, H, W, C)``, and the loop over a mix of per-frame and causal layers.

Channels last: norms and 1x1 convolutions act on contiguous vectors, a frame is a contiguous slice, and a CPU's 2D convolutions are fast.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol, Self, runtime_checkable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.nets.streaming_state import StreamingState


@runtime_checkable
class Causal(Protocol):
    """A layer that sees past frames."""

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map the next frames; past frames are read from ``streaming`` and updated there."""


def run_layers(layers: Iterable[nn.Module], x: Tensor, streaming: StreamingState) -> Tensor:
    """Apply layers in sequence; causal layers use the streaming state."""
    for layer in layers:
        x = layer.next(x, streaming) if isinstance(layer, Causal) else layer(x)
    return x


def channels_last(video: Tensor) -> Tensor:
    """Map ``(B, C, T, H, W)`` to contiguous ``(B, T, H, W, C)``."""
    return video.permute(0, 2, 3, 4, 1).contiguous()


def channels_first(x: Tensor) -> Tensor:
    """Undo `channels_last`."""
    return x.permute(0, 4, 1, 2, 3).contiguous()


def split_last(x: Tensor, parts: int) -> Tensor:
    """Map ``(..., parts * C)`` to ``(..., parts, C)``."""
    return x.view(*x.shape[:-1], parts, x.shape[-1] // parts)


def channels_to_frames(x: Tensor, parts: int) -> Tensor:
    """Rearrange ``parts`` groups of channels as consecutive frames: ``(B, T, H, W, parts * C)`` to ``(B, parts * T, H, W, C)``."""
    return split_last(x, parts).movedim(-2, 2).flatten(1, 2)


def conv_frames(x: Tensor, weight: Tensor, bias: Tensor | None, stride: int = 1, padding: int = 0) -> Tensor:
    """Convolve every frame of ``(B, T, H, W, C)`` with a 2D kernel ``(O, C, kh, kw)``."""
    b, t = x.shape[:2]
    out = F.conv2d(x.flatten(0, 1).permute(0, 3, 1, 2), weight.contiguous(memory_format=torch.channels_last), bias, stride, padding)
    out = out.permute(0, 2, 3, 1)
    return out.reshape(b, t, *out.shape[1:])


class Float32Buffers(nn.Module):
    """A module whose buffers stay float32 when the network changes precision (``net.to(torch.bfloat16)``)."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        before = dict(self._buffers)
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        for name, old in before.items():
            new = self._buffers[name]
            if old is not None and new is not None and new.dtype != old.dtype:
                self._buffers[name] = old.to(new.device)
        return self


class FrameConv(nn.Conv2d):
    """3x3 convolution of every frame, zero padding."""

    def __init__(self, inputs: int, outputs: int, bias: bool = True) -> None:
        super().__init__(inputs, outputs, 3, bias=bias)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, H, W, outputs)``."""
        return conv_frames(input, self.weight, self.bias, padding=1)


class DownsampleConv(nn.Conv2d):
    """3x3 convolution with stride 2; zero padding at the bottom and right only."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3, stride=2)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, H/2, W/2, outputs)``."""
        return conv_frames(F.pad(input, (0, 0, 0, 1, 0, 1)), self.weight, self.bias, stride=2)


class UpsampleConv(FrameConv):
    """Repeat every pixel 2x2, then a 3x3 convolution."""

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, 2H, 2W, outputs)``."""
        return super().forward(input.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3))


class PointwiseConv(nn.Module):
    """1x1 convolution whose stored kernel has ``axes`` trailing axes of size 1."""

    def __init__(self, inputs: int, outputs: int, axes: int, bias: bool = True) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(outputs, inputs, *(1,) * axes))
        self.bias = nn.Parameter(torch.zeros(outputs)) if bias else None

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(..., inputs)`` to ``(..., outputs)``."""
        return F.linear(x, self.weight.flatten(1), self.bias)
