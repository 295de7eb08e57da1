"""Speed against error of a fixer, one row per setting.

Every row has two errors, both in grey levels of the finished images at the same noise:

- *rounding*: against the float32 whole-clip run of the very same setting (window, history, decoder). What precision, streaming, caching
  and folding cost.
- *model*: against the float32 whole-clip run of the base setting with a window over the whole clip. What the setting itself changes; a
  network trained with the setting may be as good with it.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from alpasim_plugin.bench.fixer_speed import Clip, Timing, measure
from alpasim_plugin.bench.stand_in import save_stand_in
from alpasim_plugin.errors import FixerError, InputError, SimrunError
from alpasim_plugin.fixers.base import fixer_settings
from alpasim_plugin.fixers.reference import whole_clip
from alpasim_plugin.fixers.refine import Difference
from alpasim_plugin.fixers.settings import OneFixerSettings
from alpasim_plugin.types import U8

Weights = Literal["stand-in", "identity", "random"]
SCENE = "bench-fixer"
NO_WEIGHTS = tuple(f"weights.{part}=null" for part in ("bundle", "dit", "vae", "decoder", "prompt"))
LIGHT = ("vae.kind=wan", "vae.base=24")  # LightVAE's width


@dataclass(frozen=True)
class Case:
    """One setting to measure.

    Attributes:
        group: What it varies: precision, window, history, decoder.
        name: The setting.
        overrides: Settings on top of the base, ``key=value``.
        weights: ``stand-in``: the fixer's own, or stand-ins where it has none; ``identity``, ``random``: those of an untrained fixer.
        slow: Left out of a quick run, and measured over fewer frames.
    """

    group: str
    name: str
    overrides: tuple[str, ...] = ()
    weights: Weights = "stand-in"
    slow: bool = False


BASE = Case("precision", "float32")


def cases(latents: int) -> tuple[Case, ...]:
    """Return every setting to measure on a clip of so many latents; the first is the base.

    The two LightVAE rows draw random weights: their images mean nothing, their speed and rounding do.
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
        hit_rate: Of predicted frames, the share that was used; None where nothing is predicted.
        guarded: Frames that the guard passed on unfixed; they are left out of the errors.
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
        passes: Runs over the clip per row, timed and again with clocks at the stages.
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


SLOW_FRAMES = 21  # of a slow row's clip: three blocks


def bench_clip(options: BenchOptions, clip: Clip, on_row: Callable[[Row], None] = lambda row: None, apart: bool = True) -> list[Row]:
    """Measure every setting on one clip.

    Args:
        options: How.
        clip: Frames and maps of a real rollout, in whole blocks.
        on_row: Told of every row as it is done.
        apart: Measure every row in a process of its own, which makes memory and first calls its own as well.

    Returns:
        One row per setting. A setting that these weights or this machine cannot run has its reason as ``problem``.
    """
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="simrun-bench-") as folder:
        settle = Settings(options, Path(folder))
        latents = 1 + (len(clip.t_us) - 1) // 4
        truth = whole_clip(settle.over_all(BASE, latents), clip, SCENE, options.seed)
        for case in filter(options.includes, cases(latents)):
            row = _row(options, settle, case, clip, truth if case.weights == "stand-in" else None, apart)
            rows.append(row)
            on_row(row)
    return rows


