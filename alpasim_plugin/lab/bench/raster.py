"""Measure the rasterisers: time beside error, on a random scene with the statistics of a street."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.raster.prepared import Node, prepare
from alpasim_plugin.gaussians.raster.rasterize_cpu import rasterize_prepared
from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from alpasim_plugin.gaussians.sample_scene import driving_camera, driving_like_scene
from alpasim_plugin.lab.bench.raster_roofline import RasterWork, measure_core

Size = tuple[int, int, int, int]  # Gaussians, cameras, width, height
SIZES: tuple[Size, ...] = (
    (30_000, 1, 256, 144),
    (100_000, 1, 256, 144),
    (100_000, 1, 480, 272),
    (100_000, 6, 480, 272),
    (100_000, 1, 960, 540),
    (500_000, 1, 960, 540),
)
SKY = (0.5, 0.6, 0.8)
_LSB = 1.0 / 255.0
_TORCH_LIMIT = 100_000 * 256 * 144  # Gaussians x pixels up to which the torch backend is timed too


@dataclass(frozen=True)
class BenchRow:
    """Speed of one scene at one size, and the error of the same image.

    Attributes:
        n: Gaussians in the scene.
        cameras: Images of a frame, around the same place.
        width: Pixels.
        height: Pixels.
        threads: Threads used.
        visible: Gaussians that reach an image, summed over the images.
        pairs: (Gaussian, 16-pixel tile) pairs.
        blends: Splats blended into a pixel, over all pixels; counted on the reference.
        ms_best: Fastest frame of the prepared scene, all its images one after the other.
        ms_p50: Median time of a frame.
        ms_p95: 95th percentile of it.
        cpu_ms: Processor time of a frame, all threads together: comparable on a busy machine too.
        floor_ms: Least time of one core for the work (`raster_roofline`).
        of_floor: Share of ``cpu_ms`` that the floor is.
        first_ms: Preparing the scene and drawing the first frame, including compiling or loading
            kernels.
        max_error: Largest difference of a colour from the float64 reference, full scale 1.
        share_above_lsb: Share of the pixels that differ by more than 1/255.
        torch_ms: One frame of the torch backend; None where the scene is too large for it.
    """

    n: int
    cameras: int
    width: int
    height: int
    threads: int
    visible: int
    pairs: int
    blends: int
    ms_best: float
    ms_p50: float
    ms_p95: float
    cpu_ms: float
    floor_ms: float
    of_floor: float
    first_ms: float
    max_error: float
    share_above_lsb: float
    torch_ms: float | None


def bench_raster(
    sizes: Sequence[Size] = SIZES, repeats: int = 20, threads: Sequence[int] = (1, 2), seed: int = 0
) -> list[BenchRow]:
    """Time the CPU rasteriser and compare its images with the float64 reference, which takes about
    75 us per visible Gaussian.

    Args:
        sizes: ``(Gaussians, cameras, width, height)`` of each scene.
        repeats: Frames timed per row.
        threads: Thread counts to time.
        seed: Seed of the scene.

    Returns:
        One row per size and thread count, in that order.
    """
    core = measure_core()
    rows = []
    for n, count, width, height in sizes:
        scene = driving_like_scene(n, seed)
        cameras = [driving_camera(width, height, 2.0 * np.pi * k / count) for k in range(count)]
        references = [rasterize_reference(scene, camera, SKY) for camera in cameras]
        blends = sum(one.stats["blends"] for one in references)
        torch_ms = (
            _torch_ms(scene, cameras[0]) if count * n * width * height <= _TORCH_LIMIT else None
        )
        for used in threads:
            begin = time.perf_counter()
            nodes = [(prepare(scene), None)]
            out = _frame(nodes, cameras, used)
            first_ms = (time.perf_counter() - begin) * 1e3
            began = time.process_time()
            times = _times_ms(partial(_frame, nodes, cameras, used), repeats)
            cpu_ms = (time.process_time() - began) / repeats * 1e3
            visible = sum(one.stats["visible"] for one in out)
            floor_ms = RasterWork(
                visible, blends, count * width * height, scene.sh.shape[1]
            ).floor_ms(core)
            error = np.array(
                [
                    np.abs(mine.rgb - theirs.rgb).max(axis=2)
                    for mine, theirs in zip(out, references, strict=True)
                ]
            )
            rows.append(
                BenchRow(
                    n,
                    count,
                    width,
                    height,
                    used,
                    visible,
                    sum(one.stats["pairs"] for one in out),
                    blends,
                    min(times),
                    float(np.median(times)),
                    float(np.percentile(times, 95)),
                    cpu_ms,
                    floor_ms,
                    floor_ms / cpu_ms,
                    first_ms,
                    float(error.max()),
                    float(np.mean(error > _LSB)),
                    torch_ms,
                )
            )
    return rows


def _frame(
    nodes: Sequence[Node], cameras: Sequence[PinholeCamera], threads: int
) -> list[RasterOutput]:
    return [rasterize_prepared(nodes, camera, SKY, threads=threads) for camera in cameras]


def _times_ms(call: Callable[[], object], repeats: int) -> list[float]:
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append((time.perf_counter() - begin) * 1e3)
    return times


def _torch_ms(scene: GaussianCloud, camera: PinholeCamera) -> float:
    # Imported on use: the table without this column needs no torch.
    from alpasim_plugin.gaussians.raster.rasterize_torch import rasterize_torch

    def draw() -> RasterOutput:
        return rasterize_torch(scene, camera, SKY)

    return min(_times_ms(draw, 2))
