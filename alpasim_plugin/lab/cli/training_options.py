"""Shared options, progress and summary of the ``simrun train`` commands."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import torch
import typer
from rich.console import Console

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.printing import say_document
from alpasim_plugin.lab.training.model_card import curves
from alpasim_plugin.lab.training.perceptual_term import Distance
from alpasim_plugin.lab.training.recipes.recipe import Stage
from alpasim_plugin.lab.training.trainer import LOG_FILE
from alpasim_plugin.lab.video_metrics.image_distance import distance_for_training

Pairs = Annotated[
    Path,
    typer.Argument(
        help="Folder of pairs, or a pack of 'simrun train pairs'; the split 'train' is used."
    ),
]
Size = Annotated[
    str | None,
    typer.Option(
        "--size", metavar="WIDTHxHEIGHT", help="Train on sequences of this image size alone."
    ),
]
RunFolder = Annotated[
    Path, typer.Option("--out", help="Folder of the run; the same command resumes it.")
]
Steps = Annotated[int, typer.Option("--steps", min=1, help="Total updates.")]
Clips = Annotated[int, typer.Option("--clips", min=1, help="Clips per batch.")]
Latents = Annotated[
    int, typer.Option("--latents", min=2, help="Latents of a clip: 12 are 45 frames, 24 are 93.")
]
Stride = Annotated[
    int, typer.Option("--stride", min=1, help="Frames between the starts of a sequence's clips.")
]
PeakLr = Annotated[float, typer.Option("--lr", min=1e-7, help="Peak learning rate.")]
Threads = Annotated[int | None, typer.Option("--threads", min=1, help="Torch threads.")]
Unit = Annotated[int, typer.Option("--steps", min=1, help="U: updates of a stage of share 1.")]
Accumulate = Annotated[int, typer.Option("--accumulate", min=1, help="Batches per update.")]
Columns = Annotated[
    int | None, typer.Option("--columns", min=2, help="Crop to this width, in latents of 8 pixels.")
]
Ema = Annotated[
    float, typer.Option("--ema", min=0.0, max=0.99999, help="Decay of the averaged (EMA) weights.")
]
Perceptual = Annotated[
    float,
    typer.Option("--perceptual", min=0.0, help="Weight of the perceptual loss; 10 in the paper."),
]
Channels = Annotated[
    Literal["amplitude", "equal"],
    typer.Option(
        "--channels", help="Weights of latent channels: by amplitude in pixels, or equal."
    ),
]
Precision = Annotated[
    Literal["fp32", "bf16"], typer.Option("--precision", help="Precision of the forward passes.")
]
Device = Annotated[
    str, typer.Option("--device", help="cpu, cuda or cuda:N; a run may go on on another.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of weights, sampling and noise.")]
MetricWeights = Annotated[
    Path | None,
    typer.Option(
        "--metric-weights",
        help="Folder with LPIPS weights for the perceptual term; otherwise perceptual-syn.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


def use_threads(threads: int | None) -> None:
    """Set the number of torch threads, if given."""
    if threads is not None:
        torch.set_num_threads(threads)


def scene_files(scenes: Path, split: str) -> list[Path]:
    """Return the scenarios of a split in order of number, so that the first few cover all
    families.
    """
    return sorted(
        (scenes / split).glob("*.yaml"), key=lambda path: (path.stem.rsplit("_", 1)[-1], path.stem)
    )


class Progress:
    """Report progress and remaining time of a training command on standard error.

    Args:
        steps: Total updates.
        every: Updates between two lines; by default a hundred lines in total.
    """

    def __init__(self, steps: int, interval: int | None = None) -> None:
        self.console, self.steps, self.began_s = Console(stderr=True), steps, time.monotonic()
        self.interval = interval or max(steps // 100, 1)

    def perceptual_term(
        self, metric_weights: Path | None, device: str = "cpu"
    ) -> tuple[str, Distance]:
        """Select the perceptual distance of the loss, and print its name.

        Raises:
            InputError: The named folder has no LPIPS weights.
            InfrastructureError: There is no such device.
        """
        name, measure = distance_for_training(metric_weights)
        if isinstance(measure, torch.nn.Module):
            measure.to(require_device(device))
        self.console.print(f"perceptual term: {name}")
        return name, measure.distance

    def float32(self, precision: torch.dtype | None, stages: Sequence[Stage]) -> None:
        """Say which stages are trained in float32 though the run's precision is another."""
        for stage in stages if precision is not None else ():
            if stage.always_float32:
                self.console.print(
                    f"stage {stage.name} is trained in float32, whatever --precision says",
                    highlight=False,
                )

    def prepared(self, subject: str, done: int, count: int, interval: int = 10) -> None:
        """Report preparation before the first update."""
        if done == count or done % interval == 0:
            self.console.print(
                f"{subject}: {done}/{count}, {time.monotonic() - self.began_s:.0f} s"
            )

    def update(self, step: int, numbers: Mapping[str, float]) -> None:
        """Report an update; ``numbers["s"]`` is its duration in seconds."""
        if step % self.interval == 0 or step == self.steps:
            values = ", ".join(f"{key} {value:.4g}" for key, value in numbers.items())
            left = (self.steps - step) * numbers["s"]
            self.console.print(
                f"{step}/{self.steps} {values}; about {left / 60:.0f} min left", highlight=False
            )

    def wrote(self, path: Path, as_json: bool, card: Path | None = None) -> None:
        """Print the path of the weights; with ``as_json`` also one JSON document on standard
        output.

        Args:
            path: The file of weights, in the folder of its run.
            as_json: Print ``weights``, ``sha256``, ``bytes``, ``card``, ``steps``, ``hours`` and
                ``last``, the log's last means.
            card: Path of the model card; by default the one that `ModelCard` writes, if it exists.
        """
        self.console.print(f"wrote {path}", highlight=False, markup=False, soft_wrap=True)
        if not as_json:
            return
        rows, hours = curves(path.parent / LOG_FILE)
        card = card or path.with_suffix(".card.json")
        facts = {
            "weights": str(path),
            "sha256": file_sha256(path),
            "bytes": path.stat().st_size,
            "card": str(card) if card.exists() else None,
            "steps": rows[-1]["step"],
            "hours": hours,
            "last": rows[-1],
        }
        say_document(facts)
