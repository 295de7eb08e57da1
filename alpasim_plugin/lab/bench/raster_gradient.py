"""Measure the rasteriser's forward and backward pass: time beside the error of the gradient, on the
random street of `raster`.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.raster.gradient_types import Splats
from alpasim_plugin.gaussians.raster.rasterize_gradient import rasterize_gradient
from alpasim_plugin.gaussians.raster.rasterize_torch import GaussianTensors, rasterize_tensors
from alpasim_plugin.gaussians.sample_scene import driving_camera, driving_like_scene
from alpasim_plugin.lab.bench.raster import SKY

Size = tuple[int, int, int]  # Gaussians, width, height
SIZES: tuple[Size, ...] = ((10_000, 256, 144), (30_000, 256, 144), (100_000, 480, 272))
FIELDS = ("means", "log_scales", "quaternions", "logit_opacities", "sh")
_REFERENCE_LIMIT = (
    10_000 * 256 * 144
)  # Gaussians x pixels up to which the float64 reference fits into memory


@dataclass(frozen=True)
class GradientBenchRow:
    """Speed of one view's forward and backward pass, and the error of the same gradients.

    Attributes:
        n: Gaussians in the scene, all of their parameters with gradients, harmonics of degree 3.
        width: Pixels.
        height: Pixels.
        threads: Threads used.
        visible: Gaussians that reach the image.
        forward_ms: Median of the forward pass, squared error of the colours included.
        backward_ms: Median of the backward pass.
        ms_best: Fastest forward and backward pass together.
        ms_p50: Median of both together.
        cpu_ms: Processor time of both, all threads together, median: comparable on a busy machine
            too.
        error: Largest over the fields of ``|g - g64| / |g64|`` (Euclidean norms over a field) with
            ``g64`` from autograd of the torch rasteriser in float64; None where that does not fit
            into memory.
        reference_ms: One forward and backward pass of that reference; None likewise.
    """

    n: int
    width: int
    height: int
    threads: int
    visible: int
    forward_ms: float
    backward_ms: float
    ms_best: float
    ms_p50: float
    cpu_ms: float
    error: float | None
    reference_ms: float | None


def bench_gradients(
    sizes: Sequence[Size] = SIZES, repeats: int = 15, threads: Sequence[int] = (1, 2), seed: int = 0
) -> list[GradientBenchRow]:
    """Time both passes and compare the gradients with the reference.

    Args:
        sizes: ``(Gaussians, width, height)`` of each scene.
        repeats: Views timed per row, after one that is not.
        threads: Thread counts to time.
        seed: Seed of the scene.

    Returns:
        One row per size and thread count, in that order.
    """
    rows = []
    for n, width, height in sizes:
        scene, camera = driving_like_scene(n, seed), driving_camera(width, height)
        reference = _reference(scene, camera) if n * width * height <= _REFERENCE_LIMIT else None
        for count in threads:
            splats = Splats.from_cloud(scene)
            leaves = [getattr(splats, name).requires_grad_(True) for name in FIELDS]
            times = np.array([_pass(splats, leaves, camera, count) for _ in range(repeats + 1)])[1:]
            forward, backward, cpu = np.median(times, axis=0)
            both = times[:, 0] + times[:, 1]
            visible = int(
                (rasterize_gradient(splats, camera, threads=count).screen.radii > 0).sum()
            )
            error = (
                None
                if reference is None
                else max(_relative(a.grad, b) for a, b in zip(leaves, reference[0], strict=True))
            )
            rows.append(
                GradientBenchRow(
                    n,
                    width,
                    height,
                    count,
                    visible,
                    forward,
                    backward,
                    float(both.min()),
                    float(np.median(both)),
                    cpu,
                    error,
                    None if reference is None else reference[1],
                )
            )
    return rows


def _loss(rgb: Tensor) -> Tensor:
    """Return the squared difference to a fixed image of stripes: residuals differ from pixel to
    pixel and none is zero.
    """
    target = torch.linspace(0, 40, rgb.numel(), dtype=rgb.dtype).sin().abs().reshape(rgb.shape)
    return (rgb - target).square().sum()


def _pass(
    splats: Splats, leaves: list[Tensor], camera: PinholeCamera, threads: int
) -> tuple[float, float, float]:
    """Return the times of one forward pass, its backward pass, and the processor time of both,
    milliseconds.
    """
    for leaf in leaves:
        leaf.grad = None
    used, begin = time.process_time(), time.perf_counter()
    loss = _loss(
        rasterize_gradient(splats, camera, background=torch.tensor(SKY), threads=threads).rgb
    )
    middle = time.perf_counter()
    loss.backward()  # type: ignore[no-untyped-call]
    end = time.perf_counter()
    return (middle - begin) * 1e3, (end - middle) * 1e3, (time.process_time() - used) * 1e3


def _reference(scene: GaussianCloud, camera: PinholeCamera) -> tuple[list[Tensor], float]:
    """Return the gradients of the torch rasteriser in float64, in the order of FIELDS, and the time
    for them, milliseconds.
    """
    s = Splats.from_cloud(scene)
    leaves = [getattr(s, name).double().requires_grad_(True) for name in FIELDS]
    means, log_scales, quaternions, logits, sh = leaves
    begin = time.perf_counter()
    gaussians = GaussianTensors(means, quaternions, log_scales.exp(), logits.sigmoid(), sh)
    _loss(rasterize_tensors(gaussians, camera, torch.tensor(SKY)).rgb).backward()  # type: ignore[no-untyped-call]
    spent = (time.perf_counter() - begin) * 1e3
    gc.collect()
    return [leaf.grad for leaf in leaves if leaf.grad is not None], spent


def _relative(found: Tensor | None, expected: Tensor) -> float:
    assert found is not None
    return float((found.double() - expected).norm() / expected.norm())
