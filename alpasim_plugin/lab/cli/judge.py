"""``simrun judge``: check, freeze and describe the networks that measure images."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import torch
import typer
from rich.console import Console
from torch import nn

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import file_sha256
from alpasim_plugin.lab.bench.judge_check import (
    CheckClip,
    cuboid_card,
    lane_card,
    oracle,
    style_card,
    sweep,
)
from alpasim_plugin.lab.cli.training_options import scene_files
from alpasim_plugin.lab.learned_metrics.nets.files import (
    NAMES,
    check_digests,
    file_name,
    freeze,
    judges_folder,
    load_judge,
    read_judge,
)
from alpasim_plugin.lab.learned_metrics.nets.style_net import StyleNet
from alpasim_plugin.lab.training.learned_metrics.frames import chosen
from alpasim_plugin.lab.training.learned_metrics.labels import sequence_labels
from alpasim_plugin.lab.training.learned_metrics.style import styled_frames
from alpasim_plugin.lab.training.pair_store import PairDataset

app = typer.Typer(
    no_args_is_help=True,
    help="Check, freeze and describe the judges: networks that measure images (docs/lab/judges.md).",
)
CHECKED = (*NAMES, "fvmd_lk")
EVERY = 6  # frames between two that are compared with the truth
CHECK_EPILOG = """
Examples:

- `simrun judge check data/pairs --scenes data/scenes --judge lane`

- `simrun judge check data/pairs --scenes data/scenes --judge video --seed 1 --clips 8 --out runs/judges/cards`

- `simrun judge check data/pairs --scenes data/scenes --judge cuboid --weights runs/judges/cuboid-0/judge-cuboid-0.safetensors`
"""
FREEZE_EPILOG = """
Examples:

- `simrun judge freeze`

- `simrun judge freeze --folder runs/judges/mine`
"""
HASH_EPILOG = "Example: `simrun judge hash --json`"
Folder = Annotated[
    Path | None, typer.Option("--folder", help="Folder of the judges; the shipped ones by default.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


@app.callback()
def judge() -> None:
    """Check, freeze and describe the judges."""


@app.command(epilog=CHECK_EPILOG)
def check(
    data: Annotated[Path, typer.Argument(help="Folder of pairs.")],
    scenes: Annotated[Path, typer.Option("--scenes", help="Folder of their scenes: the truth.")],
    name: Annotated[str, typer.Option("--judge", help=f"{', '.join(CHECKED)}.")],
    split: Annotated[
        str,
        typer.Option(
            "--split", help="Split of the pairs; a test split only for a judge that is frozen."
        ),
    ] = "val",
    clips: Annotated[int, typer.Option("--clips", min=2, help="Clips that are damaged.")] = 6,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the judge's training.")] = 0,
    weights: Annotated[
        Path | None, typer.Option("--weights", help="A judge that is not frozen yet.")
    ] = None,
    folder: Folder = None,
    frames: Annotated[
        int | None,
        typer.Option("--frames", min=16, help="First frames of the damaged clips; all by default."),
    ] = None,
    truth_clips: Annotated[
        int | None,
        typer.Option(
            "--truth-clips",
            min=1,
            help="Clips (style: scenes) compared with the truth; all by default.",
        ),
    ] = None,
    kept: Annotated[
        Path | None, typer.Option("--labels", help="Folder that keeps the truth.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for NAME-SEED-SPLIT.json.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Measure how far a judge can be trusted: against simulator truth, and under rising damage;
    prints its card.
    """
    del debug
    if name not in CHECKED:
        raise InputError(
            f"--judge {name}: no such judge",
            f"choose one of {', '.join(CHECKED)}",
        )
    if weights is not None and split not in ("train", "val"):
        raise InputError(
            f"--split {split}: a judge that is not frozen",
            "freeze it first; test splits are for frozen judges",
        )
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    net = (
        None
        if name == "fvmd_lk"
        else read_judge(weights, name)  # type: ignore[arg-type]
        if weights
        else load_judge(name, seed, folder)
    )
    where = kept or Path("runs/judges/labels")
    card: dict[str, Any] = {"judge": name, "seed": seed, "split": split}
    if net is not None:
        card["sha256"] = file_sha256(weights or (folder or judges_folder()) / file_name(name, seed))  # type: ignore[arg-type]
    if isinstance(net, StyleNet):
        card |= style_card(net, styled_frames(scene_files(scenes, split)[:truth_clips], where))
    else:
        card |= _card(name, net, data, scenes, split, where, (clips, frames, truth_clips))
    if out is not None:
        write_json(out / f"{name}-{seed}-{split}.json", card)
    print(json.dumps(card) if as_json else _readable(card))


def _card(
    name: str,
    net: nn.Module | None,
    data: Path,
    scenes: Path,
    split: str,
    kept: Path,
    sizes: tuple[int, int | None, int | None],
) -> dict[str, Any]:
    count, frames, truth_clips = sizes
    sequences = chosen(PairDataset(data, split).sequences, truth_clips, training=False)
    everything = []
    for sequence in sequences:
        labels = sequence_labels(sequence, scenes, kept, EVERY)
        everything.append(
            CheckClip(sequence.name, np.array(sequence.clip.rgb_gt), labels.camera, labels)
        )
    card: dict[str, Any] = {"clips": len(everything)}
    if name == "lane":
        card["truth"] = lane_card(_given(net), everything)
    if name == "cuboid":
        card["truth"] = cuboid_card(_given(net), everything)
    some = [replace(clip, frames=clip.frames[:frames]) for clip in everything[:count]]
    if name in ("video", "fvmd_lk"):
        card["oracle_halves"] = oracle(name, net, everything)
    return {**card, "damaged_clips": [clip.name for clip in some], "damage": sweep(name, net, some)}


def _given(net: nn.Module | None) -> nn.Module:
    assert net is not None
    return net


def _readable(card: dict[str, Any]) -> str:
    """Return a card as lines ``key: value``; of damage, the values by strength."""
    lines: list[str] = []

    def walk(value: Any, path: str) -> None:
        if isinstance(value, dict) and "in_order" in value:
            word = {True: "in order", False: "NOT in order", None: "not judged"}[value["in_order"]]
            lines.append(
                f"{path}: "
                + " ".join("-" if v is None else f"{v:.4g}" for v in value["values"])
                + f" ({word})"
            )
        elif isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{path}.{key}" if path else str(key))
        else:
            lines.append(f"{path}: {value:.4g}" if isinstance(value, float) else f"{path}: {value}")

    walk(card, "")
    return "\n".join(lines)


@app.command("freeze", epilog=FREEZE_EPILOG)
def freeze_judges(folder: Folder = None, as_json: AsJson = False, debug: Debug = False) -> None:
    """Record the SHA-256 of all judges in a folder; refuses if a frozen one has changed. Do this
    before any fixer is compared.
    """
    del debug
    _print(freeze(folder or judges_folder()), as_json)


@app.command("hash", epilog=HASH_EPILOG)
def hashes(folder: Folder = None, as_json: AsJson = False, debug: Debug = False) -> None:
    """Compare every frozen judge with its recorded SHA-256 and print them; exit code 2 if one has
    changed.
    """
    del debug
    _print(check_digests(folder), as_json)


def _print(digests: dict[str, str], as_json: bool) -> None:
    if as_json:
        print(json.dumps(digests))
    else:
        for file, digest in digests.items():
            print(digest, file)
        Console(stderr=True).print(f"{len(digests)} judges, all as frozen", highlight=False)
