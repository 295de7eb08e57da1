"""Speed against error of a fixer, one row per setting.

Every row has two errors, both in grey levels of the fixed images at the same noise:

- *rounding*: against the float32 whole-clip run of the same setting (window, history, decoder). The cost of precision, streaming, caching
  and folding.
- *model*: against the float32 whole-clip run of the base setting with a window over the whole clip. The effect of the setting itself; a
  network trained with the setting may be as good with it.

Settings run on a clip from a recorded drive; both modes of the closed loop run on drives of their own.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from alpasim_plugin.bench.fixer_drive import drive
from alpasim_plugin.bench.fixer_speed import Clip, Timing, measure
from alpasim_plugin.bench.stand_in import save_stand_in
from alpasim_plugin.bench.whole_clip import whole_clip
from alpasim_plugin.errors import FixerError, InputError, SimrunError
from alpasim_plugin.fixers.base import fixer_settings
from alpasim_plugin.fixers.refine import Difference
from alpasim_plugin.fixers.settings import OneFixerSettings
from alpasim_plugin.processes import end_with_parent
from alpasim_plugin.runtime.provenance import hardware, versions
from alpasim_plugin.types import U8

Weights = Literal["stand-in", "identity", "random"]
SCENE = "bench-fixer"  # key of the noise
DRIVEN = "smoke/lead_car"  # a curve, a car ahead and an oncoming one
SLOW_FRAMES = 21  # of a slow row's clip: three blocks
NO_WEIGHTS = tuple(f"weights.{part}=null" for part in ("bundle", "dit", "vae", "decoder", "prompt"))
LIGHT = ("vae.kind=wan", "vae.base=24")  # LightVAE's width


@dataclass(frozen=True)
class Case:
    """One setting to measure.

    Attributes:
        group: What it varies: precision, window, history, decoder.
        name: The setting.
        overrides: Settings on top of the base, ``key=value``.
        weights: ``stand-in``: the fixer's own, or random ones where it has none; ``identity``, ``random``: an untrained fixer's.
        slow: Left out of a quick run, and measured over fewer frames.
    """

    group: str
    name: str
    overrides: tuple[str, ...] = ()
    weights: Weights = "stand-in"
    slow: bool = False


BASE = Case("precision", "float32")
# The policy drives by these images: without weights of its own, the fixer is an identity.
LOOPS = (
    Case("mode", "chunk", ("mode=chunk",), "identity"),
    Case("mode", "speculative", ("mode=speculative",), "identity"),
    Case("mode", "speculative, exact poses", ("mode=speculative", "tolerance_m=0", "tolerance_deg=0"), "identity"),
)


def cases(latents: int) -> tuple[Case, ...]:
    """Return every setting to measure on a clip of so many latents; the first is the base.

    The two LightVAE rows have random weights: only their speed and rounding are meaningful.
    """
    both = ("precision", "codec_precision")
    return (
        BASE,
        Case("precision", "bfloat16 transformer", ("precision=bf16",)),
        Case("precision", "bfloat16", tuple(f"{key}=bf16" for key in both)),
        Case("precision", "float16", tuple(f"{key}=fp16" for key in both)),
        Case("precision", "float32, identity", (), "identity"),
        Case("precision", "bfloat16, identity", tuple(f"{key}=bf16" for key in both), "identity"),
        Case("window", "4 latents", ("window=4",)),
        Case("window", "6 latents", ("window=6",)),
        Case("window", "12 latents", ("window=12",)),
        Case("window", "all", (f"window={latents}",)),
        Case("history", "rolling, last forward", ("history=last-forward",)),
        Case("history", "rolling, finalise", ("history=finalise",)),
        Case("history", "rolling with a sink of 1", ("sink=1",)),
        Case("decoder", "latent and render", ("decoder.kind=render",)),
        Case("decoder", "latent only", ("decoder.kind=latent",)),
        Case("decoder", "LightVAE", (*LIGHT, "decoder.kind=latent"), "random", slow=True),
        Case("decoder", "LightVAE, TAEHV decoder", (*LIGHT, "decoder.kind=taehv"), "random", slow=True),
    )


@dataclass(frozen=True)
class Row:
    """What one setting costs and how far its images are off.

    Attributes:
        group, name: The setting.
        weights: Which weights.
        size: Width and height, pixels.
        frames: Frames of the clip.
        ms: By stage, ``all-in`` and its processor time ``cpu``: median and 95th percentile over blocks after the first, milliseconds per
            frame.
        first_ms: First block, whole, all-in.
        load_ms: Networks from nothing to ready.
        peak_mb: Largest memory beyond an empty process, 1e6 bytes; None where the system does not tell.
        rounding: Mean, largest and PSNR (None: equal) against the same setting in float32 over the whole clip; None where there is none.
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

    name: str = "onefixer-tiny"
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


