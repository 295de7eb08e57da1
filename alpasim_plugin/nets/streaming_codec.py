"""Whole-clip and streaming interface of the video codecs, over their pure step functions `encode_next` and `decode_next`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from alpasim_plugin.nets.streaming_state import State, Stream


class StreamingDecoder(nn.Module, ABC):
    """Decode clips and streams of latents.

    ``latents_per_pass`` (1; None for all) is the number of latents processed at once, which bounds memory; results differ by rounding only.
    """

    latents_per_pass: int | None = 1

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the learned weights, and of every result."""
        return next(self.parameters()).dtype

    @abstractmethod
    def decode_next(self, *args: Any, **options: Any) -> tuple[Tensor, State]:
        """Decode the next latents of a stream; a pure function ``(latents, state, **options) -> (frames, state)``."""

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

    def decoder_stream(self, *, detach: bool = True) -> Stream:
        """Start a stream: ``push(latents, ...) -> frames`` as `decode_next`; its ``state`` is all it holds."""
        return Stream(partial(self.decode_next, detach=detach))


class StreamingCodec(StreamingDecoder):
    """Encode and decode clips and streams."""

    @abstractmethod
    def encode_next(self, *args: Any, **options: Any) -> tuple[Tensor, State]:
        """Encode the next frames of a stream; a pure function ``(frames, state, detach=False) -> (latents, state)``."""

    def encode(self, video: Tensor) -> Tensor:
        """Encode a whole clip.

        Args:
            video: ``(B, 3, 1 + 4k, H, W)`` in [-1, 1], H and W multiples of 8 (`clips.pad_clip` pads any clip).

        Returns:
            ``(B, 16, 1 + k, H/8, W/8)``, normalised means; nothing is sampled.

        Raises:
            InputError: Another shape.
        """
        return self.encode_next(video, None)[0]

    def encoder_stream(self, *, detach: bool = True) -> Stream:
        """Start a stream: ``push(frames) -> latents`` as `encode_next`; its ``state`` is all it holds."""
        return Stream(partial(self.encode_next, detach=detach))
