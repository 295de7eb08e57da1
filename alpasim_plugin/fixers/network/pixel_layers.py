"""Layers of a generator in pixels: cells of pixels as channels, residual blocks, upsampling that
begins as a copy of each pixel.

Images are ``(B, H, W, C)``: 2D convolutions of a CPU are fastest on them, a 1x1 convolution is a
matrix product, and a cell of pixels becomes channels by copying contiguous runs.

Causal attention over past frames at 1/16 of the resolution: an option of the generator in pixels.

Every `STRIDE`-th frame leaves the keys and values of its cells; a later frame attends to those of
the last ``slots`` such frames. Keys and values are kept as they were made, so a frame is never
computed again.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SLOPE = 0.1  # of the leaky activation
SMALL = 0.1  # scale of a branch's initial output: the network starts near the identity
STRIDE = 4  # frames from one that is kept to the next
HEADS, WAVES = 2, 4
OPERATORS = torch.library.Library("simrun", "DEF")  # type: ignore[no-untyped-call] # the operators live as long as it


def activation(x: Tensor, inplace: bool = False) -> Tensor:
    """Apply the leaky rectifier; ``inplace`` where nothing else reads ``x``."""
    return F.leaky_relu(x, SLOPE, inplace)


def cpu_operator(schema: str) -> Callable[[Callable[..., Tensor]], Callable[..., Tensor]]:
    """Make a function on the CPU an operator, which a recording of the network calls.

    ``torch.library.custom_op`` would do the same, and load the compiler of graphs at the first
    call: a second of every worker.
    """

    def make(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        name = OPERATORS.define(schema)  # type: ignore[no-untyped-call]
        OPERATORS.impl(name, function, "CPU")  # type: ignore[no-untyped-call]
        operator = getattr(torch.ops.simrun, name)
        return wraps(function)(lambda *tensors: operator(*tensors))

    return make


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

    packed: Tensor | None  # see `pack`

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3, padding=1)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.register_buffer("packed", None, persistent=False)

    def forward(self, input: Tensor, activated: bool = False) -> Tensor:
        """Map ``(B, H, W, inputs)`` to ``(B, H, W, outputs)``; ``activated`` by the leaky rectifier
        as well.
        """
        image = input.permute(0, 3, 1, 2)
        if self.packed is not None:
            made: Tensor = _recordable(_packed_convolution)(
                image, self.packed, self.bias, "leaky_relu" if activated else "none", SLOPE
            )
            return made.permute(0, 2, 3, 1)
        out = F.conv2d(image, self.weight, self.bias, padding=1).permute(0, 2, 3, 1)
        return activation(out, inplace=True) if activated else out


class Dense(nn.Linear):
    """Linear layer over the last axis."""

    packed: Tensor | None  # see `pack`

    def __init__(self, inputs: int, outputs: int, bias: bool = True) -> None:
        super().__init__(inputs, outputs, bias)
        self.register_buffer("packed", None, persistent=False)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(..., inputs)`` to ``(..., outputs)``."""
        if self.packed is None:
            return super().forward(input)
        made: Tensor = _recordable(_packed_linear)(input, self.packed, self.bias)
        return made


def pack(net: nn.Module) -> None:
    """Lay the weights of a network out as oneDNN's kernels read them, once instead of at every
    call; it has no gradient any more.

    Layers then add their bias and apply their activation before they round, in the pass that
    multiplies. With less than AVX-512 the kernel of a convolution depends on the size of the
    picture, and the layout with it: those weights stay as they are, as do those in bfloat16.
    """
    wide = "AVX512" in torch.backends.cpu.get_cpu_capability()
    for layer in net.modules():
        if isinstance(layer, (Conv3, Dense)) and (wide or layer.weight.dtype == torch.float32):
            weight = layer.weight.detach()
            if isinstance(layer, Dense):
                layer.packed = torch.ops.mkldnn._reorder_linear_weight(weight)
            else:
                layer.packed = (
                    torch.ops.mkldnn._reorder_convolution_weight(weight, [1, 1], [1, 1], [1, 1], 1)
                    if wide
                    else weight
                )


