"""What does a frame of the fixer cost on one thread, and what do the warps of its references?

python docs/scripts/reference_cost.py data/pairs --precision bf16

Median over the last frames of every second clip, on an otherwise idle machine. Code for AVX2 on a
processor that has more: set ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2 NUMBA_CPU_NAME=haswell
before.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np
import torch

from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.lab.bench.quality import QualityClip, fixer_input
from alpasim_plugin.lab.bench.quality_run import quality_clip
from alpasim_plugin.lab.training.pair_store import PairDataset

FRAMES, WARM = (
    30,
    21,
)  # of a clip; before that many a network is not yet recorded and caches are cold


def times_ms(clips: list[QualityClip], settings: tuple[str, ...]) -> tuple[float, float]:
    """Return the median time of the fixer and of what prepares its frame, milliseconds."""
    spec = resolve("fixer", "onefixer", settings)
    assert isinstance(spec.settings, FixerSettings)
    fixing, preparing = [], []
    for clip in clips:
        session = build(spec, scene_id=clip.name, seed=0, device="cpu", threads=1)
        frames, started = fixer_input(clip, spec.settings), time.perf_counter()
        for i, (frame, sdmap) in enumerate(frames):
            ready = time.perf_counter()
            session.step([frame], [] if sdmap is None else [sdmap])
            done = time.perf_counter()
            if i >= WARM:
                preparing.append(ready - started)
                fixing.append(done - ready)
            started = done
    return 1e3 * float(np.median(fixing)), 1e3 * float(np.median(preparing))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data")
    parser.add_argument("--split", default="val")
    parser.add_argument("--precision", default="auto", choices=["auto", "fp32", "bf16"])
    asked = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    clips = [
        quality_clip(one).first(FRAMES)
        for one in PairDataset(asked.data, asked.split).sequences[::2]
    ]
    precision = f"precision={asked.precision}"
    none, read = times_ms(clips, ("references=0", precision))
    two, warped = times_ms(clips, (precision,))
    print(
        f"{asked.precision}: {none:.1f} ms without references; {two:.1f} with two, and {warped - read:.1f} for their warps"
    )


if __name__ == "__main__":
    main()
