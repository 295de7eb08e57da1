"""``simrun train fixer``: train a recipe from pairs; ``simrun train memory``: its memory and
time.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
import typer

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.lab.bench.training_memory import measure_memory, memory_table
from alpasim_plugin.lab.cli import training_options as options
from alpasim_plugin.lab.cli.image_sizes import parse_size
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.fixer_run import FixerRun, TrainableSettings, train_fixer
from alpasim_plugin.lab.training.latent_clips import ClipForm
from alpasim_plugin.lab.training.recipes.recipe import INIT
from alpasim_plugin.lab.training.recipes.registry import (
    RECIPES,
    recipe_of,
    with_attention,
    with_objective,
    with_perceptual_weight,
    with_source_share,
)
from alpasim_plugin.lab.training.trainer import Schedule

PRECISIONS: Mapping[str, torch.dtype | None] = {"fp32": None, "bf16": torch.bfloat16}


def onefixer_settings(name: str) -> OneFixerSettings:
    """Return the settings of a shipped fixer that can be trained.

    Raises:
        InputError: Unknown, or a fixer without networks.
    """
    settings = fixer_settings(name)
    if not isinstance(settings, OneFixerSettings):
        raise InputError(
            f"--fixer {name}: it has no networks",
            "choose a block generator, such as onefixer-dit-tiny",
        )
    return settings


def trainable_settings(name: str) -> TrainableSettings:
    """Return the settings of a shipped fixer that a recipe can be trained for.

    Raises:
        InputError: Unknown, or a fixer without latents.
    """
    settings = fixer_settings(name)
    if not isinstance(settings, TrainableSettings):
        raise InputError(
            f"--fixer {name}: it has no networks on latents",
            "leave it out, or choose a block generator, such as onefixer-dit-tiny",
        )
    return settings


def train_fixer_command(
    data: options.Pairs,
    vae: Annotated[
        Path,
        typer.Option(
            "--vae", help="Trained autoencoder ('simrun train vae'), or a fixer's bundle."
        ),
    ],
    out: options.RunFolder,
    recipe: Annotated[
        str, typer.Option("--recipe", "--variant", help=f"One of {', '.join(RECIPES)}.")
    ] = "V9",
    init: Annotated[
        Path | None,
        typer.Option(
            "--init", help="Initial weights: a run's fixer.safetensors, or a transformer."
        ),
    ] = None,
    weights: Annotated[
        list[str] | None,
        typer.Option(
            "--weights",
            help="NAME=FILE, repeatable: init-bi, of bidirectional networks; or a stage, which is then not trained.",
        ),
    ] = None,
    scenes: Annotated[
        Path | None,
        typer.Option(
            "--scenes",
            help="Folder of the pairs' scenes; recipe appearance renders their depth for its targets.",
        ),
    ] = None,
    size: options.Size = None,
    steps: options.Unit = 400,
    clips: options.Clips = 4,
    accumulate: options.Accumulate = 2,
    latents: options.Latents = 12,
    columns: options.Columns = None,
    stride: options.Stride = 24,
    lr: options.PeakLr = 2e-4,
    ema: options.Ema = 0.99,
    source_share: Annotated[
        float,
        typer.Option(
            "--source-share",
            min=0.0,
            max=0.8,
            help="Recipe base: share of positions at t = 1, the start of sampling.",
        ),
    ] = 0.35,
    objective: Annotated[
        list[str] | None,
        typer.Option(
            "--objective",
            help="KEY=VALUE or STAGE.KEY=VALUE of the recipe's objectives, repeatable, such as dmd.steps=4.",
        ),
    ] = None,
    block: Annotated[
        int | None,
        typer.Option("--block", min=1, help="Latents of a block, instead of the recipe's."),
    ] = None,
    window: Annotated[
        int | None,
        typer.Option(
            "--window", min=1, help="Attention window in latents, instead of the recipe's."
        ),
    ] = None,
    sink: Annotated[
        int | None,
        typer.Option("--sink", min=0, help="Attention sink in latents, instead of the recipe's."),
    ] = None,
    perceptual: options.Perceptual = 10.0,
    channels: options.Channels = "amplitude",
    class_colour_augmentation: Annotated[
        bool,
        typer.Option(
            "--class-colour-augmentation/--no-class-colour-augmentation",
            help="Show the map's cars in the colours of another class in mirrored clips.",
        ),
    ] = True,
    stop_at: Annotated[
        int | None,
        typer.Option("--stop-at", min=1, help="Stop after this update and write the weights."),
    ] = None,
    precision: options.Precision = "fp32",
    snapshots: options.Snapshots = 0,
    threads: options.Threads = None,
    seed: options.Seed = 0,
    fixer: Annotated[
        str | None,
        typer.Option("--fixer", help="Fixer that gives the sizes; by default the recipe's."),
    ] = None,
    metric_weights: options.MetricWeights = None,
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Train a recipe: one system of the paper's tables; writes OUT/fixer.safetensors (averaged
    weights, float16) and its card.
    """
    del debug
    options.use_threads(threads)
    chosen = with_perceptual_weight(with_source_share(recipe_of(recipe), source_share), perceptual)
    chosen = with_attention(with_objective(chosen, objective or []), block, window, sink)
    settings = trainable_settings(fixer or chosen.fixer)
    if not isinstance(settings, OneFixerSettings) and (block, window, sink) != (None, None, None):
        raise InputError(
            f"recipe {recipe}: it has no blocks and no history",
            "leave out --block, --window and --sink",
        )
    schedule = Schedule(steps, peak_lr=lr, accumulate=accumulate, ema=ema).of_length(steps)
    form = ClipForm(latents, stride, class_colour_augmentation)
    batches = BatchForm(clips, None, columns, seed)
    own_size = None if size is None else parse_size(size)
    files, equal = named_weights(init, weights or []), channels == "equal"
    run = FixerRun(
        settings,
        chosen,
        data,
        vae,
        files,
        form,
        batches,
        schedule,
        equal,
        PRECISIONS[precision],
        snapshots,
        scenes,
        own_size,
    )
    progress = options.Progress(run.updates)
    progress.float32(run.precision, run.stages())
    distance = progress.perceptual_term(metric_weights) if run.perceptual else None
    encoded = partial(progress.prepared, "clips as latents, sequences")
    progress.wrote(train_fixer(run, out, distance, encoded, progress.update, stop_at), as_json)