@cache
def _recordable(operation: Callable[..., Tensor]) -> Any:
    """Compile an operation whose list of optional numbers torch's tracer cannot record by
    itself.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return torch.jit.script(operation)


def _packed_convolution(
    image: Tensor, weight: Tensor, bias: Tensor | None, then: str, slope: float
) -> Tensor:
    slopes: list[int | float | complex | None] = [slope]
    one = [1, 1]
    out: Tensor = torch.ops.mkldnn._convolution_pointwise(
        image, weight, bias, one, one, one, 1, then, slopes, ""
    )
    return out


def _packed_linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    out: Tensor = torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")
    return out


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
        branch: Tensor = self.second(self.first(x, activated=True))
        return branch.add_(x)


class Downsample(Dense):
    """Halve the resolution: cells of 2x2 pixels through a linear layer.

    Args:
        inputs, outputs: Channels before and after.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(4 * inputs, outputs)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, H, W, inputs)`` to ``(B, H / 2, W / 2, outputs)``."""
        return super().forward(cells(input, 2))


class Upsample(Dense):
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


class MemoryState(NamedTuple):
    """Keys and values of past frames, newest first."""

    kept: Tensor  # (B, slots, cells, 2 width), zero where nothing is kept yet
    frames: Tensor  # (B, 1, 1, 1) float32, frames seen so far


class FrameMemory(nn.Module):
    """Attention from the cells of a frame to those of past frames.

    Args:
        channels: Of the features at 1/16.
        slots: Frames that are kept.
        width: Channels of keys and of values.
    """

    def __init__(self, channels: int, slots: int, width: int = 64) -> None:
        super().__init__()
        self.slots, self.width = slots, width
        self.query, self.key_value = nn.Linear(channels, width), nn.Linear(channels, 2 * width)
        self.place = nn.Linear(
            4 * WAVES, width, bias=False
        )  # where a cell is, added to queries and keys
        self.age = nn.Parameter(torch.zeros(slots, width))  # how long ago, added to keys
        self.out = nn.Linear(width, channels)
        nn.init.zeros_(self.out.weight)  # the network begins as the one without a memory
        nn.init.zeros_(self.out.bias)

    def start(self, like: Tensor, cells: int) -> MemoryState:
        """Return the state before a rollout; ``like`` gives the batch and the device."""
        b = len(like)
        return MemoryState(
            like.new_zeros(b, self.slots, cells, 2 * self.width), like.new_zeros(b, 1, 1, 1)
        )

    def forward(self, x: Tensor, state: MemoryState) -> tuple[Tensor, MemoryState]:
        """Add to ``x`` ``(B, h, w, channels)`` what past frames hold; return it and the state after
        the frame.
        """
        b, h, w, _ = x.shape
        place = self.place(_waves(h, w, x))  # (h w, width)
        flat = x.flatten(1, 2)
        key, value = self.key_value(flat).chunk(2, dim=-1)
        count = torch.div(
            state.frames + STRIDE - 1, STRIDE, rounding_mode="floor"
        )  # frames that are kept so far
        slot = torch.arange(self.slots, device=x.device, dtype=count.dtype)
        known = (slot < count[:, 0, 0]).repeat_interleave(h * w, dim=1)  # (B, slots cells)
        past = state.kept.to(x.dtype)
        keys = (past[..., : self.width] + self.age[:, None]).flatten(1, 2)
        values = past[..., self.width :].flatten(1, 2)
        q, k, v = (
            _heads(part)
            for part in (
                self.query(flat) + place,
                torch.cat([keys, key + place], 1),
                torch.cat([values, value], 1),
            )
        )
        mask = torch.cat([known, known.new_ones(b, h * w)], dim=1)[:, None, None]
        found = F.scaled_dot_product_attention(q, k, v, attn_mask=mask).transpose(1, 2).flatten(2)
        out = x + self.out(found).view_as(x)
        entry = torch.cat([key + place, value], dim=-1)[:, None].float()
        pushed = torch.cat([entry, state.kept[:, :-1]], dim=1)
        kept = torch.where(torch.remainder(state.frames, STRIDE) == 0, pushed, state.kept)
        return out, MemoryState(kept, state.frames + 1)


def _heads(x: Tensor) -> Tensor:
    """Split ``(B, N, width)`` to ``(B, heads, N, width / heads)``."""
    return x.view(*x.shape[:2], HEADS, x.shape[2] // HEADS).transpose(1, 2)


def _waves(h: int, w: int, like: Tensor) -> Tensor:
    """Return sines and cosines of the cells' places ``(h w, 4 WAVES)``; places are shares of the
    picture.
    """
    rows = (torch.arange(h, device=like.device) + 0.5) / h
    columns = (torch.arange(w, device=like.device) + 0.5) / w
    rates = math.pi * 2.0 ** torch.arange(WAVES, device=like.device)
    y = (rows[:, None] * rates)[:, None].expand(h, w, WAVES)
    x = (columns[:, None] * rates)[None].expand(h, w, WAVES)
    return torch.cat([y.sin(), y.cos(), x.sin(), x.cos()], dim=-1).flatten(0, 1).to(like.dtype)
