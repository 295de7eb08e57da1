"""Streaming state of causal networks: explicit, immutable, passed in and returned.

A causal layer sees one or two past frames; in a stream they come from the previous call.
`StreamingState` serves the layers of one pass in their fixed order: each layer takes its cached
frames and leaves those for the next pass. A `State` is a tuple of tensors that are never written
to, so a copy is a reference: a stream can be forked, or rolled back to before a speculative block.

Per-frame layers on videos ``(B, T, H, W, C)``, and the loop over a mix of per-frame and causal
layers.

Channels last: norms and 1x1 convolutions act on contiguous vectors, a frame is a contiguous slice,
and a CPU's 2D convolutions are fast.

Whole-clip and streaming interface of the video codecs, over their pure step functions `encode_next`
and `decode_next`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.block_fixers.clips import GROUP, frame_counts

State = tuple[Tensor, ...]
Step = Callable[..., tuple[Tensor, State]]


class StreamingState:
    """Cached frames of every causal layer during one pass over a network.

    Args:
        state: State after the previous pass, or None before the first frame.
    """

    def __init__(self, state: State | None) -> None:
        self._old = state
        self._new: list[Tensor] = []

    @property
    def first(self) -> bool:
        """Whether this pass starts with the first frame of the video."""
        return self._old is None

    @property
    def state(self) -> State:
        """Cached frames of the layers visited so far, for the next pass."""
        return tuple(self._new)

    def extend(self, x: Tensor, frames: int) -> Tensor:
        """Prepend the cached frames to ``x`` and cache the last ``frames`` of the result.

        Args:
            x: ``(B, T, ...)``.
            frames: Past frames that the layer sees.

        Returns:
            ``(B, k + T, ...)`` with ``0 <= k <= frames``; no padding is added at the start of a
            video.
        """
        joined = x
        if self._old is not None:
            joined = torch.cat([self._old[len(self._new)].to(x.dtype), x], dim=1)
        kept = joined[:, max(0, joined.shape[1] - frames) :]
        self._new.append(kept.clone())  # a view would keep the memory of the whole pass
        return joined

    def shift(self, x: Tensor) -> Tensor:
        """Return every frame's predecessor, same shape; a zero frame before the first one of the
        video.
        """
        joined = self.extend(x, 1)
        if joined.shape[1] == x.shape[1]:
            joined = torch.cat([torch.zeros_like(x[:, :1]), x], dim=1)
        return joined[:, :-1]


def in_passes(
    step: Step, state: State | None, passes: Iterable[tuple[Tensor, ...]]
) -> tuple[Tensor, State]:
    """Apply a pure step to consecutive parts of a video and join the results along time.

    One latent a pass bounds memory and makes the result bit-identical for any division of a video
    into calls: the order of summation is the same.

    Args:
        step: ``step(state, *parts) -> (y, state)``.
        state: Where the stream stands.
        passes: The parts ``(B, C, T, H, W)`` that each pass takes, at least one pass.
    """
    out = []
    for parts in passes:
        made, state = step(state, *parts)
        out.append(made)
    assert state is not None, "no part at all"
    return torch.cat(out, dim=2), state


def run_layers(layers: Iterable[nn.Module], x: Tensor, streaming: StreamingState) -> Tensor:
    """Apply layers in sequence. A layer that sees past frames has ``next(x, streaming)``, which
    reads them from the streaming state and leaves its own there.
    """
    for layer in layers:
        step = getattr(layer, "next", None)
        x = layer(x) if step is None else step(x, streaming)
    return x


def channels_last(video: Tensor) -> Tensor:
    """Map ``(B, C, T, H, W)`` to contiguous ``(B, T, H, W, C)``."""
    return video.permute(0, 2, 3, 4, 1).contiguous()


def channels_first(x: Tensor) -> Tensor:
    """Undo `channels_last`."""
    return x.permute(0, 4, 1, 2, 3).contiguous()


def channels_to_frames(x: Tensor, parts: int) -> Tensor:
    """Rearrange ``parts`` groups of channels as consecutive frames: ``(B, T, H, W, parts * C)`` to
    ``(B, parts * T, H, W, C)``.
    """
    return torch.unflatten(x, -1, (parts, -1)).movedim(-2, 2).flatten(1, 2)


def spread(x: Tensor) -> Tensor:
    """Rearrange the channels of ``(B, T, H, W, 4 * C)`` as 2x2 pixels: ``(B, T, 2H, 2W, C)``."""
    b, t, rows, columns, _ = x.shape
    squares = x.view(b, t, rows, columns, 2, 2, -1).permute(0, 1, 2, 4, 3, 5, 6)
    return squares.reshape(b, t, 2 * rows, 2 * columns, -1)


def conv_frames(
    x: Tensor, weight: Tensor, bias: Tensor | None, stride: int = 1, padding: int = 0
) -> Tensor:
    """Convolve every frame of ``(B, T, H, W, C)`` with a 2D kernel ``(O, C, kh, kw)``."""
    b, t = x.shape[:2]
    out = F.conv2d(
        x.flatten(0, 1).permute(0, 3, 1, 2),
        weight.contiguous(memory_format=torch.channels_last),
        bias,
        stride,
        padding,
    )
    out = out.permute(0, 2, 3, 1)
    return out.reshape(b, t, *out.shape[1:])


class FrameConv(nn.Conv2d):
    """Convolution of every frame, by default 3x3 with zeros around it."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        bias: bool = True,
        side: int = 3,
        stride: int = 1,
        around: int = 1,
    ) -> None:
        super().__init__(inputs, outputs, side, stride, around, bias=bias)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, H / stride, W / stride, outputs)``."""
        return conv_frames(input, self.weight, self.bias, self.stride[0], int(self.padding[0]))


class DownsampleConv(FrameConv):
    """3x3 convolution with stride 2; zero padding at the bottom and right only."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, stride=2, around=0)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, H/2, W/2, outputs)``."""
        return super().forward(F.pad(input, (0, 0, 0, 1, 0, 1)))


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


