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

from alpasim_plugin.fixers.gather import gather_cells_cpu
from alpasim_plugin.nets.pixel_generator import GatheredCells, PixelGenerator, PixelState

AFTER = 8  # frames of a shape before it is recorded: recording takes as long as some thirty frames


class RecordedStep:
    """Call a generator on the CPU at t = 1; equal to calling the network, to rounding.

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
        tensors = *gather_cells_cpu(render, opacity, sdmap, state, source), render, *state
        shape = tuple(render.shape)
        self._calls[shape] += 1
        if self._after is not None and shape not in self.recorded and self._calls[shape] > self._after:
            self.recorded[shape] = _record(self._step, tensors)
        out, *after = self.recorded.get(shape, self._step)(*tensors)
        return out, PixelState(*after)


class _Step(nn.Module):
    """The generator with tensors alone for arguments and results."""

    def __init__(self, net: PixelGenerator) -> None:
        super().__init__()
        self.net = net

    def forward(self, coarse: Tensor, fine: Tensor, render: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        out, after = self.net.from_cells(GatheredCells(coarse, fine), render, PixelState(*state))
        return (out, *after)


def _record(step: _Step, tensors: tuple[Tensor, ...]) -> Any:
    with torch.inference_mode(False), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        plain = tuple(tensor.clone() for tensor in tensors)  # a recording of inference tensors could not be frozen
        return torch.jit.freeze(torch.jit.trace(step, plain, check_trace=False))  # type: ignore[no-untyped-call]
