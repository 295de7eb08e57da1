"""How fast a block could be at best: work of the transformer from its sizes alone, and what a device needs for any counted work.

Two floors are given for the same code. The *compute floor* is all products and convolutions at the device's peak, with everything else
free: nothing can be faster. The *eager floor* lets every operation wait for its own arithmetic or its own memory traffic, whichever is
longer: unfused kernels cannot be faster. What lies between them is what fusing can win.

Multiply-adds count as two. Source of the transformer's terms: docs/nets.md; of the peaks: see `DEVICES`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from alpasim_plugin.bench.op_ledger import Ledger
from alpasim_plugin.errors import InputError
from alpasim_plugin.nets.sizes import AREA, DiTSizes

KINDS = {torch.bfloat16: "half", torch.float16: "half", torch.float32: "float32", torch.int32: "int8", torch.int8: "int8"}


@dataclass(frozen=True)
class Device:
    """What a device can do per second at best.

    Args:
        name: For tables.
        half, float32, int8: Peak operations per second of dense products in bfloat16 or float16, float32 and int8.
        bandwidth: Bytes per second of its memory.
        memory: Bytes of it.
        source: Where the numbers come from.
    """

    name: str
    half: float
    float32: float
    int8: float
    bandwidth: float
    memory: float
    source: str

    def peak(self, dtype: torch.dtype) -> float:
        """Return operations per second of products in ``dtype``; types without products count as float32."""
        return float(getattr(self, KINDS.get(dtype, "float32")))


# Dense peaks without sparsity, without tf32 (the networks do not switch it on).
DEVICES = {
    "h200": Device("NVIDIA H200 SXM", 989e12, 67e12, 1979e12, 4.8e12, 141e9, "NVIDIA H200 data sheet, dense"),
    "h100": Device("NVIDIA H100 SXM", 989e12, 67e12, 1979e12, 3.35e12, 80e9, "NVIDIA H100 data sheet, dense"),
    "a100": Device("NVIDIA A100 SXM 80 GB", 312e12, 19.5e12, 624e12, 2.039e12, 80e9, "NVIDIA A100 data sheet, dense"),
    "rtx4090": Device("NVIDIA GeForce RTX 4090", 165e12, 82.6e12, 661e12, 1.008e12, 24e9, "NVIDIA Ada whitepaper, dense"),
}


def device_of(name: str) -> Device:
    """Return a known device, or one given as numbers.

    Args:
        name: A key of `DEVICES`, or ``half:float32:int8:bandwidth:memory`` in TFLOP/s, TFLOP/s, TOP/s, GB/s and GB.

    Raises:
        InputError: Anything else.

    Example:
        >>> device_of("200:100:400:500:32").bandwidth
        500000000000.0
    """
    if name.lower() in DEVICES:
        return DEVICES[name.lower()]
    try:
        half, single, int8, bandwidth, memory = (float(part) for part in name.split(":"))
    except ValueError:
        do = "write five numbers, half:float32:int8:bandwidth:memory in TFLOP/s, TFLOP/s, TOP/s, GB/s, GB, or a known name"
        raise InputError("choosing a device for the roofline", name, f"known are {', '.join(DEVICES)}", do) from None
    if min(half, single, int8, bandwidth, memory) <= 0:
        raise InputError("choosing a device for the roofline", name, "a number that is not positive", "give positive numbers")
    return Device(name, half * 1e12, single * 1e12, int8 * 1e12, bandwidth * 1e9, memory * 1e9, "given by the user")


@dataclass(frozen=True)
class ForwardWork:
    """Floating-point operations and least memory traffic of one forward of the transformer over one block."""

    linear: float
    self_attention: float
    cross_attention: float
    modulation: float  # 0 once folded
    weight_bytes: float  # every weight of the blocks once
    cache_bytes: float  # visible keys and values once, the block's own written

    @property
    def flops(self) -> float:
        """All of it."""
        return self.linear + self.self_attention + self.cross_attention + self.modulation


def forward_work(
    sizes: DiTSizes,
    tokens: int,
    latents: int = 2,
    window: int = 6,
    text_tokens: int = 1,
    folded: bool = True,
    width_bytes: int = 2,
    batch: int = 1,
    mapped: bool = True,
) -> ForwardWork:
    """Return the work of one steady-state forward from the network's sizes.

    Args:
        sizes: Of the network.
        tokens: Of one latent: ``height / 16 * width / 16`` in pixels.
        latents: Of the block.
        window: Latents in sight, own block included.
        text_tokens: Of the prompt; its keys and values are made once and not counted. A single token needs no attention.
        folded: Whether the modulation is folded away.
        width_bytes: Bytes of a weight, and of a cached number.
        batch: Views side by side.
        mapped: Whether a semantic map is embedded (by its own product; a map of zeros is not skipped).
    """
    d, f, c, n = sizes.width, sizes.mlp_width, sizes.latent_channels, sizes.blocks
    q = latents * tokens * batch
    seen = max(window, latents) * tokens
    alone = text_tokens == 1  # the token's value is every query's answer, projected once
    cross = 2 * batch * d * d if alone else 4 * q * d * d
    linear = n * (8 * q * d * d + 4 * q * d * f + cross) + 2 * q * d * AREA * (2 * c + (sizes.map_channels if mapped else 0))
    cross_weights = d * d if alone else 2 * d * d
    per_block = 4 * d * d + 2 * d * f + cross_weights
    modulation = 0.0
    if not folded:
        steps, rank = 1, sizes.adaln_rank  # one time step for the whole block
        modulation = steps * (n * 3 * 2 * (d * rank + 3 * d * rank) + 2 * (d * d + 3 * d * d) + 2 * (d * rank + 2 * d * rank))
    return ForwardWork(
        linear=float(linear),
        self_attention=float(4 * n * q * seen * d),
        cross_attention=0.0 if alone else float(4 * n * q * text_tokens * d),
        modulation=float(modulation),
        weight_bytes=float(n * per_block * width_bytes),
        cache_bytes=float(2 * n * batch * (seen + latents * tokens) * d * width_bytes),
    )


def cache_bytes(sizes: DiTSizes, tokens: int, window: int, batch: int = 1, width_bytes: int = 2) -> int:
    """Return the bytes of a rolling cache, allocated once."""
    return 2 * sizes.blocks * batch * window * tokens * sizes.width * width_bytes


def compute_floor_s(ledger: Ledger, device: Device) -> float:
    """Return the seconds that the arithmetic of counted work takes at peak."""
    return sum(op.flops / device.peak(op.dtype) for op in ledger.ops if op.flops)


def eager_floor_s(ledger: Ledger, device: Device) -> float:
    """Return the seconds that counted work takes when every operation runs alone, at peak arithmetic or peak bandwidth."""
    return sum(max(op.flops / device.peak(op.dtype), op.bytes / device.bandwidth) for op in ledger.ops)