def bench_fixer(
    options: BenchOptions, sizes: list[tuple[int, int]], frames: int, on_row: Callable[[Row], None] = lambda row: None
) -> Bench:
    """Measure a fixer at every size.

    Args:
        options: Which fixer and how.
        sizes: Widths and heights, pixels.
        frames: Least length of the drive; blocks are completed.
        on_row: Called with every finished row.

    Raises:
        InputError: A fixer or settings that are not known.
    """
    load = os.getloadavg()[0]
    rows: list[Row] = []
    recorded = fixer_settings("identity", ["mode=chunk", "uses_map=true"])
    for size in sizes:
        with tempfile.TemporaryDirectory(prefix="simrun-bench-") as folder:
            settings = CaseSettings(options, Path(folder))  # refuses bad settings before anything is driven
            clip = drive(DRIVEN, frames, size, recorded, SCENE, seed=options.seed, threads=options.threads).clip
            rows += bench_clip(options, clip, on_row)
            for case in filter(options.includes, LOOPS):
                rows.append(_loop_row(settings, case, frames, size))
                on_row(rows[-1])
    facts = {
        "fixer": options.name,
        "overrides": list(options.overrides),
        "scene": DRIVEN,
        "device": options.device,
        "threads": options.threads or torch.get_num_threads(),
        "passes": options.passes,
        "load_before_after": [round(load, 2), round(os.getloadavg()[0], 2)],
        "hardware": hardware(),
        "versions": versions(),
    }
    if options.device != "cpu":
        facts["accelerator"] = torch.cuda.get_device_name(options.device)
    return Bench(rows, facts)


def bench_clip(options: BenchOptions, clip: Clip, on_row: Callable[[Row], None] = lambda row: None, own_process: bool = True) -> list[Row]:
    """Measure every setting on one clip.

    Args:
        options: How.
        clip: Frames and maps of a rollout, in whole blocks.
        on_row: Called with every finished row.
        own_process: Measure every row in a fresh process, so that memory and first calls are its own.

    Returns:
        One row per setting. A setting that these weights or this machine cannot run has the reason as ``problem``.
    """
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="simrun-bench-") as folder:
        settings = CaseSettings(options, Path(folder))
        latents = 1 + (len(clip.t_us) - 1) // 4
        base = whole_clip(settings.over_all(BASE, latents), clip, SCENE, options.seed)
        for case in filter(options.includes, cases(latents)):
            rows.append(_row(settings, case, clip, base if case.weights == "stand-in" else None, own_process))
            on_row(rows[-1])
    return rows


