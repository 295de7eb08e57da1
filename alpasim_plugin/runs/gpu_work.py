"""What a frame costs a card at least: floating-point operations and bytes, counted without one, over
the card's peak rates (its roofline).

Operations are two a multiply-add, of products, convolutions and attention alone. Bytes are what
each of them reads and writes where everything between them is fused, and what a frame is made of
and results in.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils.flop_counter import FlopCounterMode

from alpasim_plugin.core.parts import find
from alpasim_plugin.core.parts.source import load
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.network.pixel_generator import TORCH
from alpasim_plugin.fixers.pixel_fixer import GivenFrame, fix_frame, in_range
from alpasim_plugin.fixers.pixel_network import load_generator
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import TILE

SPLATS = 2_000_000
OPACITY = 0.02  # so low that no splat hides another: every pair of splat and tile is blended
DISTANCE_M = 10.0
PAIRS = 1.58  # of a splat and tiles: (1 + 2 h / 16)^2 for h = 2.06 px, where its alpha is 1/255
# Operations of `triton_kernels.project` a splat, and of `composite` a splat and pixel.
PROJECT_FLOP = 420
BLEND_FLOP = 23
# Bytes of a splat that is read, projected, and read again; of a pair of splat and tile that is
# listed, sorted and read; of a pixel.
SPLAT_BYTES = 260 + 2 * 72
PAIR_BYTES = 4 * 8
PIXEL_BYTES = 24
BLOCKS_BEFORE = 3  # until an attention window of six latents is full

# Dense TFLOP/s of bfloat16 and of float32 without TF32, and GB/s of the memory, by the name that
# CUDA gives: NVIDIA's data sheets, and its white paper of the Ada architecture.
H100 = "NVIDIA H100 80GB HBM3"  # SXM
PEAKS = {
    "NVIDIA A100-PCIE-40GB": (312, 19.5, 1555),
    "NVIDIA A100-SXM4-40GB": (312, 19.5, 1555),
    "NVIDIA A100 80GB PCIe": (312, 19.5, 1935),
    "NVIDIA A100-SXM4-80GB": (312, 19.5, 2039),
    "NVIDIA H100 PCIe": (756, 51, 2000),
    H100: (989, 67, 3350),
    "NVIDIA H200": (989, 67, 4800),
    "NVIDIA L4": (121, 30.3, 300),
    "NVIDIA L40S": (362, 91.6, 864),
    "NVIDIA GeForce RTX 4090": (165.2, 82.6, 1008),
}


Precision = Literal["fp32", "bf16"]


class Work(NamedTuple):
    """What is computed, and what is read and written."""

    gflop: float
    gb: float
    precision: Precision = "fp32"

    def least_ms(self, card: str) -> float:
        """Return the time that a card of `PEAKS` takes at its peak rates."""
        bf16, fp32, memory = PEAKS[card]
        rate = bf16 if self.precision == "bf16" else fp32
        return round(max(self.gflop / rate, 1e3 * self.gb / memory), 3)


class _Counter(TorchFunctionMode):
    """Counts products, convolutions and attention; use it inside ``with counter.flop, counter``."""

    def __init__(self) -> None:
        super().__init__()
        self.flop = FlopCounterMode(display=False)
        self.bytes = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        options = kwargs or {}
        before = self.flop.get_total_flops()
        made = func(*args, **options)
        if self.flop.get_total_flops() > before:
            self.bytes += bytes_of(*args, *options.values(), made)
        return made


def bytes_of(*parts: Any) -> int:
    """Return the bytes of the tensors among values."""
    return sum(part.nbytes for part in parts if isinstance(part, Tensor))


def counted(
    call: Callable[[], Any],
    precision: Precision = "fp32",
    given: Sequence[Any] = (),
) -> Work:
    """Return the work of a call, with the bytes of what it is given and returns."""
    counter = _Counter()
    with counter.flop, counter:
        made = call()
    moved = counter.bytes + bytes_of(*given, *made)
    return Work(round(counter.flop.get_total_flops() / 1e9, 2), round(moved / 1e9, 3), precision)


def fixer_work(cameras: int, width: int, height: int) -> Work:
    """Count a frame of ``onefixer`` with two recorded images a camera."""
    settings: Any = fixer_settings("onefixer")
    loaded = load_generator(settings)
    on_meta = replace(loaded, net=copy.deepcopy(loaded.net).to("meta"), operations=TORCH)
    image = torch.empty((cameras, height, width, 3), dtype=torch.uint8, device="meta")
    references = image.new_empty((cameras, 2, height, width, 4))
    seen = TORCH.smaller(image, settings.scale_of(height, width))
    given = GivenFrame(image, *on_meta.net.start(in_range(seen)), None, image, references)
    return counted(lambda: fix_frame(on_meta, settings, given), given=given)


def blocks(history: str, width: int, height: int, device: str) -> tuple[int, Callable[[], Tensor]]:
    """Return the number of weights of ``onefixer-2b``, drawn on a device, and a call that fixes one
    further block with a full attention window.
    """
    settings = fixer_settings("onefixer-2b", [f"history={history}"])
    factory = load(find("fixer", settings.name).target, "fixer")
    weights, fix = load(factory.drawn_blocks, "fixer")(settings, width, height, device)
    for _ in range(BLOCKS_BEFORE):
        fix()
    return weights, fix


def raster_work(width: int, height: int) -> Work:
    """Count a frame of `transparent_splats`."""
    pairs = PAIRS * SPLATS
    flop = SPLATS * PROJECT_FLOP + pairs * TILE**2 * BLEND_FLOP
    moved = SPLATS * SPLAT_BYTES + pairs * PAIR_BYTES + width * height * PIXEL_BYTES
    return Work(round(flop / 1e9, 2), round(moved / 1e9, 3))


def transparent_splats(width: int, height: int) -> tuple[GaussianCloud, PinholeCamera]:
    """Return splats of one pixel's standard deviation all over the image of a camera."""
    px_m = 1 / width  # the image is one metre wide at their distance
    high = [1.0, height * px_m, DISTANCE_M + 0.01]
    rng = stream("gpu-check", 0, "transparent splats")
    cloud = GaussianCloud(
        rng.uniform([0, 0, DISTANCE_M], high, (SPLATS, 3)),
        np.tile([1.0, 0, 0, 0], (SPLATS, 1)),
        np.full((SPLATS, 3), px_m),
        np.full(SPLATS, OPACITY),
        np.zeros((SPLATS, 16, 3), np.float32),
    )
    K = np.diag([DISTANCE_M * width, DISTANCE_M * width, 1])
    return cloud, PinholeCamera(width, height, K, np.eye(4))
