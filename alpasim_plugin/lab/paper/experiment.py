"""Run the comparison, or say what it would do: stages, power of the claims, tables, verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_json, write_text
from alpasim_plugin.core.files.config import Document
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.lab.paper import tables
from alpasim_plugin.lab.paper.claims import Decided, Design, Expected, claims, decide, expected
from alpasim_plugin.lab.paper.comparison import (
    DRIVE,
    RUN,
    TIMES,
    Effort,
    comparison,
    drive_rows,
    quality_name,
)
from alpasim_plugin.lab.paper.config import RAW, PaperConfig
from alpasim_plugin.lab.paper.figures import write_figures
from alpasim_plugin.lab.paper.printed import printed
from alpasim_plugin.lab.paper.records import (
    QUALITY_FILE,
    SUMMARY_FILE,
    ClosedLoop,
    Quality,
    read_closed_loop,
    read_drive_spreads,
    read_quality,
)
from alpasim_plugin.lab.paper.stages import Placed, needed, place, restore, why_not_restored

RECORD_FILE = "paper.json"
PAGE_FILE = "paper.md"


@dataclass(frozen=True)
class Experiment:
    """A comparison with its stages and what can be expected of the claims.

    Attributes:
        config: What is compared.
        out: Folder of everything that is written.
        stages: In order.
        expectations: Of every claim.
    """

    config: PaperConfig
    out: Path
    stages: tuple[Placed, ...]
    expectations: tuple[Expected, ...]

    def plan(self) -> JsonObject:
        """Return the plan for JSON: stages with state and budget, power of every claim."""
        return {
            "out": str(self.out),
            "stages": [
                {
                    "name": item.stage.name,
                    "key": item.key,
                    "state": item.state,
                    "budget": item.stage.budget,
                    "command": ["simrun", *item.words],
                    "program": item.record["program"] if item.state == "done" else None,
                }
                for item in self.stages
            ],
            "claims": [item.as_dict() for item in self.expectations],
        }


def experiment(
    config: PaperConfig, document: Document, out: Path, weights: Path | None, effort: Effort
) -> Experiment:
    """Return the experiment that a configuration describes; nothing is run.

    Args:
        config: The configuration.
        document: Its document, against whose file relative paths are resolved.
        out: Folder of everything that is written.
        weights: Folder of the metrics' weights.
        effort: How the commands are run.

    Raises:
        InputError: The pilot is not there, or of another program.
    """
    folder = document.folder_of(("pilot",))
    pilot = read_quality([folder / config.pilot.quality])
    drive_spreads: dict[str, float] = {}
    if config.pilot.drive is not None:
        drive_spreads = read_drive_spreads(folder / config.pilot.drive)
    design = design_of(config)
    expectations = tuple(
        expected(claim, design, pilot, drive_spreads, config.least_power)
        for claim in claims().claims
    )
    stages = comparison(config, weights, effort, out, rows_by_claims(expectations))
    return Experiment(config, out, tuple(place(stages, out)), expectations)


def design_of(config: PaperConfig) -> Design:
    """Return what a configuration measures."""
    return Design(
        frozenset(config.labels),
        config.test.scenes,
        frozenset(drive_rows(config)) if config.drive else frozenset(),
        sum(item.scenes for item in config.drive.scenes) if config.drive else 0,
        min(config.times.scenes, config.test.scenes) if config.times else 0,
    )


def rows_by_claims(expectations: Sequence[Expected]) -> list[str]:
    """Return the rows of the claims that are tested, those of claims about few rows first: what is
    decided early needs few trainings.
    """
    tested = [item.claim for item in expectations if not item.left_out and not item.claim.drive]
    by_size = sorted(tested, key=lambda claim: len(claim.rows))
    return list(dict.fromkeys(row for claim in by_size for row in claim.rows))


def write_results(ready: Experiment) -> JsonObject:
    """Write tables and verdicts from the records of complete stages, and return them.

    Writes ``paper.json``, ``paper.md`` and the figures. Rows without a record are left out of the
    tables, and claims about them have no verdict yet.

    Raises:
        InputError: A record is of another program.
    """
    config = ready.config
    done = {item.stage.name: item.folder for item in ready.stages if item.state == "done"}
    rows = [row for row in config.labels if quality_name(row) in done]
    quality = read_quality([done[quality_name(row)] / QUALITY_FILE for row in rows])
    times = read_quality([done[TIMES] / QUALITY_FILE]) if TIMES in done else None
    quality = quality.with_times_of(times)
    drive = ClosedLoop()
    if DRIVE in done:
        drive = read_closed_loop(done[DRIVE] / RUN / SUMMARY_FILE, drive_rows(config))
    decided = [
        decide(_measured(item, quality, drive), quality, drive) for item in ready.expectations
    ]
    cells = _cells(config, quality, drive)
    record = {
        **ready.plan(),
        "config": config.model_dump(),
        "source": printed().source,
        "tables": cells,
        "figures": write_figures(rows, quality, ready.out),
        "claims": [item.as_dict() for item in decided],
    }
    write_json(ready.out / RECORD_FILE, record)
    write_text(ready.out / PAGE_FILE, _page(ready, cells, decided))
    return record


def _measured(expectation: Expected, quality: Quality, drive: ClosedLoop) -> Expected:
    """Return what is expected of a claim, left out where a row is not measured yet."""
    measured = drive.means if expectation.claim.drive else quality.by_scene
    absent = [row for row in expectation.claim.rows if row not in measured]
    if expectation.left_out or not absent:
        return expectation
    return replace(expectation, left_out=f"not measured yet: {', '.join(absent)}")


def require_kept_trainings(ready: Experiment, kept: Path) -> None:
    """Take the trained systems of a kept folder in place of training them.

    Raises:
        InputError: It lacks a system, or has one of another budget.
    """
    for item in ready.stages:
        if item.stage.is_training:
            restore(item, kept)
    open_trainings = [
        item for item in needed(ready.stages) if item.stage.is_training and item.state != "done"
    ]
    if open_trainings:
        # The last one: those before it may be needed only to train it
        raise InputError(
            f"--weights {kept}: {why_not_restored(open_trainings[-1], kept)}",
            "Name a folder that --keep has filled with the same configuration.",
        )


def _cells(config: PaperConfig, quality: Quality, drive: ClosedLoop) -> JsonObject:
    printed_tables = printed().tables
    rows = [RAW, *config.systems]
    measured = [row for row in rows if row in quality.by_scene]
    cells = {"cycle": tables.quality_table(printed_tables["cycle"], measured, quality)}
    ablation = [row for row in config.ablation if row in quality.by_scene]
    if ablation:
        cells["ablation"] = tables.quality_table(printed_tables["ablation"], ablation, quality)
    if drive.means:
        cells["closed-loop"] = tables.drive_table(
            printed_tables["closed-loop"], drive_rows(config), drive
        )
    return cells


def _page(ready: Experiment, cells: JsonObject, decided: Sequence[Decided]) -> str:
    parts = []
    for name, values in cells.items():
        table = printed().tables[name]
        note = f"{tables.DRIVE_NOTE}\n\n" if name == "closed-loop" else ""
        parts.append(f"## {table.title}\n\n{note}{tables.markdown_table(table, values)}")
    commands = [" ".join(["simrun", *item.words]) for item in ready.stages]
    return tables.document(parts, decided, commands)
