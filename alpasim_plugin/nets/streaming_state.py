"""What a causal network keeps of the past: explicit, immutable, handed in and handed out.

A causal layer looks back one or two frames. In a stream those frames come from the call before. `Carry` walks the layers of one pass in
their fixed order, gives each the frames that it kept and collects what it keeps now. A state is a tuple of tensors that nobody writes to,
so remembering a state is remembering a reference: a stream can be forked, or rolled back to before a speculative block.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from alpasim_plugin.errors import InputError

State = tuple[Tensor, ...]
Step = Callable[..., tuple[Tensor, State]]


class Carry:
    """Serve one pass over a network.

    Args:
        state: What the pass before kept, or None before the first frame.
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
        """What the layers visited so far keep for the next pass."""
        return tuple(self._new)

    def extend(self, x: Tensor, frames: int) -> Tensor:
        """Put the kept frames before ``x`` and keep the last ``frames`` of both.

        Args:
            x: ``(B, T, ...)``.
            frames: How far the layer looks back.

        Returns:
            ``(B, k + T, ...)`` with ``0 <= k <= frames``; frames that the video does not have are not made up here.

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
        self._new.append((kept.detach() if self._detach else kept).clone())  # a view would keep the whole pass alive
        return joined

    def shift(self, x: Tensor) -> Tensor:
        """Return every frame's predecessor, same shape; a zero frame before the first one of the video."""
        joined = self.extend(x, 1)
        return joined[:, :-1] if joined.shape[1] > x.shape[1] else torch.cat([torch.zeros_like(x[:, :1]), x[:, :-1]], dim=1)


class Stream:
    """Feed a pure step function block by block and hold nothing but its state.

    Args:
        step: ``step(x, state, ...) -> (y, state)``.
        state: Where to start; None is before the first frame.
    """

    def __init__(self, step: Step, state: State | None = None) -> None:
        self._step = step
        self.state = state

    def push(self, x: Tensor, *args: Any, **options: Any) -> Tensor:
        """Take the next frames or latents and return what they complete."""
        out, self.state = self._step(x, self.state, *args, **options)
        return out

    def fork(self) -> Stream:
        """Return a second stream at the same point; the two never meet again."""
        return Stream(self._step, self.state)


def in_passes(step: Step, x: Tensor, state: State | None, ends: Sequence[int]) -> tuple[Tensor, State]:
    """Apply a pure step to consecutive parts of ``x (B, C, T, H, W)`` along time and join the results.

    One latent a pass bounds memory, and makes the result the same bit for bit however a video is cut into calls: the same sums
    are done in the same order.

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
