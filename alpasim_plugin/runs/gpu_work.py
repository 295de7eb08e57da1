"""What a card does in the rates of `gpu_check`, and its work at least: floating-point operations and
bytes, over the card's peak rates (its roofline).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud

SPLATS = 2_000_000
OPACITY = 0.02  # so low that no splat hides another: every pair of splat and tile is blended
DISTANCE_M = 10.0

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


class Work(NamedTuple):
    """What is computed, and what is read and written."""

    gflop: float
    gb: float
    precision: Literal["fp32", "bf16"] = "fp32"

    def least_ms(self, card: str) -> float:
        """Return the time that a card of `PEAKS` takes at its peak rates."""
        bf16, fp32, memory = PEAKS[card]
        rate = bf16 if self.precision == "bf16" else fp32
        return round(max(self.gflop / rate, 1e3 * self.gb / memory), 3)


# As the laboratory counts them (docs/experiments/gpu.md): a frame of `transparent_splats` at 1920x1080, and at
# 960x544 a frame of ``onefixer`` with two recorded images a camera.
COUNTED = {
    "splats": Work(19.45, 0.959),
    "cameras: 1": Work(2.06, 0.086),
    "cameras: 6": Work(12.36, 0.498),
}


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
        np.zeros((SPLATS, 16, 3), dtype=np.float32),
    )
    K = np.diag([DISTANCE_M * width, DISTANCE_M * width, 1])
    return cloud, PinholeCamera(width, height, K, np.eye(4))
