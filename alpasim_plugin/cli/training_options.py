"""What the commands that train networks share: options, the perceptual term, and how they tell how far they are."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from alpasim_plugin.nets.picture_distance import distance_for_training
from alpasim_plugin.training.perceptual_term import Distance

Pairs = Annotated[Path, typer.Argument(help="Folder of pairs; its split 'train' is learned from.")]
RunFolder = Annotated[Path, typer.Option("--out", help="Folder of the run; the same command continues there.")]
Steps = Annotated[int, typer.Option("--steps", min=1, help="Updates in all: the budget.")]
Clips = Annotated[int, typer.Option("--clips", min=1, help="Clips of a batch.")]
Latents = Annotated[int, typer.Option("--latents", min=2, help="Latents of a clip: 12 are 45 frames, 24 are 93.")]
Stride = Annotated[int, typer.Option("--stride", min=1, help="Frames between the starts of a sequence's clips.")]
PeakLr = Annotated[float, typer.Option("--lr", min=1e-7, help="Highest learning rate.")]
Threads = Annotated[int | None, typer.Option("--threads", min=1, help="Torch threads.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of weights, draws and noise.")]
MetricWeights = Annotated[
    Path | None, typer.Option("--metric-weights", help="Folder with LPIPS weights for the perceptual term; otherwise perceptual-syn.")
]


def use_threads(threads: int | None) -> None:
    """Set torch's threads where a number is given."""
    if threads is not None:
        torch.set_num_threads(threads)


class Progress:
    """Tells on standard error what a training command does and how long it will take.

    Args:
        steps: Updates in all.
        every: Updates between two lines; by default a hundred lines in all.
    """

    def __init__(self, steps: int, every: int | None = None) -> None:
        self.console, self.steps, self.began = Console(stderr=True), steps, time.time()
        self.every = every or max(steps // 100, 1)

    def perceptual_term(self, metric_weights: Path | None) -> tuple[str, Distance]:
        """Choose the perceptual distance to train with, and say which one it is.

        Raises:
            InputError: A folder is named that holds no LPIPS weights.
        """
        name, measure = distance_for_training(metric_weights)
        self.console.print(f"perceptual term: {name}")
        return name, measure.distance

    def prepared(self, what: str, done: int, count: int, every: int = 10) -> None:
        """Tell of work ahead of the first update."""
        if done == count or done % every == 0:
            self.console.print(f"{what}: {done}/{count}, {time.time() - self.began:.0f} s")

    def update(self, step: int, numbers: Mapping[str, float]) -> None:
        """Tell of an update; ``numbers["s"]`` are its seconds."""
        if step % self.every == 0 or step == self.steps:
            values = ", ".join(f"{key} {value:.4g}" for key, value in numbers.items())
            left = (self.steps - step) * numbers["s"]
            self.console.print(f"{step}/{self.steps} {values}; about {left / 60:.0f} min left", highlight=False)

    def wrote(self, path: Path) -> None:
        """Name what was made."""
        self.console.print(f"wrote {path}")
