"""``simrun train fixer``: train a recipe from pairs, the autoencoder, or a fixer's decoder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
import typer

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.lab.cli import training_options as options
from alpasim_plugin.lab.cli.image_sizes import parse_size
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.decoder_finetune import DecoderRecipe
from alpasim_plugin.lab.training.decoder_finetune_run import finetune_decoder
from alpasim_plugin.lab.training.fixer_run import FixerRun, TrainableSettings, train_fixer
from alpasim_plugin.lab.training.latent_clips import ClipForm
from alpasim_plugin.lab.training.pair_pack import pairs_folder
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
from alpasim_plugin.lab.training.vae import train_vae

EPILOG = """
Examples:

- `simrun train fixer data/pairs --recipe vae --video data/video --out runs/vae --steps 4000`

- `simrun train fixer data/pairs --size 256x144 --vae runs/vae/vae.safetensors --init runs/base/fixer.safetensors --out runs/v9`

- `simrun train fixer data/pairs --size 256x144 --recipe decoder --init runs/v9/fixer.safetensors --out runs/v9-decoder --steps 800 --lr 5e-4`
"""
VAE = "vae"
DECODER = "decoder"
PRECISIONS: Mapping[str, torch.dtype | None] = {"fp32": None, "bf16": torch.bfloat16}


def trainable_settings(
    name: str, recipe: str, has_attention_options: bool = False
) -> TrainableSettings:
    """Return the settings of a shipped fixer that a recipe can be trained for.

    Args:
        name: The fixer.
        recipe: The recipe, for errors.
        has_attention_options: Whether the command sets blocks, window or sink.

    Raises:
        InputError: Unknown, a fixer without latents, or options of attention for a fixer without a
            history.
    """
    settings = fixer_settings(name)
    if not isinstance(settings, TrainableSettings):
        raise InputError(
            f"--fixer {name}: it has no networks on latents",
            "leave it out, or choose a block generator, such as onefixer-dit-tiny",
        )
    if has_attention_options and not isinstance(settings, OneFixerSettings):
        raise InputError(
            f"recipe {recipe}: it has no blocks and no history",
            "leave out --block, --window and --sink",
        )
    return settings


Recipe = Annotated[
    str,
    typer.Option(
        "--recipe",
        help=f"{VAE}: the autoencoder; {DECODER}: the decoder of --init; or {', '.join(RECIPES)}.",
    ),
]
Vae = Annotated[
    Path | None,
    typer.Option("--vae", help="Trained autoencoder (recipe vae), or a fixer's bundle."),
]
Video = Annotated[
    Path | None,
    typer.Option("--video", help="Recipe vae: folder of driving video, as further clips."),
]
Init = Annotated[
    Path | None,
    typer.Option("--init", help="Initial weights: a run's fixer.safetensors, or a transformer."),
]
Weights = Annotated[
    list[str] | None,
    typer.Option(
        "--weights",
        help="NAME=FILE, repeatable: init-bi, of bidirectional networks; or a stage, which is then not trained.",
    ),
]
SourceShare = Annotated[
    float,
    typer.Option(
        "--source-share",
        min=0.0,
        max=0.8,
        help="Recipe base: share of positions at t = 1, the start of sampling.",
    ),
]
Objective = Annotated[
    list[str] | None,
    typer.Option(
        "--objective",
        help="KEY=VALUE or STAGE.KEY=VALUE of the recipe's objectives, repeatable, such as dmd.steps=4.",
    ),
]
Block = Annotated[
    int | None,
    typer.Option("--block", min=1, help="Latents of a block, instead of the recipe's."),
]
Window = Annotated[
    int | None,
    typer.Option("--window", min=1, help="Attention window in latents, instead of the recipe's."),
]
Sink = Annotated[
    int | None,
    typer.Option("--sink", min=0, help="Attention sink in latents, instead of the recipe's."),
]
ClassColourAugmentation = Annotated[
    bool,
    typer.Option(
        "--class-colour-augmentation/--no-class-colour-augmentation",
        help="Show the map's cars in the colours of another class in mirrored clips.",
    ),
]
StopAt = Annotated[
    int | None,
    typer.Option("--stop-at", min=1, help="Stop after this update and write the weights."),
]
SizesOf = Annotated[
    str | None,
    typer.Option("--fixer", help="Fixer that gives the sizes; by default the recipe's."),
]


def fixer(
    data: options.Pairs,
    out: options.RunFolder,
    recipe: Recipe = "V9",
    vae: Vae = None,
    video: Video = None,
    init: Init = None,
    weights: Weights = None,
    size: options.Size = None,
    steps: options.Unit = 400,
    clips: options.Clips = 4,
    accumulate: options.Accumulate = 2,
    latents: options.Latents = 12,
    columns: options.Columns = None,
    stride: options.Stride = 24,
    lr: options.PeakLr = 2e-4,
    ema: options.Ema = 0.99,
    source_share: SourceShare = 0.35,
    objective: Objective = None,
    block: Block = None,
    window: Window = None,
    sink: Sink = None,
    perceptual: options.Perceptual = 10.0,
    channels: options.Channels = "amplitude",
    class_colour_augmentation: ClassColourAugmentation = True,
    stop_at: StopAt = None,
    precision: options.Precision = "fp32",
    device: options.Device = "cpu",
    threads: options.Threads = None,
    seed: options.Seed = 0,
    sizes_of: SizesOf = None,
    metric_weights: options.MetricWeights = None,
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Train a recipe: one system of the paper's tables; writes OUT/fixer.safetensors (averaged
    weights, float16) and its card. Recipe vae writes OUT/vae.safetensors.
    """
    del debug
    options.use_threads(threads)
    image_size = None if size is None else parse_size(size)
    data = pairs_folder(data, out)
    video = None if video is None else pairs_folder(video, out)
    form = ClipForm(latents, stride, class_colour_augmentation)
    progress = options.Progress(steps)
    if recipe == VAE:
        path = train_vae(data, video, out, steps, seed, init, progress.update, device)
        progress.wrote(path, as_json)
        return
    if recipe == DECODER:
        path = finetune_decoder(
            required(init, "--recipe decoder: no trained fixer", "Give one with --init."),
            data,
            out,
            form,
            DecoderRecipe(clips, columns=columns or DecoderRecipe.columns, seed=seed),
            Schedule(steps, peak_lr=lr, warmup=max(steps // 20, 1), ema=ema, save_every=50),
            progress.perceptual_term(metric_weights, device),
            partial(progress.prepared, interval=50),
            progress.update,
            image_size,
            device,
        )
        progress.wrote(path, as_json)
        return
    no_vae = f"--recipe {recipe}: no autoencoder"
    vae = required(vae, no_vae, "Give one with --vae; --recipe vae trains it.")
    weighted = with_perceptual_weight(
        with_source_share(recipe_of(recipe), source_share), perceptual
    )
    adapted = with_attention(with_objective(weighted, objective or []), block, window, sink)
    has_attention_options = (block, window, sink) != (None, None, None)
    run = FixerRun(
        trainable_settings(sizes_of or adapted.fixer, recipe, has_attention_options),
        adapted,
        data,
        vae,
        named_weights(init, weights or []),
        form,
        BatchForm(clips, None, columns, seed),
        Schedule(steps, peak_lr=lr, accumulate=accumulate, ema=ema).of_length(steps),
        channels == "equal",
        PRECISIONS[precision],
        image_size,
        device,
    )
    progress = options.Progress(run.updates)
    progress.float32(run.precision, run.stages())
    distance = progress.perceptual_term(metric_weights, device) if run.perceptual else None
    encoded = partial(progress.prepared, "clips as latents, sequences")
    progress.wrote(train_fixer(run, out, distance, encoded, progress.update, stop_at), as_json)


def required(path: Path | None, problem: str, hint: str) -> Path:
    """Return a file without which a recipe cannot be trained.

    Raises:
        InputError: It is not named.
    """
    if path is None:
        raise InputError(problem, hint)
    return path


def named_weights(init: Path | None, pairs: Sequence[str]) -> dict[str, Path]:
    """Return files by name from ``--init FILE`` and repeated ``--weights NAME=FILE``.

    Raises:
        InputError: Not NAME=FILE, or a name twice.
    """
    files = {} if init is None else {INIT: init}
    for text in pairs:
        name, equals, path = text.partition("=")
        if not equals or not path or name in files:
            wrong = "a name that has a file already" if equals and path else "not NAME=FILE"
            raise InputError(
                f"--weights {text}: {wrong}",
                "write for example --weights teacher=runs/t/fixer.safetensors",
            )
        files[name] = Path(path)
    return files