def named_weights(init: Path | None, pairs: Sequence[str]) -> dict[str, Path]:
    """Return files by name from ``--init FILE`` and repeated ``--weights NAME=FILE``.

    Raises:
        InputError: Not NAME=FILE, or a name twice.
    """
    found = {} if init is None else {INIT: init}
    for text in pairs:
        name, equals, path = text.partition("=")
        if not equals or not path or name in found:
            wrong = "a name that has a file already" if equals and path else "not NAME=FILE"
            raise InputError(
                f"--weights {text}: {wrong}",
                "write for example --weights teacher=runs/t/fixer.safetensors",
            )
        found[name] = Path(path)
    return found


def memory_command(
    latents: Annotated[
        str, typer.Option("--latents", help="Latents of a clip, comma-separated.")
    ] = "6,12,24",
    horizon: Annotated[str, typer.Option("--horizon", help="k, comma-separated.")] = "0,1,2,4,8",
    clips: Annotated[int, typer.Option("--clips", min=1, help="Clips per batch.")] = 1,
    columns: Annotated[int, typer.Option("--columns", min=2, help="Width in latents.")] = 32,
    rows: Annotated[int, typer.Option("--rows", min=2, help="Height in latents.")] = 18,
    fixer: Annotated[
        str, typer.Option("--fixer", help="Fixer that gives the sizes.")
    ] = "onefixer-dit-tiny",
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Measure peak memory and time of one training sample by clip length and horizon, each in its
    own process.
    """
    del debug
    counts, horizons = (
        options.whole_numbers("--latents", latents, 2),
        options.whole_numbers("--horizon", horizon, 0),
    )
    cells = measure_memory(onefixer_settings(fixer), counts, horizons, clips, rows, columns)
    print(
        json.dumps([cell._asdict() for cell in cells], indent=1) if as_json else memory_table(cells)
    )
