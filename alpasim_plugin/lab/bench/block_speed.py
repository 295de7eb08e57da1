"""Time steady blocks of a fixer on a device with random weights, to be compared with the floors of
`roofline`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from alpasim_plugin.block_fixers.attention import Kernel, attention_kernel
from alpasim_plugin.block_fixers.graphs import GraphedFunction
from alpasim_plugin.block_fixers.networks import DTYPES
from alpasim_plugin.block_fixers.pipeline import BlockPipeline, StageClock
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.errors import FixerError
from alpasim_plugin.lab.bench.random_networks import random_networks
from alpasim_plugin.lab.bench.roofline import TEXT_TOKENS, BlockWork, run_block, steady_after

CONTEXT_BYTES = 0.7e9  # what a process holds on a GPU before the first tensor


@dataclass(frozen=True)
class BlockTimes:
    """Milliseconds per block.

    Attributes:
        first: The very first block, buffers and kernels chosen in it.
        all_in: Steady blocks with their cache write, through recordings on a GPU.
        stages: The same by stage, each run by itself.
        calls: How steady blocks ran (see `GraphedFunction.counts`); empty without recordings.
        peak_mb: Most memory allocated on the device, 1e6 bytes; None on a CPU.
        device: Its name.
    """

    first: float
    all_in: list[float]
    stages: dict[str, list[float]]
    calls: dict[str, int]
    peak_mb: float | None
    device: str


def measure_blocks(
    settings: OneFixerSettings,
    work: BlockWork,
    height: int,
    width: int,
    device: str,
    blocks: int = 30,
    text_tokens: int = TEXT_TOKENS,
    attention: Kernel = "auto",
) -> BlockTimes:
    """Run a fixer's networks block by block over random images.

    Args:
        settings: The fixer; weights that it names are not read.
        work: Of the same settings and size: what memory it needs.
        height, width: Pixels, multiples of 16.
        device: ``cpu`` or ``cuda``.
        blocks: Steady blocks to time, and as many again with a clock at each stage.
        text_tokens: Of the prompt.
        attention: The transformer's and the autoencoder's attention kernel.

    Raises:
        FixerError: A GPU that is absent or too small, before anything is put on it.
        InputError: An attention kernel that is not there.
    """
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        require_memory(settings, work, device)
    with attention_kernel(attention, device, DTYPES[settings.precision], settings.dit.head_width):
        pipeline = BlockPipeline(random_networks(settings, device, text_tokens), settings)
        clock = StageClock(device)
        state, index = pipeline.start(work.views, height, width), 0

        def advance() -> float:
            nonlocal state, index
            begin = clock.now()
            _, state = run_block(pipeline, state, index, work.views, height, width)
            index += 1
            return 1e3 * (clock.now() - begin)

        first = advance()
        for _ in range(steady_after(settings) + 3):  # shapes settle, two eager calls, one recording
            advance()
        all_in = [advance() for _ in range(blocks)]
        fix = state.history.fix
        calls = dict(fix.counts) if isinstance(fix, GraphedFunction) else {}
        pipeline.stage = clock
        stages: dict[str, list[float]] = {}
        for _ in range(blocks):
            advance()
            for name, ms in clock.take().items():
                stages.setdefault(name, []).append(ms)
    peak = torch.cuda.max_memory_allocated(device) / 1e6 if on_gpu else None
    return BlockTimes(
        first, all_in, stages, calls, peak, torch.cuda.get_device_name(device) if on_gpu else "cpu"
    )


def require_memory(settings: OneFixerSettings, work: BlockWork, device: str) -> None:
    """Raise `FixerError` with what is needed and what there is if a GPU is absent or too small."""
    if not torch.cuda.is_available():
        raise FixerError(
            f"device {device!r}: torch {torch.__version__} sees no CUDA device",
            "run it on a machine with a GPU and a CUDA build of torch, or use --device cpu with a smaller fixer",
        )
    free, total = torch.cuda.mem_get_info(device)
    need = work.memory_bytes + CONTEXT_BYTES
    if need > free:
        raise FixerError(
            f"{torch.cuda.get_device_name(device)}: {need / 1000000000.0:.1f} GB needed, {free / 1000000000.0:.1f} GB free of {total / 1000000000.0:.1f} GB",
            "lower --set fixer.window=, --size or precision, use vae.base=24, or free the device",
        )
