"""``simrun bench quality``: fixers over recorded clips, open loop, against ground-truth frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from alpasim_plugin.cli.options import fixer_overrides
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import resolve, split_names, split_settings
from alpasim_plugin.core.printing import say_document
from alpasim_plugin.lab.bench.quality import (
    RAW,
    InputKind,
    Variant,
    Work,
    evenly,
    measure_quality,
)
from alpasim_plugin.lab.training.bundle_fixer import bundle_fixer
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.video_metrics.image_distance import FOLDER_VARIABLE, weights_folder
from alpasim_plugin.lab.video_metrics.summary import TRUTH
from alpasim_plugin.lab.video_metrics.table import markdown

EPILOG = """
Examples:

- `simrun bench quality data/pairs --split test --fixer 3dgs,onefixer --out runs/quality`

- `simrun bench quality data/video --split held-out --input truth --fixer onefixer --baseline onefixer --out runs/unharmed`

- `simrun bench quality data/pairs --fixer 3dgs,v9=runs/v9/fixer.safetensors,two=onefixer@2 --set two:fixer.window=4 --jobs 2 --out runs/q`
"""


Out = Annotated[
    Path, typer.Option("--out", help="Folder for results; the same command continues there.")
]
Fixers = Annotated[
    str,
    typer.Option("--fixer", help="Comma-separated: 3dgs, NAME[@STEPS], LABEL=NAME, LABEL=FILE."),
]
InputKindOption = Annotated[
    InputKind,
    typer.Option(
        "--input",
        help="What fixers get: the degraded render; the ground truth, opaque, which they should leave alone; or the truth "
        "that has lost resolution (blur, cells of 2 to 4 pixels, up to 3 holes that stay in place).",
    ),
]
Baseline = Annotated[
    str, typer.Option("--baseline", help="Variant that the others are compared with.")
]
Frames = Annotated[
    int,
    typer.Option(
        "--frames", min=2, help="First frames of every clip; shorter clips are taken whole."
    ),
]
Clips = Annotated[
    int | None, typer.Option("--clips", min=1, help="At most so many clips, evenly chosen.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="[LABEL:]fixer.key=value, of one variant or of all fixers."),
]
Weights = Annotated[
    Path | None,
    typer.Option(
        "--metric-weights", help=f"Folder of the metrics' weights; also {FOLDER_VARIABLE}."
    ),
]
Detectors = Annotated[
    Path | None,
    typer.Option(
        "--detectors",
        help="Folder of cuboid_detector and lane_detector, as 'simrun train detector' writes; by default --metric-weights.",
    ),
]
Pictures = Annotated[
    int, typer.Option("--pictures", min=0, help="Clips that are shown side by side.")
]
TruthRows = Annotated[
    Path | None,
    typer.Option(
        "--truth-rows",
        help="Folder of what the clean frames measure, which several commands share; by default in --out.",
    ),
]
Device = Annotated[Literal["cpu", "cuda"], typer.Option("--device", help="Where fixers compute.")]
Jobs = Annotated[
    int,
    typer.Option(
        "--jobs",
        min=1,
        help="Clips at a time, one thread each; times are then of a busy machine.",
    ),
]
Threads = Annotated[int, typer.Option("--threads", min=1, help="Torch threads with one job.")]
AsJson = Annotated[
    bool, typer.Option("--json", help="Print the summary as one JSON document on stdout.")
]


def quality(
    data: Annotated[Path, typer.Argument(help="Folder of pairs (docs/lab/training.md).")],
    out: Out,
    fixers: Fixers = "3dgs",
    split: Annotated[str, typer.Option("--split", help="Split to measure on.")] = "test-known",
    input_kind: InputKindOption = "render",
    baseline: Baseline = RAW,
    frames: Frames = 198,
    clips: Clips = None,
    overrides: Overrides = None,
    weights: Weights = None,
    detectors: Detectors = None,
    pictures: Pictures = 4,
    truth_rows: TruthRows = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the fixers' noise.")] = 0,
    device: Device = "cpu",
    jobs: Jobs = 1,
    threads: Threads = 1,
    as_json: AsJson = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Measure fixers on recorded clips: PSNR, SSIM, perceptual distances, Warp L1, drift and time,
    with 95 % intervals over scenes.

    Writes quality.json, quality.md and sheets of images side by side; rows of finished clips are
    kept.
    """
    del debug
    variants = parse_variants(fixers, overrides or [])
    check_baseline(baseline, variants)
    sequences = evenly(PairDataset(data, split).sequences, clips)
    pictured_names = (
        {sequence.name for sequence in evenly(sequences, pictures)} if pictures else set()
    )
    works = [
        Work(
            sequence.folder,
            input_kind,
            variant,
            frames,
            seed,
            device,
            threads if jobs == 1 else 1,
            weights_folder(weights),
            out,
            sequence.name in pictured_names,
            truth_rows,
            detectors or weights_folder(weights),
        )
        for sequence in sequences
        for variant in (*variants, Variant(TRUTH))
    ]
    console = Console(stderr=True)

    def report(i: int, n: int, work: Work, row: Mapping[str, Any]) -> None:
        psnr = row["values"].get("psnr_db")
        value = "" if psnr is None else f" {psnr:.2f} dB"
        if not as_json:
            console.print(f"{i}/{n} {work.variant.label} {work.folder.name}{value}")

    summary = measure_quality(works, baseline, jobs, out, report)
    if as_json:
        say_document(summary)
    else:
        print(f"{markdown(summary)}\nwrote {out / 'quality.json'}")


def check_baseline(baseline: str, variants: Sequence[Variant]) -> None:
    """Refuse a baseline that is not measured.

    Raises:
        InputError: No variant has that label.
    """
    labels = [variant.label for variant in variants]
    if baseline not in labels:
        raise InputError(
            f"--baseline {baseline}: variants {', '.join(labels)}", "name one of the variants"
        )


def parse_variants(text: str, overrides: Sequence[str]) -> tuple[Variant, ...]:
    """Return the variants that ``--fixer`` and ``--set`` name.

    Raises:
        InputError: A label twice, a fixer or key that is not known, or a setting for a variant that
            is not there.
    """
    common: list[str] = []
    by_label: dict[str, list[str]] = {}
    for override in overrides:
        label, colon, assignment = override.partition(":")
        if colon and not label.startswith("fixer."):
            by_label.setdefault(label, []).append(assignment)
        else:
            common.append(override)
    variants: dict[str, Variant] = {}
    for part in split_names(text):
        label, equals, named = part.partition("=")
        if "[" in label:  # settings in brackets, not a label
            label = part
            equals = ""
        fixer = named if equals else label
        if label in variants or label == TRUTH or "/" in label:
            raise InputError(
                f"--fixer {text}: label {label!r} is taken, or no name of a folder",
                "write LABEL=NAME with labels of your own",
            )
        if fixer == RAW:
            variants[label] = Variant(label)
            continue
        fixer, in_brackets = split_settings(fixer)
        name, settings = bundle_fixer(fixer) if fixer.endswith(".safetensors") else (fixer, ())
        settings = (*settings, *in_brackets)
        variants[label] = Variant(
            label,
            resolve(
                "fixer", name, (*settings, *fixer_overrides([*common, *by_label.pop(label, [])]))
            ),
        )
    if by_label or not variants:
        raise InputError(
            f"--set {next(iter(by_label), '')}: no fixer of this label",
            f"the variants are {', '.join(variants) or 'none'}",
        )
    return tuple(variants.values())
