"""What the fixers' benches have in common: settings to measure, rows of results, errors of images,
a process of their own.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from alpasim_plugin.core.errors import FixerError
from alpasim_plugin.core.subprocesses import end_with_parent
from alpasim_plugin.core.types import U8
from alpasim_plugin.fixers.refine import Difference
from alpasim_plugin.lab.bench.fixer_speed import Timing

Weights = Literal["stand-in", "identity", "random"]
SCENE = "bench-fixer"  # key of the noise
DRIVEN = "smoke/lead_car"  # a curve, a car ahead and an oncoming one


@dataclass(frozen=True)
class Case:
    """One setting to measure.

    Attributes:
        group: What it varies: precision, window, history, decoder.
        name: The setting.
        overrides: Settings on top of the base, ``key=value``.
        weights: ``stand-in``: the fixer's own, or random ones where it has none; ``identity``,
            ``random``: an untrained fixer's.
        slow: Left out of a quick run, and measured over fewer frames.
    """

    group: str
    name: str
    overrides: tuple[str, ...] = ()
    weights: Weights = "stand-in"
    slow: bool = False


@dataclass(frozen=True)
class Row:
    """What one setting costs and how far its images are off.

    Attributes:
        group, name: The setting.
        weights: Which weights.
        size: Width and height, pixels.
        frames: Frames of the clip.
        ms: By stage, ``all-in`` and its processor time ``cpu``: median and 95th percentile over
            blocks after the first, milliseconds per frame.
        first_ms: First block, whole, all-in.
        load_ms: Networks from nothing to ready.
        peak_mb: Largest memory beyond an empty process, 1e6 bytes; None where the system does not
            tell.
        rounding: Mean, largest and PSNR (None: equal) against the same setting in float32 over the
            whole clip; None where there is none.
        model: The same against the base over the whole clip; None where the networks are others.
        hit_rate: Share of the predicted frames that were shown; None where nothing is predicted.
        guarded: Frames that the guard replaced by the raw ones; they are left out of the errors.
        problem: Why the setting was not measured, else empty.
    """

    group: str
    name: str
    weights: str
    size: tuple[int, int]
    frames: int
    ms: dict[str, tuple[float, float]]
    first_ms: float | None = None
    load_ms: float | None = None
    peak_mb: float | None = None
    rounding: tuple[float, int, float | None] | None = None
    model: tuple[float, int, float | None] | None = None
    hit_rate: float | None = None
    guarded: int = 0
    problem: str = ""


@dataclass(frozen=True)
class BenchOptions:
    """How to measure.

    Attributes:
        name: The fixer.
        overrides: The user's settings, in force for every row.
        device, threads: Where, and with how many threads.
        passes: Runs over the clip per row, timed, and as many again with a clock at every stage.
        quick: Leave out what is slow.
        only: Groups to measure; empty for all.
        seed: Of the noise and of stand-in weights.
    """

    name: str = "onefixer-dit-tiny"
    overrides: tuple[str, ...] = ()
    device: str = "cpu"
    threads: int | None = None
    passes: int = 3
    quick: bool = False
    only: tuple[str, ...] = ()
    seed: int = 0

    def includes(self, case: Case) -> bool:
        """Say whether a case is to be measured."""
        return not (case.slow and self.quick) and (not self.only or case.group in self.only)


@dataclass(frozen=True)
class Bench:
    """Result of a bench.

    Attributes:
        rows: One per size and setting.
        facts: Fixer, scene, machine, load, versions.
    """

    rows: list[Row]
    facts: dict[str, Any]


def difference(images: U8, reference: U8) -> tuple[float, int, float | None] | None:
    """Return mean and largest difference in grey levels, and PSNR in dB, None for equal clips; None
    for no images at all.
    """
    if not len(images):
        return None
    total = Difference()
    for image, expected in zip(images, reference, strict=True):
        total.add(image, expected)
    return total.mean_levels, total.max_levels, total.psnr_db if total.squared else None


def p50_p95(series: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    """Return median and 95th percentile by name; empty series are left out.

    Example:
        >>> p50_p95({"dit": [1.0, 3.0, 2.0], "encode": []})
        {'dit': (2.0, 2.9)}
    """
    return {
        name: (float(np.median(ms)), float(np.percentile(ms, 95)))
        for name, ms in series.items()
        if len(ms)
    }


def in_own_process(name: str, run: Callable[..., Timing], *arguments: object) -> Timing:
    """Call a measurement in a fresh process: no kernel is warm there, and the memory is this
    setting's alone.

    Raises:
        FixerError: The process ended early.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), end_with_parent) as pool:
        try:
            return pool.submit(run, *arguments).result()
        except BrokenProcessPool as error:
            raise FixerError(
                f"{name}: its process ended early",
                "see its message above; a process without one ran out of memory",
            ) from error
