"""``simrun bench paper``: all arms of the OneFixer paper on the same clips, beside the paper's
numbers.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from alpasim_plugin.core.atomic import write_json, write_text
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.judged import Judging
from alpasim_plugin.lab.bench.paper import PaperRun, compare_arms
from alpasim_plugin.lab.bench.quality_run import Work
from alpasim_plugin.lab.bench.transfer import TransferData
from alpasim_plugin.lab.cli.training_options import whole_numbers
from alpasim_plugin.lab.paper.document import claims_document, document, draw_figures
from alpasim_plugin.lab.paper.page import render_side_by_side
from alpasim_plugin.lab.paper.published import published
from alpasim_plugin.lab.paper.record import record_of, recorded
from alpasim_plugin.lab.training.model_card import command as command_line
from alpasim_plugin.lab.video_metrics.image_distance import FOLDER_VARIABLE, weights_folder
from alpasim_plugin.runs.provenance import hardware, versions

BY_DEFAULT = (
    "cycle",
    "under-trained",
    "map-error",
    "closed-loop",
    "memory",
    "transfer",
    "appearance",
)
PROTOCOLS = (*BY_DEFAULT, "cost", "regime")
EPILOG = """
Examples:

- `simrun bench paper data/pairs --scenes data/scenes --arms runs/arms --judges 0,1 --out runs/paper`

- `simrun bench paper data/pairs --arms runs/arms --drives runs/learned --drives runs/lane-camera --only closed-loop --out runs/paper`

- `simrun bench paper data/pairs --scenes data/scenes --arms runs/arms --split val --clips 4 --frames 60 --out runs/first-look`

- `simrun bench paper data/pairs --scenes data/scenes --arms runs/arms --equal-time runs/arms-60 --judges 0,1 --out runs/paper`

- `simrun bench paper data/pairs --scenes data/scenes --arms runs/arms --only cost --judges 0 --out runs/cost`

- `simrun bench paper data/pairs --scenes data/scenes --arms runs/arms --other-seed runs/arms-seed1 --only cost --judges 0 --out runs/cost`

