"""``simrun train scenes``: draw the scenarios of a split, or check the frozen test scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.core.printing import say_document
from alpasim_plugin.lab.cli.training_options import AsJson, Debug
from alpasim_plugin.lab.training.frozen_scenes import RECORD, check_scenes
from alpasim_plugin.lab.training.scenes import SPLITS, Split, write_scenes

EPILOG = "Examples: `simrun train scenes --out data/scenes --split train`, `simrun train scenes --out data/scenes --check`"


def scenes(
    out: Annotated[Path, typer.Option("--out", help="Folder of scenes: SPLIT/FAMILY_NUMBER.yaml.")],
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
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Only check that OUT holds the test scenes frozen before training."
        ),
    ] = False,
    record: Annotated[
        Path, typer.Option("--record", help="File with the hashes that --check compares with.")
    ] = RECORD,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Draw scenarios; every scene of test-unseen has a part of a road or of the traffic, an
    appearance and damage that the splits train, val and test-known do not have.
    """
    del debug
    console = Console(stderr=True)
    if check:
        digests = {name: frozen.sha256 for name, frozen in check_scenes(out, record).items()}
        for name, digest in digests.items():
            console.print(f"{name}: {digest[:16]}, as frozen", highlight=False)
        if as_json:
            say_document(digests)
        return
    recipe = SPLITS[split]
    paths = []
    for path in write_scenes(out, split, count or recipe.count, duration_s or recipe.duration_s):
        paths.append(str(path))
        console.print(str(path), highlight=False, markup=False, soft_wrap=True)
    if as_json:
        say_document({"split": split, "scenes": len(paths), "paths": paths})
