"""``simrun train photographs``: pairs of posed photographs or of an imported drive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.printing import say_document
from alpasim_plugin.drives.build import SCENARIO_FILE
from alpasim_plugin.lab.cli.training_options import AsJson, Debug, Device
from alpasim_plugin.lab.training.drive_pairs import make_drive_pairs
from alpasim_plugin.lab.training.photograph_pairs import PhotographRecipe, make_photograph_pairs
from alpasim_plugin.lab.training.photographs import read_photographs
from scenarios.drive import DRIVE_FILE
from scenarios.load import load_scenario

EPILOG = "Example: `simrun train photographs photos/ --out data/photographs`"


Folder = Annotated[
    Path,
    typer.Argument(
        help="Folder with images and the transforms.json of Instant-NGP, or an imported drive."
    ),
]
Out = Annotated[Path, typer.Option("--out", help="Folder to write to; the same command resumes.")]
Name = Annotated[
    str | None, typer.Option("--name", help="Of the sequences; the folder's by default.")
]
Width = Annotated[int, typer.Option("--width", min=16, help="Pixels across, a multiple of 16.")]
Period = Annotated[
    int,
    typer.Option("--every", min=2, help="Hold out every N-th photograph, in N ways: N sequences."),
]
Steps = Annotated[
    int, typer.Option("--steps", min=1, help="Updates of the fit; few leave it under-trained.")
]


def photographs(
    folder: Folder,
    out: Out,
    name: Name = None,
    split: Annotated[str, typer.Option("--split", help="Split of the sequences.")] = "test",
    width: Width = 256,
    period: Period = 5,
    steps: Steps = 300,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the fit.")] = 0,
    device: Device = "cpu",
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
    console = Console(stderr=True)
    rows = []
    missing: tuple[str, ...] = ()
    recipe = PhotographRecipe(width, period, steps, split=split, seed=seed)
    named = name or folder.resolve().name
    if (folder / DRIVE_FILE).is_file():
        scenario = load_scenario(str(folder / SCENARIO_FILE))
        made = make_drive_pairs(scenario, named, out, recipe, require_device(device))
    else:
        posed = read_photographs(folder, width)
        missing = posed.missing
        made = make_photograph_pairs(posed, named, out, recipe, require_device(device))
    if missing:
        examples = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
        console.print(
            f"{len(missing)} of the listed images are missing: {examples}",
            highlight=False,
            markup=False,
        )
    for pairs in made:
        rows.append(
            {"folder": str(pairs.folder), "made": pairs.made, "psnr_db": dict(pairs.psnr_db)}
        )
        quality = ", ".join(
            f"{key.replace('_', ' ')} {value:.2f} dB" for key, value in pairs.psnr_db.items()
        )
        console.print(
            f"{pairs.folder}{'' if pairs.made else ' (exists)'}: {quality}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    if as_json:
        say_document({"sequences": len(rows), "missing": list(missing), "rows": rows})
