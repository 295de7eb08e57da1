"""Peak memory and time of one training sample over clip length and perceptual horizon, each
measured in a fresh process.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.sizes import DiTSizes, initial_weights
from alpasim_plugin.core.processes import resident_mb
from alpasim_plugin.core.subprocesses import end_with_parent
from alpasim_plugin.lab.training.shared_rollout import Objectives, Sample, losses

KIB_OF_MIB, MB_OF_MIB = 1024.0, 2**20 / 1e6


class MemoryCell(NamedTuple):
    """One measurement.

    Attributes:
        latents, horizon: N and k; ``horizon`` 0 is flow matching on own history alone.
        extra_mib: Peak resident memory of forward and backward above that of the process with the
            network and its inputs.
        s: Seconds of the second of two runs.
    """

    latents: int
    horizon: int
    extra_mib: float
    s: float


def measure_memory(
    settings: OneFixerSettings,
    latents: Sequence[int],
    horizons: Sequence[int],
    clips: int,
    rows: int,
    columns: int,
) -> list[MemoryCell]:
    """Measure every pair of clip length and horizon; the perceptual term is a plain square on the
    last position, so decoding is not in it.

    Args:
        settings: The fixer's sizes.
        latents, horizons: N and k to measure.
        clips: Clips side by side.
        rows, columns: Size in latents.
    """
    context = multiprocessing.get_context("spawn")
    cells = []
    for n in latents:
        for k in (k for k in horizons if k <= n):
            with context.Pool(
                1, end_with_parent
            ) as pool:  # the peak of a process never falls, so every cell has its own
                cells.append(
                    pool.apply(
                        _measure,
                        (
                            DiTSizes(**settings.dit.model_dump()),
                            n,
                            k,
                            clips,
                            rows,
                            columns,
                            settings.window,
                        ),
                    )
                )
    return cells


def memory_table(cells: Sequence[MemoryCell]) -> str:
    """Return the cells as a Markdown table, lengths down and horizons across."""
    horizons = sorted({cell.horizon for cell in cells})
    lines = [
        "| latents | " + " | ".join(f"k = {k}" for k in horizons) + " |",
        "|---|" + "---|" * len(horizons),
    ]
    for n in sorted({cell.latents for cell in cells}):
        found = {
            cell.horizon: f"{cell.extra_mib:.0f} MiB, {cell.s:.1f} s"
            for cell in cells
            if cell.latents == n
        }
        lines.append(f"| {n} | " + " | ".join(found.get(k, "") for k in horizons) + " |")
    return "\n".join(lines)


def monotone(cells: Sequence[MemoryCell], tolerance: float = 0.1) -> bool:
    """Tell whether memory rises with the length and with the horizon, within the share that an
    allocator rounds by.
    """
    by_cell = {(cell.latents, cell.horizon): cell.extra_mib for cell in cells}
    larger = [(a, b) for a in by_cell for b in by_cell if a != b and a[0] <= b[0] and a[1] <= b[1]]
    return all(by_cell[a] <= (1 + tolerance) * by_cell[b] for a, b in larger)


def _measure(
    sizes: DiTSizes, n: int, k: int, clips: int, rows: int, columns: int, window: int
) -> MemoryCell:
    net = CosmosCausalDiT.from_state_dict(initial_weights(sizes, 0))
    generator = torch.Generator().manual_seed(0)

    def normal(channels: int = 16) -> Tensor:
        return torch.randn(clips, channels, n, rows, columns, generator=generator)

    t = torch.rand(clips, n, generator=generator)
    sample = Sample(
        normal(), normal(), normal(), torch.ones_like(normal(1)), normal(), normal(), t, t, n - 1
    )
    text, objectives = torch.zeros(1, 1, sizes.text_width), Objectives("own", k)
    before = _peak()
    seconds = 0.0
    for _ in range(2):
        began = time.perf_counter()
        made = losses(
            net, sample, text, objectives, lambda z, w: z[:, :, w].square().mean(), window=window
        )
        made.total.backward()  # type: ignore[no-untyped-call]
        seconds = time.perf_counter() - began
    return MemoryCell(n, k, _peak() - before, seconds)


def _peak() -> float:
    """Return this process's peak memory, MiB. Linux counts that of the process that started it into
    ``ru_maxrss``.
    """
    own = resident_mb("VmHWM")
    return (
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIB_OF_MIB
        if own is None
        else own / MB_OF_MIB
    )
