"""Roofline of one steady block of a fixer: its work, counted on the real code without numbers, over
the peak rates of a device.

Two lower bounds of the time are given for the same code. The *compute floor* is all products and
convolutions at the device's peak, with everything else free. The *eager floor* lets every operation
wait for its own arithmetic or its own memory traffic, whichever is longer: unfused kernels cannot
be faster. The difference is what kernel fusion can gain.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from alpasim_plugin.block_fixers.clips import SIDE
from alpasim_plugin.block_fixers.networks import LATENT, Networks, weight_bytes
from alpasim_plugin.block_fixers.pipeline import STAGES, BlockPipeline, PipelineState
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.op_counter import Op, OpCounter
from alpasim_plugin.lab.bench.random_networks import random_networks

TEXT_TOKENS = 512  # of the original's prompt
HEADROOM = 1.15  # an allocator's rounding, libraries' workspaces
DOING = "choosing a device for the roofline"


@dataclass(frozen=True)
class Device:
    """Peak rates of a device.

    Attributes:
        name: For tables.
        half, float32: Operations per second of dense products in bfloat16 or float16, and in
            float32.
        bandwidth: Bytes per second of its memory.
        memory: Bytes of it.
        source: Where the numbers come from.
    """

    name: str
    half: float
    float32: float
    bandwidth: float
    memory: float
    source: str

    def compute_floor_s(self, ops: Iterable[Op]) -> float:
        """Return the seconds that the arithmetic takes at peak."""
        return sum(op.flops / self._peak(op.dtype) for op in ops)

    def eager_floor_s(self, ops: Iterable[Op]) -> float:
        """Return the seconds that operations take one after the other, each at peak arithmetic or
        peak bandwidth.
        """
        return sum(max(op.flops / self._peak(op.dtype), op.bytes / self.bandwidth) for op in ops)

    def _peak(self, dtype: torch.dtype) -> float:
        return self.half if dtype in (torch.bfloat16, torch.float16) else self.float32


# Dense peaks without sparsity, without tf32 (the networks do not switch it on).
DEVICES = {
    "h200": Device(
        "NVIDIA H200 SXM", 989e12, 67e12, 4.8e12, 141e9, "NVIDIA H200 data sheet, dense"
    ),
    "h100": Device(
        "NVIDIA H100 SXM", 989e12, 67e12, 3.35e12, 80e9, "NVIDIA H100 data sheet, dense"
    ),
    "a100": Device(
        "NVIDIA A100 SXM 80 GB", 312e12, 19.5e12, 2.039e12, 80e9, "NVIDIA A100 data sheet, dense"
    ),
    "rtx4090": Device(
        "NVIDIA GeForce RTX 4090", 165e12, 82.6e12, 1.008e12, 24e9, "NVIDIA Ada whitepaper, dense"
    ),
}


def device_of(name: str) -> Device:
    """Return a known device, or one given as numbers.

    Args:
        name: A key of `DEVICES`, or ``half:float32:bandwidth:memory`` in TFLOP/s, TFLOP/s, GB/s and
            GB.

    Raises:
        InputError: Anything else.

    Example:
        >>> device_of("200:100:500:32").bandwidth
        500000000000.0
    """
    if name.lower() in DEVICES:
        return DEVICES[name.lower()]
    try:
        half, single, bandwidth, memory = (float(part) for part in name.split(":"))
    except ValueError:
        raise InputError(
            f"{name}: known are {', '.join(DEVICES)}",
            "write four numbers, half:float32:bandwidth:memory in TFLOP/s, TFLOP/s, GB/s, GB, or a known name",
        ) from None
    if min(half, single, bandwidth, memory) <= 0:
        raise InputError(f"{name}: a number that is not positive", "give positive numbers")
    return Device(
        name, half * 1e12, single * 1e12, bandwidth * 1e9, memory * 1e9, "given by the user"
    )


@dataclass(frozen=True)
class WorkRow:
    """Work and floors of a stage, per block.

    Attributes:
        stage: Its name.
        tflop: Products and convolutions, 1e12 operations.
        gigabytes: Read and written, every operation alone.
        operations: About as many kernels.
        compute_ms, eager_ms: Floors.
    """

    stage: str
    tflop: float
    gigabytes: float
    operations: int
    compute_ms: float
    eager_ms: float

    @classmethod
    def of(cls, stage: str, ops: Sequence[Op], device: Device) -> WorkRow:
        """Sum up operations."""
        flops, moved = sum(op.flops for op in ops), sum(op.bytes for op in ops)
        return cls(
            stage,
            flops / 1e12,
            moved / 1e9,
            len(ops),
            1e3 * device.compute_floor_s(ops),
            1e3 * device.eager_floor_s(ops),
        )


@dataclass(frozen=True)
class BlockWork:
    """One steady block.

    Attributes:
        frames: That the block makes, per view.
        views: Cameras in the batch.
        stages: Operations by stage, in order.
        weight_bytes: Of all networks.
        cache_bytes: Of cached keys and values.
        state_bytes: Of the codecs' streaming states before and after a block.
    """

    frames: int
    views: int
    stages: dict[str, OpCounter]
    weight_bytes: int
    cache_bytes: int
    state_bytes: int

    @property
    def memory_bytes(self) -> float:
        """What a run needs at least: everything kept and the largest stage's own tensors, with
        headroom.
        """
        peak = max(counter.peak_bytes for counter in self.stages.values())
        return HEADROOM * (self.weight_bytes + self.cache_bytes + self.state_bytes + peak)

    def rows(self, device: Device) -> list[WorkRow]:
        """Return one row per stage and their sum."""
        rows = [WorkRow.of(name, counter.ops, device) for name, counter in self.stages.items()]
        return [
            *rows,
            WorkRow.of(
                "all", [op for counter in self.stages.values() for op in counter.ops], device
            ),
        ]


def block_work(
    settings: OneFixerSettings,
    height: int,
    width: int,
    views: int = 1,
    text_tokens: int = TEXT_TOKENS,
) -> BlockWork:
    """Count one block once the window is full, on the ``meta`` device.

    Args:
        settings: Of a fixer.
        height, width: Pixels, multiples of 16.
        views: Cameras in the batch.
        text_tokens: Of the prompt.
    """
    networks = random_networks(settings, "meta", text_tokens)
    pipeline = BlockPipeline(networks, settings)
    state = pipeline.start(views, height, width)
    for block in range(steady_after(settings)):
        _, state = run_block(pipeline, state, block, views, height, width)
    counters = {name: OpCounter() for name in STAGES}
    pipeline.stage = counters.__getitem__
    run_block(pipeline, state, 1, views, height, width)
    state_bytes = sum(
        part.nbytes for codec in (state.encoder, state.decoder) for part in codec or ()
    )
    counted = {name: counter for name, counter in counters.items() if counter.ops}
    cache_bytes = state.history.cache.nbytes
    return BlockWork(
        4 * settings.block_latents,
        views,
        counted,
        networks_bytes(networks),
        cache_bytes,
        2 * state_bytes,
    )


def steady_after(settings: OneFixerSettings) -> int:
    """Return how many blocks it takes until every later one has the same shapes."""
    return max(2, -(-settings.window // settings.block_latents))


def run_block(
    pipeline: BlockPipeline, state: PipelineState, block: int, views: int, height: int, width: int
) -> tuple[torch.Tensor, PipelineState]:
    """Run one block of random images, opacity and maps; return its video and the state with the
    block in the history.
    """
    settings, device = pipeline.settings, pipeline.networks.device
    frames = 4 * settings.block_latents - (0 if block else 3)
    generator = None if device.type == "meta" else torch.Generator(device).manual_seed(block)

    def draw(channels: int) -> torch.Tensor:
        return torch.rand(
            views, channels, frames, height, width, device=device, generator=generator
        )

    rgb = 2 * draw(3) - 1
    sdmap = 2 * draw(3) - 1 if settings.uses_map else None
    alpha = (draw(1) > 0.2).float()
    shape = (views, LATENT, settings.block_latents, height // SIDE, width // SIDE)
    noise = [torch.randn(shape, device=device, generator=generator) for _ in range(pipeline.draws)]
    video, draft = pipeline.run(state, rgb, alpha, sdmap, noise)
    return video, pipeline.keep(draft)


def networks_bytes(networks: Networks) -> int:
    """Return the bytes of every network, each counted once, and of the prompt."""
    nets = {
        id(net): net
        for net in (networks.dit, networks.finalise_dit, networks.vae, networks.decoder)
    }
    return sum(weight_bytes(net) for net in nets.values()) + sum(
        k.nbytes + v.nbytes for k, v in networks.text.keys_values
    )
