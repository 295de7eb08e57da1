"""The deployed step of a generator in pixels, recorded once its shape repeats.

The network has some forty small operations, and Python between them takes a tenth of a frame's time on a CPU. A recording (TorchScript,
frozen weights) runs the same operations without it.
"""

from __future__ import annotations

import warnings
from collections import Counter
from typing import Any

import torch
from torch import Tensor, nn

from alpasim_plugin.nets.pixel_generator import PixelGenerator, PixelState

AFTER = 8  # frames of a shape before it is recorded: recording takes as long as some thirty frames


class RecordedStep:
    """Call a generator at t = 1; equal to calling the network, to rounding.

    Args:
        net: In evaluation mode, never written to.
        after: Calls of a shape before it is recorded; None records nothing.
    """

    def __init__(self, net: PixelGenerator, after: int | None = AFTER) -> None:
        self._step, self._after = _Step(net).eval(), after
        self._calls: Counter[tuple[int, ...]] = Counter()
        self.recorded: dict[tuple[int, ...], Any] = {}

    def __call__(self, render: Tensor, opacity: Tensor, sdmap: Tensor, state: PixelState, source: Tensor) -> tuple[Tensor, PixelState]:
        """Return the clean frame and the state after it; see `PixelGenerator.forward`."""
        images = render, opacity, sdmap, source, *state
        shape = tuple(render.shape)
        self._calls[shape] += 1
        if self._after is not None and shape not in self.recorded and self._calls[shape] > self._after:
            self.recorded[shape] = _record(self._step, images)
        out, *after = self.recorded.get(shape, self._step)(*images)
        return out, PixelState(*after)


class _Step(nn.Module):
    """The generator with tensors alone for arguments and results."""

    def __init__(self, net: PixelGenerator) -> None:
        super().__init__()
        self.net = net

    def forward(self, render: Tensor, opacity: Tensor, sdmap: Tensor, source: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        out, after = self.net(render, opacity, sdmap, PixelState(*state), source)
        return (out, *after)


def _record(step: _Step, images: tuple[Tensor, ...]) -> Any:
    with torch.inference_mode(False), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        plain = tuple(image.clone() for image in images)  # a recording of inference tensors could not be frozen
        return torch.jit.freeze(torch.jit.trace(step, plain, check_trace=False))  # type: ignore[no-untyped-call]
