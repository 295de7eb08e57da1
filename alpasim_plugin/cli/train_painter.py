"""``simrun train painter``: adapt a trained fixer's decoder to its generator."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from alpasim_plugin.nets.picture_distance import distance_for_training
from alpasim_plugin.training.latent_clips import ClipForm
from alpasim_plugin.training.painter import PainterRecipe
from alpasim_plugin.training.painter_run import train_painter
from alpasim_plugin.training.perceptual_term import Distance
from alpasim_plugin.training.trainer import Schedule

EPILOG = "Example: `simrun train painter data/pairs --init runs/v9/fixer.safetensors --out runs/v9-painter`"


def painter(
    data: Annotated[Path, typer.Argument(help="Folder of pairs; its split 'train' is learned from.")],
    init: Annotated[Path, typer.Option("--init", help="Trained fixer: the fixer.safetensors of 'simrun train fixer'.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the run; the same command continues there.")],
    steps: Annotated[int, typer.Option("--steps", min=1, help="Updates.")] = 800,
    clips: Annotated[int, typer.Option("--clips", min=1, help="Clips of a batch.")] = 2,
    latents: Annotated[int, typer.Option("--latents", min=2, help="Latents of a clip: 12 are 45 frames.")] = 12,
    rows: Annotated[int, typer.Option("--rows", min=2, help="Height of a crop, in latents of 8 pixels.")] = 10,
    columns: Annotated[int, typer.Option("--columns", min=2, help="Width of a crop, in latents.")] = 16,
    stride: Annotated[int, typer.Option("--stride", min=1, help="Frames between the starts of a sequence's clips.")] = 24,
    lr: Annotated[float, typer.Option("--lr", min=1e-7, help="Highest learning rate.")] = 5e-4,
    perceptual: Annotated[float, typer.Option("--perceptual", min=0.0, help="Weight of the perceptual distance; 0 switches it off.")] = 0.1,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Torch threads.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of draws.")] = 0,
    metric_weights: Annotated[
        Path | None, typer.Option("--metric-weights", help="Folder with LPIPS weights for the perceptual term; otherwise perceptual-syn.")
    ] = None,
) -> None:
    """Train the decoder on the generator's own rollouts; generator and encoder stay. Writes OUT/fixer.safetensors and its card."""
    if threads is not None:
        torch.set_num_threads(threads)
    console, began = Console(stderr=True), time.time()
    distance: tuple[str, Distance] | None = None
    if perceptual:
        name, measure = distance_for_training(metric_weights)
        distance = name, measure.distance
        console.print(f"perceptual term: {name}")
    recipe = PainterRecipe(clips, rows, columns, perceptual_weight=perceptual, seed=seed)
    schedule = Schedule(steps, peak_lr=lr, warmup=max(steps // 20, 1), ema=0.99, save_every=max(steps // 20, 5))

    def prepared(what: str, done: int, count: int) -> None:
        if done == count or done % 50 == 0:
            console.print(f"{what}: {done}/{count}, {time.time() - began:.0f} s")

    def report(step: int, numbers: Mapping[str, float]) -> None:
        if step % max(steps // 100, 1) == 0:
            values = ", ".join(f"{key} {value:.4g}" for key, value in numbers.items())
            console.print(f"{step}/{steps} {values}; about {(steps - step) * numbers['s'] / 60:.0f} min left", highlight=False)

    path = train_painter(init, data, out, ClipForm(latents, stride), recipe, schedule, distance, prepared, report)
    console.print(f"wrote {path}")
