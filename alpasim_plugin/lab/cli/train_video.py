"""``simrun train video``: recorded driving videos, clean and damaged, as sequences for training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.lab.cli.image_sizes import parse_size
from alpasim_plugin.lab.cli.training_options import AsJson, Debug
from alpasim_plugin.lab.training.video_pairs import VideoRecipe, make_video_pairs

VIDEO_EPILOG = "Example: `simrun train video drive1.mp4 drive2.mp4 --out data/video --size 256x144 --size 512x288`"


def video(
    videos: Annotated[
        list[Path], typer.Argument(help="Driving videos whose licence lets you train on them.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="Folder to write to: train/ and held-out/; the same command resumes."
        ),
    ],
    size: Annotated[
        list[str] | None,
        typer.Option("--size", metavar="WIDTHxHEIGHT", help="Repeatable; by default 256x144."),
    ] = None,
    variants: Annotated[
        int,
        typer.Option(
            "--variants", min=1, help="Differently damaged sequences of each part and size."
        ),
    ] = 2,
    train_share: Annotated[
        float,
        typer.Option(
            "--train-share", min=0.05, max=0.95, help="First share of every video, to train on."
        ),
    ] = 0.7,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the damage.")] = 0,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Cut videos into a part to train on and a held-out one, and damage both as an under-trained
    reconstruction would.
    """
    del debug
    console, rows = Console(stderr=True), []
    for path in videos:
        for text in size or ["256x144"]:
            recipe = VideoRecipe(parse_size(text), variants, train_share, seed=seed)
            for folder, made in make_video_pairs(path, out, recipe):
                rows.append({"folder": str(folder), "made": made})
                console.print(
                    f"{folder}{'' if made else ' (exists)'}",
                    highlight=False,
                    markup=False,
                    soft_wrap=True,
                )
    if as_json:
        print(
            json.dumps(
                {
                    "sequences": len(rows),
                    "made": sum(bool(row["made"]) for row in rows),
                    "rows": rows,
                }
            )
        )
