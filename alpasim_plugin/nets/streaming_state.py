"""Streaming state of causal networks: explicit, immutable, passed in and returned.

A causal layer sees one or two past frames; in a stream they come from the previous call. `StreamingState` serves the layers of one pass in
their fixed order: each layer takes its cached frames and leaves those for the next pass. A `State` is a tuple of tensors that are never
written to, so a copy is a reference: a stream can be forked, or rolled back to before a speculative block.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError

State = tuple[Tensor, ...]
Step = Callable[..., tuple[Tensor, State]]


class StreamingState:
    """Cached frames of every causal layer during one pass over a network.

    Args:
        state: State after the previous pass, or None before the first frame.
        detach: Cut gradients at the pass boundary.
    """

    def __init__(self, state: State | None, detach: bool = False) -> None:
        self._old = state
        self._new: list[Tensor] = []
        self._detach = detach

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
            ``(B, k + T, ...)`` with ``0 <= k <= frames``; no padding is added at the start of a video.

        Raises:
            InputError: Batch or frame size changed in the middle of a stream.
        """
        past = x[:, :0] if self._old is None else self._old[len(self._new)].to(x.dtype)
        if past.shape[0] != x.shape[0] or past.shape[2:] != x.shape[2:]:
            raise InputError(
                "continuing a video stream",
                f"a block whose layers have shape {list(x.shape)}",
                f"the stream so far had {list(past.shape)} (batch, frames, then sizes)",
                "keep batch and frame size for the whole stream, or start a new stream",
            )
        joined = torch.cat([past, x], dim=1) if past.shape[1] else x
        kept = joined[:, max(0, joined.shape[1] - frames) :]
        self._new.append((kept.detach() if self._detach else kept).clone())  # a view would keep the memory of the whole pass
        return joined

    def shift(self, x: Tensor) -> Tensor:
        """Return every frame's predecessor, same shape; a zero frame before the first one of the video."""
        joined = self.extend(x, 1)
        return joined[:, :-1] if joined.shape[1] > x.shape[1] else torch.cat([torch.zeros_like(x[:, :1]), x[:, :-1]], dim=1)


class Stream:
    """Feed a pure step function block by block and hold its state.

    Args:
        step: ``step(x, state, ...) -> (y, state)``.
        state: Where to start; None is before the first frame.
    """

    def __init__(self, step: Step, state: State | None = None) -> None:
        self._step = step
        self.state = state

    def push(self, x: Tensor, *args: Any, **options: Any) -> Tensor:
        """Take the next frames or latents and return the outputs that they complete."""
        out, self.state = self._step(x, self.state, *args, **options)
        return out

    def fork(self) -> Stream:
        """Return an independent stream at the same point."""
        return Stream(self._step, self.state)


def in_passes(step: Step, x: Tensor, state: State | None, ends: Sequence[int]) -> tuple[Tensor, State]:
    """Apply a pure step to consecutive parts of ``x (B, C, T, H, W)`` along time and join the results.

    One latent a pass bounds memory and makes the result bit-identical for any division of a video into calls: the order of
    summation is the same.

    Args:
        step: ``step(part, state) -> (y, state)``.
        x: Frames or latents, at least one.
        state: Where the stream stands.
        ends: Where each part ends, increasing, the last one at T.
    """
    parts = []
    for start, end in zip((0, *ends[:-1]), ends, strict=True):
        out, state = step(x[:, :, start:end], state)
        parts.append(out)
    assert state is not None, "no part at all"
    return (torch.cat(parts, dim=2) if len(parts) > 1 else parts[0]), state
