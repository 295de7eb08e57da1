"""What a night of many rollouts needs: cores, GPUs, bytes, money, and which of them runs out first.

    python docs/scripts/scale_night.py
    python docs/scripts/scale_night.py --renderer 2b --gpu-hour 2.0 --hours 12

Every number that goes in is an option; the defaults were measured here (docs/experiments/scale.md),
except prices, which are assumptions to be replaced by your own.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Renderer:
    """What a rollout costs behind a renderer.

    Attributes:
        frame_core_ms: Core time of the whole loop, a camera frame.
        frame_gpu_ms: GPU time, a camera frame.
        note: Where it was measured.
    """

    frame_core_ms: float
    frame_gpu_ms: float
    note: str


RENDERERS = {
    "3dgs": Renderer(
        19.0, 0.0, "3dgs and lane-camera at 256x144, one core (experiments/clean-and-3dgs.md)"
    ),
    "onefixer": Renderer(
        46.0, 0.0, "onefixer over 3dgs and lane-camera at 256x144, one core (speed-and-error.md)"
    ),
    "2b": Renderer(
        9.0,
        101.0 / 8.0,
        "onefixer-2b, window 12, finalise, computed for an H200: 101 ms a block of 8 frames (gpu.md), rendering not included",
    ),
}
TERA = 1e12


@dataclass(frozen=True)
class Night:
    """The question, and what was measured.

    Attributes:
        rollouts: To drive.
        hours: Time for it.
        frames: Camera frames of a rollout.
        start_core_s: Core time of a rollout outside of its frames: scene, scoring, files.
        driver_core_ms: Core time of the driver for a rollout, its tables and reports included.
        driver_kb: Memory of the driver for a rollout.
        rollout_mb: Bytes of a rollout on disk.
        rollout_files: Files of a rollout.
        efficiency: Share of the cores' time that drives.
        driver_mb_s: Bytes that one driver takes in, a second.
        core_hour, gpu_hour, gb_month: Prices, any currency.
    """

    rollouts: int = 1_000_000
    hours: float = 10.0
    frames: int = 70
    start_core_s: float = 4.1
    driver_core_ms: float = 6.0
    driver_kb: float = 16.0
    rollout_mb: float = 2.2
    rollout_files: int = 5
    efficiency: float = 0.9
    driver_mb_s: float = 20.0
    core_hour: float = 0.04
    gpu_hour: float = 3.0
    gb_month: float = 0.023


def table(night: Night, renderer: Renderer) -> list[tuple[str, str, str]]:
    """Return what is needed: quantity, value, how it was computed."""
    n, seconds = night.rollouts, night.hours * 3600.0
    core_s = night.start_core_s + night.frames * renderer.frame_core_ms * 1e-3
    gpu_s = night.frames * renderer.frame_gpu_ms * 1e-3
    cores, gpus = (
        math.ceil(n * core_s / seconds / night.efficiency),
        math.ceil(n * gpu_s / seconds / night.efficiency),
    )
    total_tb = n * night.rollout_mb * 1e6 / TERA
    rate_mb_s = n * night.rollout_mb / seconds
    drivers = {
        "bytes": rate_mb_s / night.driver_mb_s,
        "core time": n * night.driver_core_ms * 1e-3 / seconds,
        "memory of 16 GB": n * night.driver_kb * 1e3 / 16e9,
    }
    first, shares = (
        max(drivers, key=lambda name: drivers[name]),
        ", ".join(f"{name} {share:.2f}" for name, share in drivers.items()),
    )
    cost_cores, cost_gpus = (
        n * core_s / 3600.0 / night.efficiency * night.core_hour,
        n * gpu_s / 3600.0 / night.efficiency * night.gpu_hour,
    )
    return [
        (
            "core time of a rollout",
            f"{core_s:.2f} s",
            f"{night.start_core_s:g} s + {night.frames} frames x {renderer.frame_core_ms:g} ms",
        ),
        (
            "GPU time of a rollout",
            f"{gpu_s:.2f} s",
            f"{night.frames} frames x {renderer.frame_gpu_ms:.1f} ms",
        ),
        (
            "cores",
            f"{cores:,}",
            f"{n:,} rollouts in {night.hours:g} h at an efficiency of {night.efficiency:g}",
        ),
        ("GPUs", f"{gpus:,}", "the same"),
        ("rollouts a second", f"{n / seconds:.1f}", ""),
        ("bytes", f"{total_tb:.2f} TB", f"{night.rollout_mb:g} MB a rollout"),
        (
            "files",
            f"{n * night.rollout_files / 1e6:.1f} million",
            f"{night.rollout_files} a rollout, and a folder",
        ),
        ("writing", f"{rate_mb_s:.0f} MB/s", "all workers together"),
        ("drivers", f"{math.ceil(max(drivers.values()))}", f"first by {first}; {shares}"),
        ("cost of cores", f"{cost_cores:,.0f}", f"{night.core_hour:g} a core-hour"),
        ("cost of GPUs", f"{cost_gpus:,.0f}", f"{night.gpu_hour:g} a GPU-hour"),
        (
            "cost of keeping it a month",
            f"{total_tb * 1e3 * night.gb_month:,.0f}",
            f"{night.gb_month:g} a GB-month",
        ),
    ]


def main() -> None:
    """Read the command line and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--renderer", choices=[*RENDERERS, "all"], default="all")
    for name, default in Night.__dataclass_fields__.items():
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=type(default.default), default=default.default
        )
    chosen = vars(parser.parse_args())
    names = list(RENDERERS) if chosen["renderer"] == "all" else [chosen["renderer"]]
    night = Night(**{name: chosen[name] for name in Night.__dataclass_fields__})
    for name in names:
        print(f"\n{name}: {RENDERERS[name].note}")
        for quantity, value, how in table(night, RENDERERS[name]):
            print(f"  {quantity:<28}{value:>14}  {how}")


if __name__ == "__main__":
    main()
