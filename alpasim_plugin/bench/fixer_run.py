"""The fixer's bench, whole: a clip from a real drive, every setting on it, and drives in both modes of the closed loop."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from alpasim_plugin.bench.fixer import SCENE, BenchOptions, Case, Row, Settings, bench_clip, difference, spread
from alpasim_plugin.bench.fixer_drive import DriveSample, drive
from alpasim_plugin.errors import SimrunError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.reference import whole_clip
from alpasim_plugin.runtime.provenance import hardware, versions

DRIVEN = "smoke/lead_car"  # a curve, a car ahead and one that comes the other way
# Pictures must be fit to drive by: an identity's where the fixer has no weights of its own.
LOOPS = (
    Case("mode", "chunk", ("mode=chunk",), "identity"),
    Case("mode", "speculative", ("mode=speculative",), "identity"),
    Case("mode", "speculative, exact poses", ("mode=speculative", "tolerance_m=0", "tolerance_deg=0"), "identity"),
)


@dataclass(frozen=True)
class Bench:
    """What was measured, and on what.

    Attributes:
        rows: One per size and setting.
        facts: Fixer, scene, machine, load, versions.
    """

    rows: list[Row]
    facts: dict[str, Any]


def bench_fixer(
    options: BenchOptions, sizes: list[tuple[int, int]], frames: int, on_row: Callable[[Row], None] = lambda row: None, apart: bool = True
) -> Bench:
    """Measure a fixer at every size.

    Args:
        options: Which fixer and how.
        sizes: Widths and heights, pixels.
        frames: Least length of the drive; blocks are completed.
        on_row: Told of every row as it is done.
        apart: Measure every row in a process of its own.

    Raises:
        InputError: A fixer or settings that are not known.
    """
    before = os.getloadavg()[0]
    rows: list[Row] = []
    for size in sizes:
        with tempfile.TemporaryDirectory(prefix="simrun-bench-") as folder:
            settle = Settings(options, Path(folder))
            rows += bench_clip(options, recorded(options, frames, size).clip, on_row, apart)
            for case in filter(options.includes, LOOPS):
                rows.append(_loop_row(options, settle, case, frames, size))
                on_row(rows[-1])
    facts = {
        "fixer": options.name,
        "overrides": list(options.overrides),
        "scene": DRIVEN,
        "device": options.device,
        "threads": options.threads or torch.get_num_threads(),
        "passes": options.passes,
        "load_before_after": [round(before, 2), round(os.getloadavg()[0], 2)],
        "hardware": hardware(),
        "versions": versions(),
    }
    if options.device != "cpu":
        facts["accelerator"] = torch.cuda.get_device_name(options.device)
    return Bench(rows, facts)


def recorded(options: BenchOptions, frames: int, size: tuple[int, int]) -> DriveSample:
    """Drive the scene with nothing fixed, and keep what a fixer would have been given."""
    settings = fixer_settings("identity", ["mode=chunk", "uses_map=true"])
    return drive(DRIVEN, frames, size, settings, SCENE, seed=options.seed, threads=options.threads)


def _loop_row(options: BenchOptions, settle: Settings, case: Case, frames: int, size: tuple[int, int]) -> Row:
    case = replace(case, weights="stand-in") if settle.given else case
    try:
        settings = settle.of(case)
        sample = drive(DRIVEN, frames, size, settings, SCENE, seed=options.seed, device=options.device, threads=options.threads)
        exact = whole_clip(settings, sample.clip, SCENE, options.seed)
        whole = whole_clip(settle.over_all(case, 1 + len(exact) // 4), sample.clip, SCENE, options.seed)
    except SimrunError as error:
        return Row(case.group, case.name, settle.label(case), size, 0, {}, problem=error.found)
    predicted = sample.facts.get("predicted")
    return Row(
        case.group, case.name, settle.label(case), size, len(exact), spread(sample.stages | {"all-in": sample.ms}), sample.first_ms,
        rounding=difference(sample.shown, exact), model=difference(sample.shown, whole),
        hit_rate=sample.facts["hits"] / predicted if predicted else None,
    )  # fmt: skip
