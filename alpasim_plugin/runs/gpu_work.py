"""What a frame costs a card at least: floating-point operations and bytes, counted without one, over
the card's peak rates (its roofline).

Operations are two a multiply-add, of products, convolutions and attention alone. Bytes are what
each of them reads and writes where everything between them is fused, and what a frame is made of
and results in.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils.flop_counter import FlopCounterMode

from alpasim_plugin.core.parts import find, unidentified
from alpasim_plugin.core.parts.source import load
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.network.pixel_generator import TORCH
from alpasim_plugin.fixers.pixel_fixer import GivenFrame, fix_frame, in_range
from alpasim_plugin.fixers.pixel_network import load_generator
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import ALPHA_MIN, EPS2D_PX2, TILE

SPLATS = 2_000_000
SIGMA_PX = 1.0  # of a splat in the image
OPACITY = 0.02  # so low that no splat hides another: every pair of splat and tile is blended
# Operations of `triton_kernels.project` a splat, and of `composite` a splat and pixel.
PROJECT_FLOP = 420
BLEND_FLOP = 23
# Bytes of a splat's parameters, of what `project` writes of it, of a pair, of a pixel.
SPLAT_BYTES = 260
PROJECTED_BYTES = 64
PAIR_BYTES = 8
PIXEL_BYTES = 24

BLOCKS_BEFORE = 3  # until the attention window of six latents is full
BlockCall = Callable[[], Tensor]  # fixes one further block


@dataclass(frozen=True)
class Peak:
    """Dense peak rates of a card."""

    bf16_tflops: float
    fp32_tflops: float  # without TF32
    gb_s: float  # of its memory


# NVIDIA's data sheets, and its white paper of the Ada architecture, by the name that CUDA gives.
H100 = "NVIDIA H100 80GB HBM3"  # SXM
PEAKS = {
    "NVIDIA A100-PCIE-40GB": Peak(312, 19.5, 1555),
    "NVIDIA A100-SXM4-40GB": Peak(312, 19.5, 1555),
    "NVIDIA A100 80GB PCIe": Peak(312, 19.5, 1935),
    "NVIDIA A100-SXM4-80GB": Peak(312, 19.5, 2039),
    "NVIDIA H100 PCIe": Peak(756, 51, 2000),
    H100: Peak(989, 67, 3350),
    "NVIDIA H200": Peak(989, 67, 4800),
    "NVIDIA L4": Peak(121, 30.3, 300),
    "NVIDIA L40S": Peak(362, 91.6, 864),
    "NVIDIA GeForce RTX 4090": Peak(165.2, 82.6, 1008),
}


@dataclass(frozen=True)
class Work:
    """Floating-point operations by precision, and bytes read and written."""

    bf16_flop: int
    fp32_flop: int
    bytes: int

    def least_ms(self, card: str) -> float | None:
        """Return the time that a card takes at its peak rates, None where they are not known."""
        if card not in PEAKS:
            return None
        peak = PEAKS[card]
        flop_ms = self.bf16_flop / peak.bf16_tflops / 1e9 + self.fp32_flop / peak.fp32_tflops / 1e9
        return round(max(flop_ms, self.bytes / peak.gb_s / 1e6), 3)

    @property
    def facts(self) -> dict[str, Any]:
        """What a report says of it."""
        return {
            "gflop": round((self.bf16_flop + self.fp32_flop) / 1e9, 2),
            "gb": round(self.bytes / 1e9, 3),
        }


class _Counter(TorchFunctionMode):
    """Counts what runs inside ``with counter.flop, counter:``."""

    def __init__(self) -> None:
        super().__init__()
        self.flop = FlopCounterMode(display=False)
        self.by_type: Counter[torch.dtype] = Counter()
        self.bytes = 0

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        options = kwargs or {}
        before = self.flop.get_total_flops()
        made = func(*args, **options)
        flop = self.flop.get_total_flops() - before
        if flop:
            self.by_type[made.dtype] += flop
            self.bytes += bytes_of(*args, *options.values(), made)
        return made

    def work(self) -> Work:
        """Return the sums."""
        return Work(self.by_type[torch.bfloat16], self.by_type[torch.float32], self.bytes)


def bytes_of(*parts: Any) -> int:
    """Return the bytes of tensors among values."""
    return sum(part.nbytes for part in parts if isinstance(part, Tensor))


def fixer_work(cameras: int, width: int, height: int) -> Work:
    """Count a frame of ``onefixer`` with two recorded images a camera."""
    settings = fixer_settings("onefixer")
    assert isinstance(settings, PixelFixerSettings)
    loaded = load_generator(settings)
    net = copy.deepcopy(loaded.net).to("meta")
    image = torch.empty((cameras, height, width, 3), dtype=torch.uint8, device="meta")
    references = torch.empty((cameras, 2, height, width, 4), dtype=torch.uint8, device="meta")
    scale = settings.scale_of(height, width)
    state = net.start(in_range(image, scale), scale)
    given = GivenFrame(image, image, image, *state, None, image, references)
    counter = _Counter()
    with counter.flop, counter:
        fixed = fix_frame(replace(loaded, net=net, operations=TORCH), settings, given)
    work = counter.work()
    return replace(work, bytes=work.bytes + bytes_of(*given, *fixed))


def block_calls(name: str, history: str, width: int, height: int, device: str) -> BlockCall:
    """Return a call that fixes one further block of a block generator, with random weights."""
    spec = unidentified("fixer", name, (f"history={history}",))
    call: BlockCall = load(find("fixer", name).target, "fixer").drawn_blocks(
        spec.settings, width, height, device
    )
    return call


def block_work(name: str, history: str, width: int, height: int) -> Work:
    """Count a block once the attention window is full."""
    fix = block_calls(name, history, width, height, "meta")
    for _ in range(BLOCKS_BEFORE):
        fix()
    counter = _Counter()
    with counter.flop, counter:
        fix()
    return counter.work()


def raster_work(width: int, height: int) -> Work:
    """Count a frame of `transparent_splats`; lists of pairs are not sorted for nothing, but by how
    many passes is the card's affair: they are written and read once here.
    """
    half_px = np.sqrt(2 * np.log(OPACITY / ALPHA_MIN) * (SIGMA_PX**2 + EPS2D_PX2))
    pairs = int(SPLATS * (1 + 2 * half_px / TILE) ** 2)
    flop = SPLATS * PROJECT_FLOP + pairs * TILE * TILE * BLEND_FLOP
    moved = SPLATS * (SPLAT_BYTES + 2 * PROJECTED_BYTES) + pairs * 2 * PAIR_BYTES
    return Work(0, flop, moved + width * height * PIXEL_BYTES)


def transparent_splats(width: int, height: int) -> tuple[GaussianCloud, PinholeCamera]:
    """Return small splats all over the image of a camera with a narrow view."""
    rng = stream("gpu-check", 0, "transparent splats")
    focal_px = 10.0 * width
    K = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    depths = rng.uniform(2, 50, SPLATS)
    uv = rng.uniform([0, 0], [width, height], (SPLATS, 2)) - K[:2, 2]
    cloud = GaussianCloud(
        np.column_stack([uv * depths[:, None] / focal_px, depths]),
        np.tile(np.array([1.0, 0, 0, 0], np.float32), (SPLATS, 1)),
        np.repeat(SIGMA_PX * depths[:, None] / focal_px, 3, axis=1),
        np.full(SPLATS, OPACITY),
        np.zeros((SPLATS, 16, 3), np.float32),
    )
    return cloud, PinholeCamera(width, height, K, np.eye(4))