class CaseSettings:
    """The settings of each case, with stand-in weights where the fixer has none of its own."""

    def __init__(self, options: BenchOptions, folder: Path) -> None:
        self.options, self.folder = options, folder
        weights = self._read(()).weights
        self.given = any((weights.bundle, weights.dit, weights.vae))

    def of(self, case: Case) -> OneFixerSettings:
        """Return the settings of a case."""
        if case.weights != "stand-in":
            return self._read((*case.overrides, *NO_WEIGHTS, f"untrained={case.weights}"))
        settings = self._read(case.overrides)
        if self.given:
            return settings
        path = self.folder / f"{settings.decoder.kind}.safetensors"
        if not path.exists():
            save_stand_in(path, settings, self.options.seed)
        return self._read((*case.overrides, f"weights.bundle={path}"))

    def over_all(self, case: Case, latents: int) -> OneFixerSettings:
        """Return the base settings with a case's weights and a window over a whole clip: the reference of model errors."""
        return self.of(replace(case, overrides=(f"window={latents}",)))

    def row(self, case: Case, size: tuple[int, int]) -> Row:
        """Return an empty row of a case."""
        weights = "given" if self.given and case.weights == "stand-in" else case.weights
        return Row(case.group, case.name, weights, size, 0, {})

    def _read(self, overrides: Sequence[str]) -> OneFixerSettings:
        settings = fixer_settings(self.options.name, (*self.options.overrides, *overrides))
        if not isinstance(settings, OneFixerSettings):
            raise InputError("measuring a fixer", self.options.name, "it has no networks", "name one of the onefixer family")
        return settings


def _row(of: CaseSettings, case: Case, clip: Clip, base: U8 | None, own_process: bool) -> Row:
    row = of.row(case, (clip.rgb.shape[2], clip.rgb.shape[1]))
    try:
        settings = of.of(case)
        given = clip.first(SLOW_FRAMES) if case.slow else clip
        timing = measured(of.options, settings, given, own_process)
        exact = whole_clip(settings, given, SCENE, of.options.seed)
    except SimrunError as error:
        return replace(row, problem=error.found)
    n, fixed = len(timing.images), ~timing.guarded
    return replace(
        row,
        frames=n,
        ms=p50_p95(timing.stages | {"all-in": timing.all_in, "cpu": timing.cpu}),
        first_ms=timing.first_ms,
        load_ms=timing.load_ms,
        peak_mb=timing.peak_mb,
        rounding=difference(timing.images[fixed], exact[:n][fixed]),
        model=None if base is None else difference(timing.images[fixed], base[:n][fixed]),
        guarded=int(timing.guarded.sum()),
    )


def _loop_row(of: CaseSettings, case: Case, frames: int, size: tuple[int, int]) -> Row:
    case = replace(case, weights="stand-in") if of.given else case
    row, options = of.row(case, size), of.options
    try:
        settings = of.of(case)
        sample = drive(DRIVEN, frames, size, settings, SCENE, seed=options.seed, device=options.device, threads=options.threads)
        exact = whole_clip(settings, sample.clip, SCENE, options.seed)
        whole = whole_clip(of.over_all(case, 1 + len(exact) // 4), sample.clip, SCENE, options.seed)
    except SimrunError as error:
        return replace(row, problem=error.found)
    predicted = sample.facts.get("predicted")
    return replace(
        row,
        frames=len(exact),
        ms=p50_p95(sample.stages | {"all-in": sample.ms}),
        first_ms=sample.first_ms,
        rounding=difference(sample.shown, exact),
        model=difference(sample.shown, whole),
        hit_rate=sample.facts["hits"] / predicted if predicted else None,
    )


def difference(images: U8, reference: U8) -> tuple[float, int, float | None] | None:
    """Return mean and largest difference in grey levels, and PSNR in dB, None for equal clips; None for no images at all."""
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
    return {name: (float(np.median(ms)), float(np.percentile(ms, 95))) for name, ms in series.items() if len(ms)}


def measured(options: BenchOptions, settings: OneFixerSettings, clip: Clip, own_process: bool) -> Timing:
    """Time a setting over a clip, in a fresh process if asked: no kernel is warm there, and the memory is this setting's alone."""
    arguments = (settings, clip, SCENE, options.seed, options.device, options.threads, options.passes)
    if not own_process:
        return measure(*arguments)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), end_with_parent) as pool:
        try:
            return pool.submit(measure, *arguments).result()
        except BrokenProcessPool as error:
            do = "see its message above; a process without one ran out of memory"
            raise FixerError("measuring a fixer", settings.name, "its process ended early", do) from error
