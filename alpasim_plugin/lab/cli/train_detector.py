"""``simrun train detector``: our own detectors of vehicles and lanes, for Cuboid F1 and Lane F1."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.core.printing import say_document
from alpasim_plugin.lab.cli import training_options as options
from alpasim_plugin.lab.training.detectors import RECORD_FILE, train_detectors

EPILOG = """
Examples:

- `simrun train detector data/pairs --out data/detectors`

- `simrun bench quality data/pairs --fixer 3dgs,onefixer --detectors data/detectors --out runs/objects`
"""

Steps = Annotated[int, typer.Option("--steps", min=1, help="Updates of each detector.")]
Check = Annotated[
    Path | None,
    typer.Option(
        "--check", help="Folder of pairs to measure on; by default the one that is trained on."
    ),
]
CheckSplit = Annotated[
    str,
    typer.Option(
        "--check-split", help="Split whose clean frames precision and recall are measured on."
    ),
]


def detector(
    data: options.Pairs,
    out: options.RunFolder,
    steps: Steps = 1500,
    check: Check = None,
    check_split: CheckSplit = "val",
    device: options.Device = "cpu",
    threads: options.Threads = None,
    seed: options.Seed = 0,
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Train our own detectors of vehicles and of lane lines on the clean frames of rendered scenes.

    Writes OUT/cuboid_detector.pt and OUT/lane_detector.pt, which 'simrun bench quality' takes by
    --detectors, and OUT/detectors.json: their precision and recall on clean frames of other
    scenes.
    """
    del debug
    options.use_threads(threads)
    progress = {name: options.Progress(steps) for name in ("cuboid_f1", "lane_f1")}

    def report(name: str, step: int, numbers: Mapping[str, float]) -> None:
        progress[name].update(step, numbers)

    record = train_detectors(data, out, steps, seed, check or data, check_split, report, device)
    if as_json:
        say_document(record)
        return
    console = Console()
    for name, values in record["clean_frames"].items():
        words = ", ".join(
            f"{key} {'none' if value is None else format(value, '.3f')}"
            for key, value in values.items()
        )
        console.print(f"{name} on clean frames: {words}", highlight=False)
    console.print(f"wrote {out / RECORD_FILE}", highlight=False, markup=False, soft_wrap=True)
