"""``simrun bench paper``: the comparison of the paper, from drawn scenes to verdicts."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.cli.main import load_verb
from alpasim_plugin.core.errors import InfrastructureError, InputError, Stopped
from alpasim_plugin.core.files.config import Document
from alpasim_plugin.core.files.lock import one_writer
from alpasim_plugin.core.printing import say, say_document
from alpasim_plugin.lab.cli.training_options import AsJson, Debug, Device
from alpasim_plugin.lab.paper.comparison import Effort
from alpasim_plugin.lab.paper.config import PaperConfig, load_config
from alpasim_plugin.lab.paper.experiment import (
    PAGE_FILE,
    Experiment,
    experiment,
    require_kept_trainings,
    write_results,
)
from alpasim_plugin.lab.paper.stages import (
    Placed,
    State,
    is_kept,
    keep_stage,
    restore,
    run_stages,
)
from alpasim_plugin.lab.video_metrics.image_distance import FOLDER_VARIABLE, weights_folder

EPILOG = """
Examples:

- `simrun bench paper --config small --out runs/paper --dry-run`

- `simrun bench paper --config small --out runs/paper --keep configs/paper/weights`: in pieces, also on several machines

- `simrun bench paper --config small --out runs/again --weights configs/paper/weights`: the same numbers without training
"""
LOCK_FILE = ".lock"

Config = Annotated[
    str, typer.Option("--config", help="A configuration, or a shipped one: small, published.")
]
Out = Annotated[
    Path, typer.Option("--out", help="Folder of the experiment; the same command continues.")
]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Print stages and power of the claims, and run nothing.")
]
MetricWeights = Annotated[
    Path | None,
    typer.Option(
        "--metric-weights", help=f"Folder of the metrics' weights; also {FOLDER_VARIABLE}."
    ),
]
Keep = Annotated[
    Path | None,
    typer.Option(
        "--keep",
        help="Folder of complete stages: those of equal key are taken from it, new ones copied into it.",
    ),
]
Weights = Annotated[
    Path | None,
    typer.Option(
        "--weights", help="Folder of --keep: train nothing, measure and drive its systems."
    ),
]
Jobs = Annotated[
    int, typer.Option("--jobs", min=1, help="Processes of rendering, measuring and driving.")
]
Threads = Annotated[int, typer.Option("--threads", min=1, help="Torch threads of a training.")]


def paper(
    config: Config,
    out: Out,
    dry_run: DryRun = False,
    keep: Keep = None,
    weights: Weights = None,
    metric_weights: MetricWeights = None,
    device: Device = "cpu",
    threads: Threads = 1,
    jobs: Jobs = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Train the systems of the paper's tables at a stated budget, measure and drive them, and write
    the tables beside the printed ones, with a verdict on each claim.

    Writes OUT/paper.json, OUT/paper.md and OUT/figures. Each step is a command of its own below
    OUT/stages; what is complete is reused, and an interrupted step goes on. The tables are written
    after every step that measures, from what there is.
    """
    del debug
    read, document, _ = load_config(config)
    if weights is not None and keep is not None:
        raise InputError(
            "--weights and --keep: the one measures again what the other takes", "Give one of them."
        )
    networks = weights_of(read, document, metric_weights)
    ready = experiment(read, document, out, networks, Effort(device, threads, jobs))
    if not as_json:
        say(*plan_lines(ready, weights or keep))
    if dry_run:
        if as_json:
            say_document(ready.plan())
        return
    console = Console(stderr=True)

    def report(item: Placed, state: State) -> None:
        words = {"done": "reused", "begun": "goes on", "open": "begins"}[state]
        text = f"stage {item.stage.name} ({item.key}): {words}"
        console.print(text, highlight=False, markup=False, soft_wrap=True)

    def finished(item: Placed) -> None:
        if keep is not None:
            keep_stage(item, keep)
        if item.stage.is_measurement:
            write_results(ready)

    with one_writer(out / LOCK_FILE, str(out)):
        if weights is not None:
            require_kept_trainings(ready, weights)
        if keep is not None:
            for item in ready.stages:
                restore(item, keep)
                keep_stage(item, keep)
        try:
            run_stages(ready.stages, execute, report, finished)
        except Stopped as stop:
            stop.kept = f"complete stages are kept in {out}; the same command continues"
            raise
        record = write_results(ready)
    if as_json:
        say_document(record)
    else:
        say(f"wrote {out / PAGE_FILE}")


def weights_of(config: PaperConfig, document: Document, folder: Path | None) -> Path | None:
    """Return the folder of the metrics' weights: the option's, the configuration's, or the
    variable's.
    """
    if folder is None and config.metric_weights is not None:
        folder = document.folder_of(("metric_weights",)) / config.metric_weights
    return weights_folder(folder)


def execute(words: Sequence[str]) -> None:
    """Run a command of simrun in this process; what it prints goes to standard error.

    Args:
        words: The command after ``simrun``, its verb first.

    Raises:
        InfrastructureError: It ended with another code than 0.
        SimrunError: The command's own error.
    """
    verb, *arguments = words
    command = load_verb(verb)
    with redirect_stdout(sys.stderr):
        try:
            with command.make_context(verb, arguments) as context:
                command.invoke(context)
        except typer.Exit as leaving:
            if leaving.exit_code:
                raise InfrastructureError(
                    f"simrun {' '.join(words)}: it ended with code {leaving.exit_code}",
                    "Its message stands above; the same command continues.",
                ) from leaving


def plan_lines(ready: Experiment, kept: Path | None = None) -> list[str]:
    """Return the plan in words: stages, then claims that are tested, then those left out.

    Args:
        ready: The experiment.
        kept: Folder of kept stages, which are marked.
    """
    lines = [f"stages of {ready.out}"]
    for item in ready.stages:
        stage = item.stage
        is_there = item.state != "done" and kept is not None and is_kept(item, kept)
        state = "kept" if is_there else item.state
        lines.append(f"  {state:5} {stage.name:28} {item.key}  {stage.budget}")
    tested = [claim for claim in ready.expectations if not claim.left_out]
    lines.append(f"claims that are tested: {len(tested)} of {len(ready.expectations)}")
    for expectation in tested:
        power = "unknown" if expectation.power is None else f"{100 * expectation.power:.0f} %"
        claim = expectation.claim
        lines.append(f"  {claim.number:3} power {power:>5}  {claim.text}")
    lines.append("claims that are left out")
    lines += [
        f"  {expectation.claim.number:3} {expectation.claim.text}: {expectation.left_out}"
        for expectation in ready.expectations
        if expectation.left_out
    ]
    return lines
