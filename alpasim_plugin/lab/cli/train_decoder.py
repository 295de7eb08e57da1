"""``simrun train decoder``: fine-tune a trained fixer's decoder on its generator."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.lab.cli import training_options as options
from alpasim_plugin.lab.cli.image_sizes import parse_size
from alpasim_plugin.lab.training.decoder_finetune import DecoderRecipe
from alpasim_plugin.lab.training.decoder_finetune_run import finetune_decoder
from alpasim_plugin.lab.training.latent_clips import ClipForm
from alpasim_plugin.lab.training.trainer import Schedule

EPILOG = "Example: `simrun train decoder data/pairs --size 256x144 --init runs/v9/fixer.safetensors --out runs/v9-decoder`"


def decoder(
    data: options.Pairs,
    init: Annotated[
        Path,
        typer.Option(
            "--init", help="Trained fixer: the fixer.safetensors of 'simrun train fixer'."
        ),
    ],
    out: options.RunFolder,
    size: options.Size = None,
    steps: options.Steps = 800,
    clips: options.Clips = 2,
    latents: options.Latents = 12,
    rows: Annotated[
        int, typer.Option("--rows", min=2, help="Height of a crop, in latents of 8 pixels.")
    ] = 10,
    columns: Annotated[
        int, typer.Option("--columns", min=2, help="Width of a crop, in latents.")
    ] = 16,
    stride: options.Stride = 24,
    lr: options.PeakLr = 5e-4,
    perceptual: Annotated[
        float,
        typer.Option(
            "--perceptual", min=0.0, help="Weight of the perceptual distance; 0 disables it."
        ),
    ] = 0.1,
    threads: options.Threads = None,
    seed: options.Seed = 0,
    metric_weights: options.MetricWeights = None,
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Fine-tune the decoder on the generator's rollouts; generator and encoder are frozen. Writes
    OUT/fixer.safetensors and its card.
    """
    del debug
    options.use_threads(threads)
    progress = options.Progress(steps)
    distance = progress.perceptual_term(metric_weights) if perceptual else None
    recipe = DecoderRecipe(clips, rows, columns, perceptual_weight=perceptual, seed=seed)
    schedule = Schedule(
        steps, peak_lr=lr, warmup=max(steps // 20, 1), ema=0.99, save_every=max(steps // 20, 5)
    )
    prepared = partial(progress.prepared, every=50)
    own_size = None if size is None else parse_size(size)
    path = finetune_decoder(
        init,
        data,
        out,
        ClipForm(latents, stride),
        recipe,
        schedule,
        distance,
        prepared,
        progress.update,
        own_size,
    )
    progress.wrote(path, as_json)
