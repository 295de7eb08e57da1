"""Stages of a fixer's block, and a clock that adds up the time spent in each."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch

STAGES = ("encode", "source", "dit", "decode", "cache write")  # of `BlockPipeline`, in order
TIMED = ("encode", "dit", "decode", "cache write")  # what tables show: mixing noise into the source takes next to nothing


class StageClock:
    """Add up the wall time of named stages; what `BlockPipeline` takes as its ``stage``.

    Args:
        device: On an accelerator, queued work is waited for at both ends of a stage.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._device = torch.device(device)
        self.ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time one pass through a stage."""
        begin = self.now()
        yield
        self.ms[name] = self.ms.get(name, 0.0) + (self.now() - begin) * 1e3

    def now(self) -> float:
        """Return seconds, with the device's queue empty."""
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()

    def take(self) -> dict[str, float]:
        """Return the milliseconds by stage since the last call."""
        ms, self.ms = self.ms, {}
        return ms
