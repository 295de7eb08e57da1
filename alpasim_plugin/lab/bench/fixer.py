"""Speed against error of a fixer, one row per setting.

Every row has two errors, both in grey levels of the fixed images at the same noise:

- *rounding*: against the float32 whole-clip run of the same setting (window, history, decoder). The
  cost of precision, streaming, caching and folding.
- *model*: against the float32 whole-clip run of the base setting with a window over the whole clip.
  The effect of the setting itself; a network trained with the setting may be as good with it.

Settings run on a clip from a recorded drive; both modes of the closed loop run on drives of their
own.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.stand_in import save_stand_in
from alpasim_plugin.block_fixers.whole_clip import Clip, whole_clip
from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.types import U8
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.bench import pixel_fixer
from alpasim_plugin.lab.bench.fixer_drive import drive
from alpasim_plugin.lab.bench.fixer_rows import (
    DRIVEN,
    SCENE,
    Bench,
    BenchOptions,
    Case,
    Row,
    difference,
    in_own_process,
    p50_p95,
)
from alpasim_plugin.lab.bench.fixer_speed import Timing, measure
from alpasim_plugin.runs.provenance import hardware, versions

SLOW_FRAMES = 21  # of a slow row's clip: three blocks
NO_WEIGHTS = tuple(f"weights.{part}=null" for part in ("bundle", "dit", "vae", "decoder", "prompt"))
LIGHT = ("vae.kind=wan", "vae.base=24")  # LightVAE's width


BASE = Case("precision", "float32")
# The policy drives by these images: without weights of its own, the fixer is an identity.
LOOPS = (
    Case("mode", "chunk", ("mode=chunk",), "identity"),
    Case("mode", "speculative", ("mode=speculative",), "identity"),
    Case(
        "mode",
        "speculative, exact poses",
        ("mode=speculative", "tolerance_m=0", "tolerance_deg=0"),
        "identity",
    ),
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
        Case(
            "decoder",
            "LightVAE, TAEHV decoder",
            (*LIGHT, "decoder.kind=taehv"),
            "random",
            slow=True,
        ),
    )


def bench_fixer(
    options: BenchOptions,
    sizes: list[tuple[int, int]],
    frames: int,
    on_row: Callable[[Row], None] = lambda row: None,
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
            chosen = fixer_settings(options.name, options.overrides)
            per_frame = chosen if isinstance(chosen, PixelFixerSettings) else None
            settings = (
                None if per_frame else CaseSettings(options, Path(folder))
            )  # refuses bad settings before anything is driven
            clip = drive(
                DRIVEN, frames, size, recorded, SCENE, seed=options.seed, threads=options.threads
            ).clip
            if per_frame is not None:
                rows += pixel_fixer.bench_clip(options, per_frame, clip, on_row)
            if settings is None:
                continue
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


def bench_clip(
    options: BenchOptions,
    clip: Clip,
    on_row: Callable[[Row], None] = lambda row: None,
    own_process: bool = True,
) -> list[Row]:
    """Measure every setting on one clip.

    Args:
        options: How.
        clip: Frames and maps of a rollout, in whole blocks.
        on_row: Called with every finished row.
        own_process: Measure every row in a fresh process, so that memory and first calls are its
            own.

    Returns:
        One row per setting. A setting that these weights or this machine cannot run has the reason
        as ``problem``.
    """
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="simrun-bench-") as folder:
        settings = CaseSettings(options, Path(folder))
        latents = 1 + (len(clip.t_us) - 1) // 4
        base = whole_clip(settings.over_all(BASE, latents), clip, SCENE, options.seed)
        for case in filter(options.includes, cases(latents)):
            rows.append(
                _row(
                    settings, case, clip, base if case.weights == "stand-in" else None, own_process
                )
            )
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
        """Return the base settings with a case's weights and a window over a whole clip: the
        reference of model errors.
        """
        return self.of(replace(case, overrides=(f"window={latents}",)))

    def row(self, case: Case, size: tuple[int, int]) -> Row:
        """Return an empty row of a case."""
        weights = "given" if self.given and case.weights == "stand-in" else case.weights
        return Row(case.group, case.name, weights, size, 0, {})

    def _read(self, overrides: Sequence[str]) -> OneFixerSettings:
        settings = fixer_settings(self.options.name, (*self.options.overrides, *overrides))
        if not isinstance(settings, OneFixerSettings):
            raise InputError(
                f"{self.options.name}: it has no networks",
                "name one of the onefixer family",
            )
        return settings


def _row(of: CaseSettings, case: Case, clip: Clip, base: U8 | None, own_process: bool) -> Row:
    row = of.row(case, (clip.rgb.shape[2], clip.rgb.shape[1]))
    try:
        settings = of.of(case)
        given = clip.first(SLOW_FRAMES) if case.slow else clip
        timing = measured(of.options, settings, given, own_process)
        exact = whole_clip(settings, given, SCENE, of.options.seed)
    except SimrunError as error:
        return replace(row, problem=error.message)
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
        sample = drive(
            DRIVEN,
            frames,
            size,
            settings,
            SCENE,
            seed=options.seed,
            device=options.device,
            threads=options.threads,
        )
        exact = whole_clip(settings, sample.clip, SCENE, options.seed)
        whole = whole_clip(of.over_all(case, 1 + len(exact) // 4), sample.clip, SCENE, options.seed)
    except SimrunError as error:
        return replace(row, problem=error.message)
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


def measured(
    options: BenchOptions, settings: OneFixerSettings, clip: Clip, own_process: bool
) -> Timing:
    """Time a setting over a clip, in a fresh process if asked."""
    arguments = (
        settings,
        clip,
        SCENE,
        options.seed,
        options.device,
        options.threads,
        options.passes,
    )
    return (
        in_own_process(settings.name, measure, *arguments) if own_process else measure(*arguments)
    )
