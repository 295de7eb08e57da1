"""``simrun train scenes | check-scenes``: scenarios of the splits, and the frozen test scenes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.lab.cli.training_options import AsJson, Debug, RunFolder
from alpasim_plugin.lab.training.frozen_scenes import RECORD, check_scenes, freeze_scenes
from alpasim_plugin.lab.training.scenes import SPLITS, TEST_SPLITS, Split, write_scenes

SCENES_EPILOG = "Example: `simrun train scenes --out data/scenes --split train`"
CHECK_EPILOG = "Example: `simrun train check-scenes data/scenes`"


def scenes(
    out: RunFolder,
    split: Annotated[Split, typer.Option("--split", help="Split to write.")] = "train",
    count: Annotated[
        int | None,
        typer.Option("--count", min=1, help="Number of scenes; by default 408, 24, 30 and 30."),
    ] = None,
    duration_s: Annotated[
        float | None,
        typer.Option(
            "--duration-s",
            min=1.0,
            help="Length of every drive, seconds; by default 6, for tests 19.8.",
        ),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Sample scenarios; test-unseen has families of roads and traffic, looks and damage that no
    other split has.
    """
    del debug
    console = Console(stderr=True)
    paths = []
    recipe = SPLITS[split]
    for path in write_scenes(out, split, count or recipe.count, duration_s or recipe.duration_s):
        paths.append(str(path))
        console.print(str(path), highlight=False, markup=False, soft_wrap=True)
    if as_json:
        print(json.dumps({"split": split, "scenes": len(paths), "paths": paths}))


def check_frozen(
    scenes: Annotated[
        Path, typer.Argument(help="Folder that 'simrun train scenes' wrote, with both test splits.")
    ],
    record: Annotated[
        Path, typer.Option("--record", help="File with the hashes; by default the shipped one.")
    ] = RECORD,
    splits: Annotated[
        str, typer.Option("--split", help="Splits to freeze, comma-separated.")
    ] = ",".join(TEST_SPLITS),
    freeze: Annotated[
        bool,
        typer.Option(
            "--freeze", help="Write the record, which must not exist yet, instead of checking."
        ),
    ] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Check that the test scenes are those that were frozen before training began."""
    del debug
    names = [name.strip() for name in splits.split(",")]
    found = freeze_scenes(scenes, record, names) if freeze else check_scenes(scenes, record)
    for name, split in found.items():
        line = f"{name}: {len(split.scenes)} scenes, {split.sha256[:16]} {'frozen' if freeze else 'as frozen'}"
        Console(stderr=True).print(line, highlight=False, markup=False)
    if as_json:
        print(json.dumps({name: split.sha256 for name, split in found.items()}))
