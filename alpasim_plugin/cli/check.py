"""``simrun check``: compare a run folder with what it says of itself, and make it whole."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from alpasim_plugin.cli.options import Json, Run
from alpasim_plugin.cli.progress import make_progress
from alpasim_plugin.core.escape import terminal
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.log.run_folder.check import Inspection, inspect_run
from alpasim_plugin.log.run_folder.schema import DERIVED, MANIFEST, RUN_INFO
from alpasim_plugin.runs.repair import repair_run

DAMAGED, NOT_REPAIRED = 1, 4

EPILOG = """
Examples:

- `simrun check runs/nightly`

- `simrun check runs/nightly --repair --json`

Exit codes: 0 whole, or made whole; 1 damaged or unfinished; 2 not a run folder, or it cannot be repaired; 4 repaired in part, or another
process writes it.
"""


def check(
    run: Run,
    repair: Annotated[
        bool, Flag("Run or score damaged rollouts again, and make the tables again.")
    ] = False,
    workers: Annotated[
        int | None, Flag("Repair: worker processes; by default one per core.", min=1)
    ] = None,
    wait: Annotated[bool, Flag("Repair: wait for a process that writes the folder.")] = False,
    as_json: Json = False,
) -> None:
    """Read every file of a run folder, compare it with its digest, and say what is damaged.

    Nothing is written without `--repair`, so a read-only folder can be checked. With it, damaged
    rollouts alone are run or scored again.
    """
    before = inspect_run(run, full=True)
    after = before
    if repair and not before.whole:
        repair_run(before, workers, make_progress(as_json), wait)
        after = inspect_run(run)
    rows = rows_of(before, after, repair)
    code = 0 if after.whole else NOT_REPAIRED if repair else DAMAGED
    if as_json:
        counts = {
            "rollouts": len(before.cells),
            "unfinished": len(before.unfinished),
            "tables_only": before.tables_only,
        }
        print(
            json.dumps(
                {"run": str(run), "whole": after.whole, "exit_code": code, **counts, "damage": rows}
            )
        )
    else:
        _print(before, rows, repair, after.whole)
    raise typer.Exit(code)


def rows_of(before: Inspection, after: Inspection, repaired: bool) -> list[dict[str, Any]]:
    """Return one row for each damaged file and unfinished rollout: ``cell``, ``file``, ``wrong``,
    ``done`` (None without a repair).
    """
    wrong = [(one.cell, one.file, one.problem) for one in before.damage]
    wrong += [(cell, MANIFEST, "never finished") for cell in before.unfinished]
    still = {(one.cell, one.file) for one in after.damage} | {
        (cell, MANIFEST) for cell in after.unfinished
    }
    driven = {cell for cell, file, _ in wrong if cell and file not in DERIVED}

    def done(cell: str, file: str) -> str | None:
        if not repaired:
            return None
        if (cell, file) in still:
            return "not repaired"
        if not cell:
            return "written again" if file != RUN_INFO else "restored"
        return "run again" if cell in driven else "scored again"

    return [
        {"cell": cell, "file": file, "wrong": text, "done": done(cell, file)}
        for cell, file, text in wrong
    ]


def _print(found: Inspection, rows: list[dict[str, Any]], repaired: bool, whole: bool) -> None:
    if rows:
        lines = [("cell", "file", "what is wrong", "what was done")]
        lines += [
            (row["cell"] or "(the run)", row["file"], row["wrong"], row["done"] or "-")
            for row in rows
        ]
        cells = [[terminal(text) for text in line] for line in lines]
        widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
        for line in cells:
            print(
                "  ".join(
                    text.ljust(width) for text, width in zip(line, widths, strict=True)
                ).rstrip()
            )
    if found.tables_only:
        print("the folder has no rollouts, only tables; those were read")
    state = (
        "whole"
        if not rows
        else "made whole"
        if whole
        else "repaired in part"
        if repaired
        else "damaged"
    )
    print(f"{len(found.cells)} rollouts, {len(rows)} findings: {state}")
    if rows and not repaired:
        print(f"repair with  simrun check {found.root} --repair")
