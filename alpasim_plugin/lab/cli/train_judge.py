"""``simrun train judge``: the networks that measure images and are used in no loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import torch
import typer
from torch import nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.cli.training_options import AsJson, Debug, Progress, scene_files
from alpasim_plugin.lab.learned_metrics.nets.files import NAMES, JudgeName, file_name, save_judge
from alpasim_plugin.lab.training.learned_metrics.cuboid import CuboidRecipe, CuboidTask
from alpasim_plugin.lab.training.learned_metrics.frames import LabelledFrames, chosen
from alpasim_plugin.lab.training.learned_metrics.labels import all_labels
from alpasim_plugin.lab.training.learned_metrics.lane import LaneRecipe, LaneTask
from alpasim_plugin.lab.training.learned_metrics.style import StyleRecipe, StyleTask, styled_frames
from alpasim_plugin.lab.training.learned_metrics.video import VideoRecipe, VideoTask
from alpasim_plugin.lab.training.model_card import ModelCard, curves
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.training.trainer import LOG_FILE, Schedule, Trainer

EPILOG = """
Examples:

- `simrun train judge lane data/pairs --scenes data/scenes --out runs/judges/lane-0`

- `simrun train judge cuboid data/pairs --scenes data/scenes --out runs/judges/cuboid-1 --seed 1`

- `simrun train judge style data/pairs --scenes data/scenes --out runs/judges/style-0 --steps 300`
"""
EVERY = 6  # frames between two labelled ones
WHAT: dict[JudgeName, str] = {
    "lane": "Lane lines on the ground from a frame of the simulator: the judge behind lane_f1_syn, lane_xerr_syn_m, lane_jitter_syn_m",
    "cuboid": "Vehicles as boxes from a frame of the simulator: the judge behind cuboid_f1_syn",
    "video": "Features of 16 frames of the simulator: the judge behind fd_syn_16 and fd_syn_clip; not I3D",
    "style": "Style of a frame of the simulator (clear, night, fog, snow): the judge behind style_acc_syn",
}
STEPS: dict[JudgeName, int] = {"lane": 1200, "cuboid": 2500, "video": 1200, "style": 300}


@dataclass(frozen=True)
class Made:
    """A judge's training task, and which part of its module is the judge."""

    task: Any
    net: nn.Module


def judge(
    name: Annotated[str, typer.Argument(help=f"{', '.join(NAMES)}.")],
    data: Annotated[
        Path, typer.Argument(help="Folder of pairs; clean frames of the split train are used.")
    ],
    scenes: Annotated[
        Path,
        typer.Option(
            "--scenes", help="Folder of the scenes that the pairs were rendered from: the truth."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the run; the same command resumes it.")
    ],
    steps: Annotated[
        int | None,
        typer.Option("--steps", min=1, help="Total updates; by default as the shipped judge."),
    ] = None,
    until: Annotated[
        int | None,
        typer.Option(
            "--until",
            min=1,
            help="Stop at this update of the schedule; the same command without it goes on.",
        ),
    ] = None,
    sequences: Annotated[
        int,
        typer.Option(
            "--sequences",
            min=1,
            help="At most so many sequences (style: a quarter as many scenes).",
        ),
    ] = 160,
    kept: Annotated[
        Path | None,
        typer.Option("--labels", help="Folder that keeps the truth; OUT/../labels by default."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of weights and draws.")] = 0,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Torch threads.")] = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Train a judge on clean frames of the simulator with its truth; writes
    OUT/judge-NAME-SEED.safetensors, averaged weights in float16.

    A judge measures and is used in no loss. Freeze it before it measures anything: `simrun judge
    freeze`.
    """
    del debug
    if name not in NAMES:
        raise InputError(
            f"name {name!r}: no such judge",
            f"choose one of {', '.join(NAMES)}",
        )
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    total = steps or STEPS[name]
    progress = Progress(total, every=25)
    made = _BUILD[name](data, scenes, kept or out.parent / "labels", sequences, seed, progress)
    schedule = Schedule(total, peak_lr=2e-3, warmup=min(50, total // 5), ema=0.99, save_every=50)
    trainer = Trainer(
        made.task.module, out, schedule, made.task.batch, made.task.loss, made.task.facts
    )
    trainer.run(progress.update, until)
    made.task.module.load_state_dict(trainer.averaged())
    path = out / file_name(name, seed)
    save_judge(
        path,
        name,
        made.net,
        {"made_by": "simrun train judge", "steps": str(trainer.step), "seed": str(seed)},
    )
    rows, hours = curves(out / LOG_FILE)
    ModelCard(
        WHAT[name],
        made.task.facts,
        {"schedule": asdict(schedule), "updates": trainer.step},
        rows,
        hours,
    ).write(path)
    progress.wrote(path, as_json)


def _labelled(
    data: Path, scenes: Path, kept: Path, count: int, progress: Progress
) -> LabelledFrames:
    sequences = chosen(PairDataset(data, "train").sequences, count)
    labels = all_labels(
        sequences, scenes, kept, EVERY, report=lambda done, n: progress.prepared("truth", done, n)
    )
    return LabelledFrames(sequences, tuple(labels))


def _lane(data: Path, scenes: Path, kept: Path, count: int, seed: int, progress: Progress) -> Made:
    task = LaneTask(_labelled(data, scenes, kept, count, progress), LaneRecipe(seed=seed))
    return Made(task, task.module)


def _cuboid(
    data: Path, scenes: Path, kept: Path, count: int, seed: int, progress: Progress
) -> Made:
    task = CuboidTask(_labelled(data, scenes, kept, count, progress), CuboidRecipe(seed=seed))
    return Made(task, task.module)


def _video(data: Path, scenes: Path, kept: Path, count: int, seed: int, progress: Progress) -> Made:
    del scenes, kept, progress
    task = VideoTask(chosen(PairDataset(data, "train").sequences, count), VideoRecipe(seed=seed))
    return Made(task, task.module.net)


def _style(data: Path, scenes: Path, kept: Path, count: int, seed: int, progress: Progress) -> Made:
    del data
    files = scene_files(scenes, "train")[: max(count // 4, 1)]
    frames = styled_frames(files, kept, lambda done, n: progress.prepared("scenes", done, n))
    facts = {"scenes": [f.stem for f in files], "frames": int(frames.shape[1])}
    task = StyleTask(frames, StyleRecipe(seed=seed), facts)
    return Made(task, task.module)


_BUILD: dict[str, Callable[[Path, Path, Path, int, int, Progress], Made]] = {
    "lane": _lane,
    "cuboid": _cuboid,
    "video": _video,
    "style": _style,
}