class Settings:
    """Turn cases into settings, with stand-in weights where the fixer has none of its own."""

    def __init__(self, options: BenchOptions, folder: Path) -> None:
        self.options, self.folder = options, folder
        self.own = self._read(())
        weights = self.own.weights
        self.given = any((weights.bundle, weights.dit, weights.vae))

    def of(self, case: Case) -> OneFixerSettings:
        """Return the settings of a case."""
        if case.weights != "stand-in":
            return self._read((*case.overrides, *NO_WEIGHTS, f"untrained={case.weights}"))
        if self.given:
            return self._read(case.overrides)
        plain = self._read(case.overrides)
        path = self.folder / f"{plain.decoder.kind}.safetensors"
        if not path.exists():
            save_stand_in(path, plain, self.options.seed)
        return self._read((*case.overrides, f"weights.bundle={path}"))

    def over_all(self, case: Case, latents: int) -> OneFixerSettings:
        """Return the base settings, with a case's weights and a window over a whole clip: what changes of the model are compared with."""
        return self.of(replace(case, overrides=(f"window={latents}",)))

    def label(self, case: Case) -> str:
        """Say which weights a case uses."""
        return "given" if self.given and case.weights == "stand-in" else case.weights

    def _read(self, overrides: Sequence[str]) -> OneFixerSettings:
        settings = fixer_settings(self.options.name, (*self.options.overrides, *overrides))
        if not isinstance(settings, OneFixerSettings):
            raise InputError("measuring a fixer", self.options.name, "it has no networks", "name one of the onefixer family")
        return settings


def _row(options: BenchOptions, settle: Settings, case: Case, clip: Clip, truth: U8 | None, apart: bool) -> Row:
    size = (clip.rgb.shape[2], clip.rgb.shape[1])
    try:
        settings = settle.of(case)
        given = clip.first(SLOW_FRAMES) if case.slow else clip
        timing = _apart(options, settings, given) if apart else _here(options, settings, given)
        same = whole_clip(settings, given, SCENE, options.seed)
    except SimrunError as error:
        return Row(case.group, case.name, settle.label(case), size, 0, {}, problem=error.found)
    n, fixed = len(timing.images), ~timing.guarded
    times = spread(timing.stages | {"all-in": timing.all_in, "cpu": timing.cpu})
    return Row(
        case.group, case.name, settle.label(case), size, n, times, timing.first_ms, timing.load_ms, timing.peak_mb,
        difference(timing.images[fixed], same[:n][fixed]), None if truth is None else difference(timing.images[fixed], truth[:n][fixed]),
        guarded=int(timing.guarded.sum()),
    )  # fmt: skip


def difference(images: U8, reference: U8) -> tuple[float, int, float | None] | None:
    """Return mean and largest difference in grey levels, and PSNR in dB, None for equal clips; None for no images at all."""
    if not len(images):
        return None
    total = Difference()
    for image, wanted in zip(images, reference, strict=True):
        total.add(image, wanted)
    return total.mean_levels, total.max_levels, total.psnr_db if total.squared else None


def spread(series: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    """Return median and 95th percentile by name; what has no values is left out.

    Example:
        >>> spread({"dit": [1.0, 3.0, 2.0], "encode": []})
        {'dit': (2.0, 2.9)}
    """
    return {name: (float(np.median(ms)), float(np.percentile(ms, 95))) for name, ms in series.items() if len(ms)}


def _here(options: BenchOptions, settings: OneFixerSettings, clip: Clip) -> Timing:
    return measure(settings, clip, SCENE, options.seed, options.device, options.threads, options.passes)


def _apart(options: BenchOptions, settings: OneFixerSettings, clip: Clip) -> Timing:
    """Measure in a fresh Python: nothing of earlier rows is warm, and the memory is this row's alone."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    command = [sys.executable, "-c", "from alpasim_plugin.bench.fixer import serve; serve()"]
    done = subprocess.run(command, input=pickle.dumps((options, settings, clip)), stdout=subprocess.PIPE, env=environment, check=False)
    if done.returncode:
        found = f"exit code {done.returncode}"
        raise FixerError("measuring a fixer", settings.name, found, "see its message above; too little memory ends it with -9")
    answer: Timing | SimrunError = pickle.loads(done.stdout)  # our own bytes, from our own child
    if isinstance(answer, SimrunError):
        raise answer
    return answer


def serve() -> None:
    """Answer one request of `_apart` on standard input and output."""
    answer: Timing | SimrunError
    try:
        answer = _here(*pickle.load(sys.stdin.buffer))
    except SimrunError as error:
        answer = error
    sys.stdout.buffer.write(pickle.dumps(answer))