class StreamingDecoder(nn.Module, ABC):
    """Decode clips and streams of latents.

    ``latents_per_pass`` (1; None for all) is the number of latents processed at once, which bounds
    memory; results differ by rounding only.
    """

    latents_per_pass: int | None = 1

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the learned weights, and of every result."""
        return next(self.parameters()).dtype

    @abstractmethod
    def decode_next(self, *args: Any, **options: Any) -> tuple[Tensor, State]:
        """Decode the next latents of a stream; a pure function ``(latents, state, **options) ->
        (frames, state)``.
        """

    def latents_of_passes(self, latents: int) -> list[int]:
        """Return how many latents each pass over ``latents`` takes."""
        size = self.latents_per_pass or latents
        return [min(size, latents - start) for start in range(0, latents, size)]

    def decode_in_passes(self, step: Step, z: Tensor, state: State | None) -> tuple[Tensor, State]:
        """Apply a step of a decoder to ``latents_per_pass`` latents at a time."""
        parts = torch.split(z.to(self.dtype), self.latents_of_passes(z.shape[2]), dim=2)
        return in_passes(step, state, zip(parts, strict=True))

    def decode(self, z: Tensor, **options: Any) -> Tensor:
        """Decode a whole clip.

        Args:
            z: ``(B, 16, t, h, w)``, normalised.
            options: Keyword arguments of `decode_next`, such as ``clamp``.

        Returns:
            ``(B, 3, 1 + 4 (t - 1), 8h, 8w)`` in [-1, 1].

        Raises:
            InputError: Another shape.
        """
        return self.decode_next(z, None, **options)[0]


class StreamingCodec(StreamingDecoder):
    """Encode and decode clips and streams."""

    @abstractmethod
    def encode_next(self, *args: Any, **options: Any) -> tuple[Tensor, State]:
        """Encode the next frames of a stream; a pure function ``(frames, state) -> (latents,
        state)``.
        """

    def encode_in_passes(
        self, step: Step, frames: Tensor, state: State | None
    ) -> tuple[Tensor, State]:
        """Apply a step of an encoder to the frames of ``latents_per_pass`` latents at a time."""
        first = state is None
        latents = self.latents_of_passes(frames.shape[2] // GROUP + first)
        parts = torch.split(frames, frame_counts(latents, first), dim=2)
        return in_passes(step, state, zip(parts, strict=True))

    def encode(self, video: Tensor) -> Tensor:
        """Encode a whole clip.

        Args:
            video: ``(B, 3, 1 + 4k, H, W)`` in [-1, 1], H and W multiples of 8 (`clips.pad_clip`
                pads any clip).

        Returns:
            ``(B, 16, 1 + k, H/8, W/8)``, normalised means; nothing is sampled.

        Raises:
            InputError: Another shape.
        """
        return self.encode_next(video, None)[0]
