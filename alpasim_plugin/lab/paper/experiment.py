"""Run the comparison, or say what it would do: stages, power of the claims, tables, verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from alpasim_plugin.core.files import read_bytes
from alpasim_plugin.core.files.atomic import write_bytes, write_json, write_text
from alpasim_plugin.core.files.config import Document
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.lab.paper import tables
from alpasim_plugin.lab.paper.claims import Decided, Design, Expected, claims, decide, expected
from alpasim_plugin.lab.paper.comparison import (
    BUNDLE,
    DRIVE,
    RUN,
    Effort,
    comparison,
    drive_rows,
    quality_name,
    systems_of,
    train_name,
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
from alpasim_plugin.lab.paper.stages import Placed, place

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
                }
                for item in self.stages
            ],
            "claims": [item.as_dict() for item in self.expectations],
        }


def experiment(
    config: PaperConfig,
    document: Document,
    out: Path,
    weights: Path | None,
    effort: Effort,
    kept: Path | None = None,
) -> Experiment:
    """Return the experiment that a configuration describes; nothing is run.

    Args:
        config: The configuration.
        document: Its document, against whose file relative paths are resolved.
        out: Folder of everything that is written.
        weights: Folder of the metrics' weights.
        effort: How the commands are run.
        kept: Folder of trained systems, which are then not trained.

    Raises:
        InputError: The pilot is not there, or of another program; or a kept system is missing.
    """
    stages = place(comparison(config, weights, effort, kept), out)
    folder = document.folder_of(("pilot",))
    pilot = read_quality([folder / config.pilot.quality])
    drive_spreads: dict[str, float] = {}
    if config.pilot.drive is not None:
        drive_spreads = read_drive_spreads(folder / config.pilot.drive)
    scenes = sum(item.scenes for item in config.drive.scenes) if config.drive else 0
    rows = frozenset(drive_rows(config)) if config.drive else frozenset()
    design = Design(frozenset(config.labels), config.test.scenes, rows, scenes)
    expectations = tuple(
        expected(claim, design, pilot, drive_spreads, config.least_power)
        for claim in claims().claims
    )
    return Experiment(config, out, tuple(stages), expectations)


def write_results(ready: Experiment) -> JsonObject:
    """Write tables and verdicts from the records of complete stages, and return them.

    Writes ``paper.json``, ``paper.md`` and the figures.

    Raises:
        InputError: A record is missing or of another program.
    """
    config = ready.config
    folders = {item.stage.name: item.folder for item in ready.stages}
    quality = read_quality([folders[quality_name(label)] / QUALITY_FILE for label in config.labels])
    drive = ClosedLoop()
    if config.drive is not None:
        rows = drive_rows(config)
        drive = read_closed_loop(folders[DRIVE] / RUN / SUMMARY_FILE, rows)
    decided = [decide(item, quality, drive) for item in ready.expectations]
    cells = _cells(config, quality, drive)
    record = {
        **ready.plan(),
        "config": config.model_dump(),
        "source": printed().source,
        "tables": cells,
        "figures": write_figures(config.labels, quality, ready.out),
        "claims": [item.as_dict() for item in decided],
    }
    write_json(ready.out / RECORD_FILE, record)
    write_text(ready.out / PAGE_FILE, _page(ready, cells, decided))
    return record


def keep_weights(ready: Experiment, folder: Path) -> list[Path]:
    """Copy the bundle and the card of every trained system into a folder, and return the bundles.

    Raises:
        InputError: A system is not trained.
    """
    folders = {item.stage.name: item.folder for item in ready.stages}
    copies = []
    for system in systems_of(ready.config):
        trained = folders[train_name(system)] / BUNDLE
        copies.append(folder / f"{system}.safetensors")
        for source, target in (
            (trained, copies[-1]),
            (trained.with_suffix(".card.json"), folder / f"{system}.card.json"),
        ):
            write_bytes(target, read_bytes(source))
    return copies


def _cells(config: PaperConfig, quality: Quality, drive: ClosedLoop) -> JsonObject:
    printed_tables = printed().tables
    rows = [RAW, *config.systems]
    cells = {"cycle": tables.quality_table(printed_tables["cycle"], rows, quality)}
    if config.ablation:
        cells["ablation"] = tables.quality_table(
            printed_tables["ablation"], config.ablation, quality
        )
    if config.drive is not None:
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
