"""``simrun check``: compare a run folder with the digests in its manifests."""

from __future__ import annotations

import json

import typer

from alpasim_plugin.cli.options import Json, Run
from alpasim_plugin.core.escape import terminal
from alpasim_plugin.log.run_folder.check import inspect_run
from alpasim_plugin.log.run_folder.manifests import Damage, read_run_json
from alpasim_plugin.log.run_folder.schema import MANIFEST
from alpasim_plugin.runs.tables import again

DAMAGED = 1

EPILOG = """
Examples:

- `simrun check runs/nightly`

- `simrun check runs/nightly --json`

Exit codes: 0 whole; 1 damaged or unfinished; 2 not a run folder.
"""


def check(run: Run, as_json: Json = False) -> None:
    """Read every file of every rollout, compare it with its digest, and say what is damaged.

    Nothing is written. The command of the run drives damaged and unfinished rollouts again.
    """
    found = inspect_run(run, full=True)
    problems = [*found.damage]
    problems += [Damage(cell, MANIFEST, "the rollout is unfinished") for cell in found.unfinished]
    if as_json:
        facts = {
            "run": str(run),
            "whole": found.whole,
            "exit_code": 0 if found.whole else DAMAGED,
            "rollouts": len(found.cells),
            "unfinished": len(found.unfinished),
            "tables_only": found.tables_only,
            "damage": [vars(problem) for problem in problems],
        }
        print(json.dumps(facts))
    else:
        for problem in problems:
            print(terminal(str(problem)))
        if found.tables_only:
            print("the folder has no rollouts, only tables")
        state = "whole" if found.whole else "damaged or unfinished"
        print(f"{len(found.cells)} rollouts, {len(problems)} problems: {state}")
        if problems:
            print(terminal(again(read_run_json(run))))
    raise typer.Exit(0 if found.whole else DAMAGED)
