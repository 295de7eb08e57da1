"""Time a fixer stage by stage over a recorded clip, with the memory it takes.

Passes without any clock give the all-in times, further passes with a clock at every stage give the
stages.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
import torch

from alpasim_plugin.block_fixers.onefixer import OneFixer
from alpasim_plugin.block_fixers.pipeline import TIMED, StageClock, no_clock
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.whole_clip import Clip
from alpasim_plugin.core.processes import resident_mb
from alpasim_plugin.core.types import U8, Bool

MB = 1e6


@dataclass
class Timing:
    """What one setting cost; milliseconds per frame, one entry per block of steady state.

    Attributes:
        load_ms: Networks from nothing to ready.
        first_ms: Very first block, all-in, whole: buffers are made and kernels chosen.
        all_in: Blocks after the first, frames in to frames out.
        cpu: Processor time of the same, all threads together: what remains comparable on a busy
            machine, best with one thread.
        stages: By stage, from a pass of its own.
        peak_mb: Largest resident memory (device memory on an accelerator) beyond what the process
            held before the networks; None where the system does not tell.
        images: ``(T, H, W, 3)`` uint8 output of the first pass.
        guarded: ``(T,)`` whether the guard passed the raw frame on instead.
    """

    load_ms: float
    first_ms: float
    all_in: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in TIMED})
    peak_mb: float | None = None
    images: U8 = field(default_factory=lambda: np.zeros((0, 0, 0, 3), np.uint8))
    guarded: Bool = field(default_factory=lambda: np.zeros(0, np.bool_))


def measure(
    settings: OneFixerSettings,
    clip: Clip,
    scene_id: str,
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
    passes: int = 2,
) -> Timing:
    """Run a fixer over a clip and time it.

    Args:
        settings: The fixer.
        clip: What it is given, block by block.
        scene_id, seed: Key of the noise.
        device, threads: Where, and with how many threads.
        passes: Runs over the clip without and with clocks at the stages, each. The first block
            counts once, in the first pass.

    Returns:
        Times, memory and the first pass's images.
    """
    before_mb = resident_mb("VmRSS") if device == "cpu" else 0.0
    clock = StageClock(device)
    begin = clock.now()
    fixer = OneFixer(settings, scene_id, seed, device, threads)
    timing = Timing((clock.now() - begin) * 1e3, 0.0)
    images: list[U8] = []
    guarded: list[bool] = []
    for run in range(2 * passes):
        stages = run >= passes
        fixer.pipeline.stage = clock if stages else no_clock
        fixer.reset(seed)
        for index, (frames, maps) in enumerate(clip.blocks(fixer.blocks.frames)):
            begin, used = clock.now(), time.process_time()
            fixed = fixer.step(frames, maps)
            ms = (clock.now() - begin) * 1e3
            cpu_ms = (time.process_time() - used) * 1e3
            taken = clock.take()
            if index and stages:
                for name in timing.stages:
                    timing.stages[name].append(taken[name] / len(frames))
            elif index:
                timing.all_in.append(ms / len(frames))
                timing.cpu.append(cpu_ms / len(frames))
            elif not run:
                timing.first_ms = ms
            if not run:
                images += [frame.rgb for frame in fixed]
                guarded += [bool(frame.events) for frame in fixed]
        if run == passes - 1:
            peak_mb = (
                resident_mb("VmHWM")
                if device == "cpu"
                else torch.cuda.max_memory_allocated(device) / MB
            )
            timing.peak_mb = None if peak_mb is None or before_mb is None else peak_mb - before_mb
    timing.images, timing.guarded = np.stack(images), np.array(guarded)
    return timing
