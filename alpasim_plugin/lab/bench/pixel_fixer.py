"""Time the per-frame generator setting by setting, with the error of the same images beside it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from alpasim_plugin.block_fixers.whole_clip import Clip
from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.processes import resident_mb
from alpasim_plugin.core.types import U8
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.pixel_fixer import PixelFixer
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.bench.fixer_rows import (
    SCENE,
    BenchOptions,
    Case,
    Row,
    difference,
    in_own_process,
    p50_p95,
)
from alpasim_plugin.lab.bench.fixer_speed import MB, Timing

CASES = (
    Case("precision", "float32", ("precision=fp32",)),
    Case("precision", "bfloat16", ("precision=bf16",)),
    Case("guard", "off", ("precision=fp32", "keep_render=false")),
    Case("source", "render in the holes", ("precision=fp32", "holes=render")),
    Case("cameras", "three in a batch", ("precision=fp32",)),
)
BASE = CASES[0]
TOGETHER = 3  # cameras of the last case


def bench_clip(
    options: BenchOptions,
    settings: PixelFixerSettings,
    clip: Clip,
    on_row: Callable[[Row], None] = lambda row: None,
    own_process: bool = True,
) -> list[Row]:
    """Measure every setting on one clip.

    Args:
        options: How.
        settings: Of the base; each case changes its own.
        clip: Frames and maps of a rollout.
        on_row: Called with every finished row.
        own_process: Measure every row in a fresh process, so that memory and first calls are its
            own.

    Returns:
        One row per setting. ``rounding`` is the error against the same setting in float32,
        ``model`` against the base.
    """
    rows: list[Row] = []
    weights = settings.untrained if settings.weights.bundle is None else "given"
    exact: dict[PixelFixerSettings, U8] = {}
    for case in filter(options.includes, CASES):
        row = Row(case.group, case.name, weights, (clip.rgb.shape[2], clip.rgb.shape[1]), 0, {})
        try:
            mine = _changed(options, settings, case)
            plain = mine.model_copy(update={"precision": "fp32"})
            for needed in (plain, base := _changed(options, settings, BASE)):
                if needed not in exact:
                    exact[needed] = measure(
                        needed, clip, options.seed, "cpu", options.threads, 1
                    ).images
            cameras = TOGETHER if case.group == "cameras" else 1
            arguments = (
                mine,
                clip,
                options.seed,
                options.device,
                options.threads,
                options.passes,
                cameras,
            )
            timing = (
                in_own_process(settings.name, measure, *arguments)
                if own_process
                else measure(*arguments)
            )
        except SimrunError as error:
            rows.append(replace(row, problem=error.message))
        else:
            fixed = ~timing.guarded
            rows.append(
                replace(
                    row,
                    frames=len(timing.images),
                    ms=p50_p95({"all-in": timing.all_in, "cpu": timing.cpu}),
                    first_ms=timing.first_ms,
                    load_ms=timing.load_ms,
                    peak_mb=timing.peak_mb,
                    rounding=difference(timing.images[fixed], exact[plain][fixed]),
                    model=difference(timing.images[fixed], exact[base][fixed]),
                    guarded=int(timing.guarded.sum()),
                )
            )
        on_row(rows[-1])
    return rows


def measure(
    settings: PixelFixerSettings,
    clip: Clip,
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
    passes: int = 2,
    cameras: int = 1,
) -> Timing:
    """Run the fixer over a clip and time it; milliseconds per frame of one camera.

    Args:
        settings: The fixer.
        clip: What every camera sees.
        seed: Of the noise.
        device, threads: Where, and with how many threads.
        passes: Runs over the clip.
        cameras: How many go through together.
    """
    before_mb = resident_mb("VmRSS") if device == "cpu" else 0.0
    begin = time.perf_counter()
    fixer = PixelFixer(settings, SCENE, seed, device, threads)
    timing = Timing((time.perf_counter() - begin) * 1e3, 0.0, stages={})
    images: list[U8] = []
    guarded: list[bool] = []
    names = [clip.camera, *(f"{clip.camera}-{i}" for i in range(1, cameras))]
    for run in range(passes):
        fixer.reset(seed)
        for index, (frame, sdmap) in enumerate(zip(clip.frames(), clip.maps, strict=True)):
            block, maps = [replace(frame, camera=name) for name in names], [sdmap] * cameras
            _wait(device)
            begin, used = time.perf_counter(), time.process_time()
            fixed = fixer.step(block, maps)
            _wait(device)
            ms, cpu_ms = (time.perf_counter() - begin) * 1e3, (time.process_time() - used) * 1e3
            if index:
                timing.all_in.append(ms / cameras)
                timing.cpu.append(cpu_ms / cameras)
            elif not run:
                timing.first_ms = ms
            if not run:
                images.append(fixed[0].rgb)
                guarded.append(bool(fixed[0].events))
    peak_mb = (
        resident_mb("VmHWM") if device == "cpu" else torch.cuda.max_memory_allocated(device) / MB
    )
    timing.peak_mb = None if peak_mb is None or before_mb is None else peak_mb - before_mb
    timing.images, timing.guarded = np.stack(images), np.array(guarded)
    return timing


def _changed(options: BenchOptions, settings: PixelFixerSettings, case: Case) -> PixelFixerSettings:
    changed = fixer_settings(options.name, (*options.overrides, *case.overrides))
    assert isinstance(changed, type(settings)), "cases change values, not the kind of fixer"
    return changed


def _wait(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize(device)
