"""``simrun train fixer``: train a variant of OneFixer from pairs; ``simrun train memory``: its memory and time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import torch
import typer

from alpasim_plugin.bench.training_memory import measure_memory, memory_table
from alpasim_plugin.cli import training_options as options
from alpasim_plugin.errors import InputError
from alpasim_plugin.fixers.base import fixer_settings
from alpasim_plugin.fixers.settings import OneFixerSettings
from alpasim_plugin.training.fixer_run import FixerRun, train_fixer
from alpasim_plugin.training.generator import GeneratorRecipe
from alpasim_plugin.training.latent_clips import ClipForm
from alpasim_plugin.training.trainer import Schedule
from alpasim_plugin.training.variants import VARIANTS, variant_of

PRECISIONS: Mapping[str, torch.dtype | None] = {"fp32": None, "bf16": torch.bfloat16}


def onefixer_settings(name: str) -> OneFixerSettings:
    """Return the settings of a shipped fixer that can be trained.

    Raises:
        InputError: Unknown, or a fixer without networks.
    """
    settings = fixer_settings(name)
    if not isinstance(settings, OneFixerSettings):
        raise InputError(
            "choosing a fixer to train", f"--fixer {name}", "it has no networks", "choose a block generator, such as onefixer-dit-tiny"
        )
    return settings


def train_fixer_command(
    data: options.Pairs,
    vae: Annotated[Path, typer.Option("--vae", help="Trained autoencoder ('simrun train vae'), or a fixer's bundle.")],
    out: options.RunFolder,
    variant: Annotated[str, typer.Option("--variant", help=f"One of {', '.join(VARIANTS)}.")] = "V9",
    init: Annotated[Path | None, typer.Option("--init", help="Initial weights: a run's fixer.safetensors, or a transformer.")] = None,
    steps: options.Steps = 400,
    clips: options.Clips = 4,
    accumulate: Annotated[int, typer.Option("--accumulate", min=1, help="Batches per update.")] = 2,
    latents: options.Latents = 12,
    columns: Annotated[int | None, typer.Option("--columns", min=2, help="Crop to this width, in latents of 8 pixels.")] = None,
    stride: options.Stride = 24,
    lr: options.PeakLr = 2e-4,
    ema: Annotated[float, typer.Option("--ema", min=0.0, max=0.99999, help="Decay of the averaged (EMA) weights.")] = 0.99,
    source_share: Annotated[
        float, typer.Option("--source-share", min=0.0, max=0.8, help="Variant base: share of positions at t = 1, the start of sampling.")
    ] = 0.35,
    perceptual: Annotated[float, typer.Option("--perceptual", min=0.0, help="Weight of the perceptual loss; 10 in the paper.")] = 10.0,
    channels: Annotated[
        Literal["amplitude", "equal"], typer.Option("--channels", help="Weights of latent channels: by amplitude in pixels, or equal.")
    ] = "amplitude",
    class_colour_augmentation: Annotated[
        bool,
        typer.Option(
            "--class-colour-augmentation/--no-class-colour-augmentation",
            help="Show the map's cars in the colours of another class in mirrored clips.",
        ),
    ] = True,
    recolour: Annotated[bool, typer.Option("--recolour/--no-recolour", hidden=True, help="Former name of the option above.")] = True,
    stop_at: Annotated[int | None, typer.Option("--stop-at", min=1, help="Stop after this update and write the weights.")] = None,
    precision: Annotated[Literal["fp32", "bf16"], typer.Option("--precision", help="Precision of the forward passes.")] = "fp32",
    threads: options.Threads = None,
    seed: options.Seed = 0,
    fixer: Annotated[str, typer.Option("--fixer", help="Fixer that gives the sizes.")] = "onefixer-dit-tiny",
    metric_weights: options.MetricWeights = None,
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Train a variant of the fixer; writes OUT/fixer.safetensors (averaged weights, float16) and its card."""
    del debug
    options.use_threads(threads)
    chosen, progress = variant_of(variant).with_perceptual_weight(perceptual), options.Progress(steps)
    recipe = GeneratorRecipe(
        clips=clips, columns=columns, steps=steps, accumulate=accumulate, seed=seed, source_share=source_share, channels=channels
    )
    settings = onefixer_settings(fixer).model_copy(update={"window": recipe.window, "history": "finalise"})
    schedule = Schedule(steps, peak_lr=lr, warmup=max(steps // 20, 1), accumulate=accumulate, ema=ema, save_every=max(steps // 40, 5))
    form = ClipForm(latents, stride, class_colour_augmentation and recolour)
    run = FixerRun(settings, chosen, data, vae, init, form, recipe, schedule, PRECISIONS[precision])
    distance = progress.perceptual_term(metric_weights) if any(stage.horizon for stage in chosen.stages) else None
    encoded = partial(progress.prepared, "clips as latents, sequences")
    progress.wrote(train_fixer(run, out, distance, encoded, progress.update, stop_at), as_json)


def memory_command(
    latents: Annotated[str, typer.Option("--latents", help="Latents of a clip, comma-separated.")] = "6,12,24",
    horizon: Annotated[str, typer.Option("--horizon", help="k, comma-separated.")] = "0,1,2,4,8",
    clips: Annotated[int, typer.Option("--clips", min=1, help="Clips per batch.")] = 1,
    columns: Annotated[int, typer.Option("--columns", min=2, help="Width in latents.")] = 32,
    rows: Annotated[int, typer.Option("--rows", min=2, help="Height in latents.")] = 18,
    fixer: Annotated[str, typer.Option("--fixer", help="Fixer that gives the sizes.")] = "onefixer-dit-tiny",
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Measure peak memory and time of one training sample by clip length and horizon, each in its own process."""
    del debug
    counts, horizons = options.whole_numbers("--latents", latents, 2), options.whole_numbers("--horizon", horizon, 0)
    cells = measure_memory(onefixer_settings(fixer), counts, horizons, clips, rows, columns)
    print(json.dumps([cell._asdict() for cell in cells], indent=1) if as_json else memory_table(cells))
