"""``simrun train perceptual``: the frozen feature network behind `perceptual-syn`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import cv2
import torch
import typer

from alpasim_plugin.lab.cli.training_options import AsJson, Debug, Progress, Steps
from alpasim_plugin.lab.training.model_card import ModelCard, curves
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.training.perceptual import PerceptualRecipe, PerceptualTask
from alpasim_plugin.lab.training.trainer import LOG_FILE, Schedule, Trainer
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME

WHAT = "Feature network of the perceptual distance perceptual-syn: not LPIPS, trained on synthetic scenes"
EPILOG = "Example: `simrun train perceptual data/pairs --out runs/perceptual --steps 1500`"


def perceptual(
    data: Annotated[
        Path,
        typer.Argument(help="Folder of pairs; clean frames and maps of the split train are used."),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the run; the same command resumes it.")
    ],
    steps: Steps = 1500,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of weights and sampling.")] = 0,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Torch threads.")] = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Train the feature network of the perceptual distance; writes OUT/perceptual-syn.safetensors
    with averaged weights, float16.
    """
    del debug
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    task = PerceptualTask(PairDataset(data, "train").sequences, PerceptualRecipe(seed=seed))
    schedule = Schedule(steps, peak_lr=2e-3, ema=0.998, save_every=100)
    trainer = Trainer(task.module, out, schedule, task.batch, task.loss, task.facts)
    progress = Progress(steps, every=50)
    trainer.run(progress.update)
    task.module.load_state_dict(trainer.averaged())
    path = out / f"{NAME}.safetensors"
    task.module.net.save(
        path, {"made_by": "simrun train perceptual", "steps": str(steps), "seed": str(seed)}
    )
    rows, hours = curves(out / LOG_FILE)
    data_card = {
        "pairs": "clean frames, renders and maps of the split train",
        "sequences": len(task.sequences),
    }
    training = {"schedule": asdict(schedule), "recipe": asdict(task.recipe)}
    ModelCard(WHAT, data_card, training, rows, hours).write(path)
    progress.wrote(path, as_json)
