"""``simrun train transfer | photographs``: pairs of what nobody drives through, procedural or
photographed.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.drives.build import SCENARIO_FILE
from alpasim_plugin.gaussians.fit.photographs import read_photographs
from alpasim_plugin.lab.cli.training_options import AsJson, Debug
from alpasim_plugin.lab.training.drive_pairs import make_drive_pairs
from alpasim_plugin.lab.training.photograph_pairs import PhotographRecipe, make_photograph_pairs
from alpasim_plugin.lab.training.transfer_pairs import make_transfer_sequence
from alpasim_plugin.lab.training.transfer_scenes import (
    SPLITS,
    Split,
    TransferScene,
    check_frozen,
    transfer_scene,
)
from alpasim_plugin.runs.executors.local import map_jobs
from scenarios.drive import DRIVE_FILE
from scenarios.load import load_scenario

PHOTOGRAPHS_EPILOG = "Example: `simrun train photographs photos/ --out data/photographs`"
TRANSFER_EPILOG = "Example: `simrun train transfer --out data/transfer --jobs 2`"


def transfer(
    out: Annotated[
        Path, typer.Option("--out", help="Folder to write to; the same command resumes.")
    ],
    split: Annotated[
        str, typer.Option("--split", help="Splits, comma-separated, in this order: test, train.")
    ] = "test,train",
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Only the first N scenes of each split.")
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Processes, one thread each.")] = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Render pairs of scenes beyond driving: rooms, objects on a table, garden paths, from a
    hand-held camera; the map is black.

    The scenes are frozen: 32 to train on, 8 to test with. Complete sequences are kept.
    """
    del debug
    check_frozen()
    work = [
        transfer_scene(name, i)
        for name in splits_of(split)
        for i in range(min(count or SPLITS[name].count, SPLITS[name].count))
    ]
    console = Console(stderr=True)
    began = time.perf_counter()
    rows = []
    maker = _Maker(out)
    for number, (scene, made) in enumerate(map_jobs(maker, work, jobs), start=1):
        rows.append(
            {
                "split": scene.split,
                "sequence": scene.name,
                "folder": str(maker.folder(scene)),
                "made": made,
            }
        )
        note = "" if made else " (exists)"
        line = f"[{number}/{len(work)}] {scene.split}/{scene.name}{note}, {time.perf_counter() - began:.0f} s"
        console.print(line, highlight=False, markup=False, soft_wrap=True)
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


def photographs(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder with images and the transforms.json of Instant-NGP, or an imported drive."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder to write to; the same command resumes.")
    ],
    name: Annotated[
        str | None, typer.Option("--name", help="Of the sequences; the folder's by default.")
    ] = None,
    split: Annotated[str, typer.Option("--split", help="Split of the sequences.")] = "test",
    width: Annotated[
        int, typer.Option("--width", min=16, help="Pixels across, a multiple of 16.")
    ] = 256,
    every: Annotated[
        int,
        typer.Option(
            "--every", min=2, help="Hold out every N-th photograph, in N ways: N sequences."
        ),
    ] = 5,
    steps: Annotated[
        int, typer.Option("--steps", min=1, help="Updates of the fit; few leave it under-trained.")
    ] = 300,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the fit.")] = 0,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Fit an under-trained reconstruction to posed photographs and write it beside them as pairs;
    the map is black.

    Photographs that the file lists and the folder lacks are named and left out. Of an imported
    drive the pairs are the held-out photographs alone, with its map, and with the photographs that
    were fitted as recorded frames.
    """
    del debug
    console, rows = Console(stderr=True), []
    missing: tuple[str, ...] = ()
    recipe, named = (
        PhotographRecipe(width, every, steps, split=split, seed=seed),
        name or folder.resolve().name,
    )
    if (folder / DRIVE_FILE).is_file():
        made = make_drive_pairs(load_scenario(str(folder / SCENARIO_FILE)), named, out, recipe)
    else:
        found = read_photographs(folder, width)
        missing, made = found.missing, make_photograph_pairs(found, named, out, recipe)
    if missing:
        shown = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
        console.print(
            f"{len(missing)} of the listed images are missing: {shown}",
            highlight=False,
            markup=False,
        )
    for one in made:
        rows.append({"folder": str(one.folder), "made": one.made, "psnr_db": dict(one.psnr_db)})
        quality = ", ".join(
            f"{key.replace('_', ' ')} {value:.2f} dB" for key, value in one.psnr_db.items()
        )
        console.print(
            f"{one.folder}{'' if one.made else ' (exists)'}: {quality}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    if as_json:
        print(json.dumps({"sequences": len(rows), "missing": list(missing), "rows": rows}))


def splits_of(text: str) -> list[Split]:
    """Parse a comma-separated list of splits.

    Raises:
        InputError: An unknown split.
    """
    names = [name.strip() for name in text.split(",")]
    known: list[Split] = [name for name in SPLITS if name in names]
    if len(known) != len(names):
        raise InputError(
            f"--split {text}: no such split, or one twice",
            f"choose from {', '.join(SPLITS)}",
        )
    return sorted(known, key=names.index)


@dataclass(frozen=True)
class _Maker:
    out: Path

    def folder(self, scene: TransferScene) -> Path:
        return self.out / scene.split / scene.name

    def __call__(self, scene: TransferScene) -> bool:
        return make_transfer_sequence(scene, self.folder(scene))
