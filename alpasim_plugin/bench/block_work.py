"""What one steady block of a fixer asks of a machine: counted on the real code without numbers, beside what devices can do at best."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from alpasim_plugin.bench.op_ledger import Ledger, counting
from alpasim_plugin.bench.random_networks import random_networks
from alpasim_plugin.bench.roofline import Device, compute_floor_s, eager_floor_s
from alpasim_plugin.errors import FixerError
from alpasim_plugin.fixers.networks import LATENT, Networks
from alpasim_plugin.fixers.pipeline import BlockPipeline, PipelineState
from alpasim_plugin.fixers.settings import OneFixerSettings
from alpasim_plugin.fixers.stage_clock import STAGES
from alpasim_plugin.nets.clips import SIDE
from alpasim_plugin.nets.precision import weight_bytes

TEXT_TOKENS = 512  # of the original's prompt
HEADROOM = 1.15  # an allocator's rounding, libraries' workspaces
CONTEXT_BYTES = 0.7e9  # what a process holds on a GPU before the first tensor


@dataclass(frozen=True)
class BlockWork:
    """One steady block.

    Attributes:
        frames: That the block makes, per view.
        views: Side by side.
        stages: Operations by stage, in order.
        weight_bytes: Of all networks.
        cache_bytes: Of keys and values of the past.
        state_bytes: Of what the codecs remember, before and after a block.
    """

    frames: int
    views: int
    stages: dict[str, Ledger]
    weight_bytes: int
    cache_bytes: int
    state_bytes: int

    @property
    def memory_bytes(self) -> float:
        """What a run needs at least: everything kept and the largest stage's own tensors, with headroom."""
        peak = max(ledger.peak_bytes for ledger in self.stages.values())
        return HEADROOM * (self.weight_bytes + self.cache_bytes + self.state_bytes + peak)

    def rows(self, device: Device) -> list[WorkRow]:
        """Return one row per stage and their sum."""
        rows = [WorkRow.of(name, [ledger], device) for name, ledger in self.stages.items()]
        return [*rows, WorkRow.of("all", list(self.stages.values()), device)]


@dataclass(frozen=True)
class WorkRow:
    """A stage's work and floors, per block.

    Attributes:
        stage: Its name.
        tflop: Products and convolutions, 1e12 operations.
        gigabytes: Read and written by operations that run alone.
        operations: Kernels, about.
        compute_ms: Floor of the arithmetic.
        eager_ms: Floor without fusion.
    """

    stage: str
    tflop: float
    gigabytes: float
    operations: int
    compute_ms: float
    eager_ms: float

    @classmethod
    def of(cls, stage: str, ledgers: Sequence[Ledger], device: Device) -> WorkRow:
        """Sum up ledgers."""
        return cls(
            stage,
            sum(ledger.flops for ledger in ledgers) / 1e12,
            sum(ledger.bytes for ledger in ledgers) / 1e9,
            sum(len(ledger.ops) for ledger in ledgers),
            1e3 * sum(compute_floor_s(ledger, device) for ledger in ledgers),
            1e3 * sum(eager_floor_s(ledger, device) for ledger in ledgers),
        )


def block_work(settings: OneFixerSettings, height: int, width: int, views: int = 1, text_tokens: int = TEXT_TOKENS) -> BlockWork:
    """Count one block once the window is full.

    Args:
        settings: Of a fixer.
        height, width: Pixels, multiples of 16.
        views: Cameras side by side.
        text_tokens: Of the prompt.
    """
    networks = random_networks(settings, "meta", text_tokens)
    stages: dict[str, Ledger] = {}

    @contextmanager
    def count(name: str) -> Iterator[None]:
        with counting() as ledger:
            yield
        joined = stages.setdefault(name, Ledger())
        joined.ops += ledger.ops
        joined.peak_bytes = max(joined.peak_bytes, ledger.peak_bytes)

    pipeline = BlockPipeline(networks, settings)
    state = pipeline.start(views, height, width)
    for block in range(steady_after(settings)):
        state = pipeline.keep(run_block(pipeline, state, block, views, height, width)[1])
    pipeline.stage = count
    pipeline.keep(run_block(pipeline, state, 1, views, height, width)[1])
    cache = state.history.cache
    remembered = sum(part.nbytes for memory in (state.encoder, state.decoder) for part in memory or ())
    ordered = {name: stages[name] for name in STAGES if name in stages and stages[name].ops}
    return BlockWork(4 * settings.block_latents, views, ordered, all_weights(networks), cache.nbytes, 2 * remembered)


def steady_after(settings: OneFixerSettings) -> int:
    """Return how many blocks it takes until every later one has the same shapes."""
    return max(2, -(-settings.window // settings.block_latents))


def run_block(
    pipeline: BlockPipeline, state: PipelineState, block: int, views: int, height: int, width: int, seed: int = 0
) -> tuple[torch.Tensor, PipelineState]:
    """Run one block of noise: pictures, opacity, maps and all."""
    settings, device = pipeline.settings, pipeline.networks.device
    frames = 4 * settings.block_latents - (0 if block else 3)
    generator = None if device.type == "meta" else torch.Generator(device).manual_seed(seed + block)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(shape, device=device, generator=generator)

    rgb = 2 * draw(views, 3, frames, height, width) - 1
    sdmap = 2 * draw(views, 3, frames, height, width) - 1 if settings.uses_map else None
    alpha = (draw(views, 1, frames, height, width) > 0.2).float()
    shape = (views, LATENT, settings.block_latents, height // SIDE, width // SIDE)
    noise = [torch.randn(shape, device=device, generator=generator) for _ in range(pipeline.draws)]
    return pipeline.run(state, rgb, alpha, sdmap, noise)


def all_weights(networks: Networks) -> int:
    """Return the bytes of every network, each counted once, and of the prompt."""
    nets = {id(net): net for net in (networks.dit, networks.finalise_dit, networks.vae, networks.decoder)}
    return sum(weight_bytes(net) for net in nets.values()) + sum(k.nbytes + v.nbytes for k, v in networks.text.keys_values)


def check_device(settings: OneFixerSettings, work: BlockWork, device: str) -> None:
    """Refuse a GPU that is not there or too small, before anything is put on it.

    Raises:
        FixerError: With what is needed and what there is.
    """
    if torch.device(device).type != "cuda":
        return
    doing = f"measuring {settings.name}"
    if not torch.cuda.is_available():
        do = "run it on a machine with a GPU and a CUDA build of torch, or use --device cpu with a smaller fixer"
        raise FixerError(doing, f"device {device!r}", f"torch {torch.__version__} sees no CUDA device", do)
    free, total = torch.cuda.mem_get_info(device)
    need = work.memory_bytes + CONTEXT_BYTES
    if need > free:
        found = f"{need / 1e9:.1f} GB needed, {free / 1e9:.1f} GB free of {total / 1e9:.1f} GB"
        do = "lower --set fixer.window=, --size or precision, use vae.base=24, or free the device"
        raise FixerError(doing, torch.cuda.get_device_name(device), found, do)