- `simrun bench paper data/pairs --arms runs/history --split val --only regime --record runs/paper/paper.json --out runs/regime`
"""


def paper(
    data: Annotated[Path, typer.Argument(help="Folder of pairs (docs/lab/pairs.md).")],
    arms: Annotated[
        Path,
        typer.Option(
            "--arms",
            help="Folder with NAME/fixer.safetensors for every trained arm (docs/lab/arms.md).",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for results; the same command continues there.")
    ],
    scenes: Annotated[
        Path | None,
        typer.Option(
            "--scenes", help="Folder of the pairs' scenes; wrong maps and judges of lanes need it."
        ),
    ] = None,
    split: Annotated[str, typer.Option("--split", help="Split to measure on.")] = "test-known",
    long: Annotated[
        Path | None,
        typer.Option(
            "--long", help="Pairs of 900 frames for the second table; else those of DATA."
        ),
    ] = None,
    drives: Annotated[
        list[Path] | None,
        typer.Option(
            "--drives",
            help="Finished run folder of the closed loop, for the third table; may be repeated, a policy each.",
        ),
    ] = None,
    equal_time: Annotated[
        Path | None,
        typer.Option(
            "--equal-time",
            help="Folder like --arms of the arms trained with --budget minutes: both budgets' verdicts.",
        ),
    ] = None,
    other_seeds: Annotated[
        list[Path] | None,
        typer.Option(
            "--other-seed",
            help="Folder like --arms trained with another --seed, for --only cost or regime; may be repeated.",
        ),
    ] = None,
    transfer: Annotated[
        Path | None,
        typer.Option(
            "--transfer",
            help="Pairs beyond driving, for the table of the transfer (docs/lab/pairs.md).",
        ),
    ] = None,
    transfer_arms: Annotated[
        Path | None,
        typer.Option("--transfer-arms", help="Folder like --arms of the arms fine-tuned on them."),
    ] = None,
    photographs: Annotated[
        Path | None,
        typer.Option("--photographs", help="Pairs of photographs, measured the same way."),
    ] = None,
    only: Annotated[
        str, typer.Option("--only", help=f"Comma-separated protocols: {', '.join(PROTOCOLS)}.")
    ] = ",".join(BY_DEFAULT),
    clips: Annotated[
        int | None,
        typer.Option("--clips", min=2, help="At most so many clips a protocol, evenly chosen."),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option("--frames", min=2, help="First frames of a clip; as in the paper by default."),
    ] = None,
    judges: Annotated[
        str | None,
        typer.Option(
            "--judges", help="Ask the judges of these seeds, as 0,1 (docs/lab/judges.md)."
        ),
    ] = None,
    judge_folder: Annotated[
        Path | None, typer.Option("--judge-folder", help="Folder of judges that you froze.")
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option("--metric-weights", help=f"Folder of metric weights; also {FOLDER_VARIABLE}."),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record",
            help="An earlier paper.json: judges the claims that nothing measured here judges.",
        ),
    ] = None,
    map_clips: Annotated[
        int,
        typer.Option("--map-clips", min=2, help="Clips of the protocol map-error: 45 maps each."),
    ] = 8,
    filmed: Annotated[int, typer.Option("--filmed", min=1, help="Clips on the page.")] = 2,
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs",
            min=1,
            help="Clips at a time, one thread each; times are then of a busy machine.",
        ),
    ] = 1,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the fixers' noise.")] = 0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the verdicts as one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Compare all arms of the OneFixer paper: its tables beside ours, a verdict on each claim, and
    a page with every arm side by side.

    Writes paper.md, paper.json and side-by-side.html; rows of finished clips are kept.
    """
    del debug
    protocols = tuple(name.strip() for name in only.split(",") if name.strip())
    if unknown := [name for name in protocols if name not in PROTOCOLS]:
        raise InputError(
            f"--only {only}: unknown: {', '.join(unknown)}",
            f"choose from {', '.join(PROTOCOLS)}",
        )
    if other_seeds and not {"cost", "regime"} & set(protocols):
        raise InputError(
            f"--other-seed {other_seeds[0]}: --only {only}",
            "add the protocol cost or regime to --only, or leave --other-seed out",
        )
    judging = None
    if judges is not None:
        judging = Judging(
            tuple(whole_numbers("--judges", judges, 0)),
            scenes,
            None,
            weights_folder(weights),
            judge_folder,
        )
    run = PaperRun(
        data,
        scenes,
        arms,
        out,
        split,
        long,
        tuple(drives or ()),
        clips,
        frames,
        judging,
        jobs,
        seed,
        filmed,
        map_clips,
        protocols,
        None
        if transfer is None
        else TransferData(transfer, transfer_arms, photographs, clips, frames),
        equal_time,
        tuple(other_seeds or ()),
    )
    earlier = {} if record is None else recorded(record)  # before hours of measuring
    console = Console(stderr=True)

    def told(protocol: str, i: int, n: int, work: Work, row: Mapping[str, Any]) -> None:
        psnr = row["values"].get("psnr_db")
        if not as_json:
            console.print(
                f"{protocol} {i}/{n} {work.variant.label} {work.folder.name}"
                + ("" if psnr is None else f" {psnr:.2f} dB")
            )

    def told_clip(i: int, n: int, name: str) -> None:
        if not as_json:
            console.print(f"clip {i}/{n} {name}")

    found = replace(compare_arms(run, told, told_clip), recorded=earlier)
    command = command_line()
    write_text(out / "paper.md", document(published(), found, command))
    write_text(out / "claims.md", f"```bash\n{command}\n```\n\n{claims_document(found)}")
    draw_figures(found, out)
    if found.cost is not None:
        console.print(f"cost: {found.cost.about}", highlight=False)
    facts = {
        "command": command,
        "hardware": hardware(),
        "versions": versions(),
        "judges": judging and judging.identity["judges"],
    }
    verdicts = [
        {
            "claim": one.claim.text,
            "verdict": one.verdict,
            "comparisons": [asdict(r) for r in one.results],
        }
        for one in found.judged
    ]
    kept = record_of(
        found.measured, {name: measured.arms for name, measured in found.measured.items()}
    )
    write_json(out / "paper.json", {**facts, "claims": verdicts, "protocols": kept})
    if found.shown:
        first = found.rows["cycle"][0]["size"]
        write_text(
            out / "side-by-side.html",
            render_side_by_side(found.shown, (int(first[0]), int(first[1]))),
        )
    print(json.dumps(verdicts) if as_json else f"wrote {out / 'paper.md'}")
