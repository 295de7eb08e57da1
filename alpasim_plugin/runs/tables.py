"""Make the tables of a run folder again from its rollouts, for a command that reads them."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import parsing, read_json_as, real
from alpasim_plugin.log.run_folder.check import inspect_run
from alpasim_plugin.log.run_folder.manifests import AGAIN, read_run_json
from alpasim_plugin.log.run_folder.reader import REMADE
from alpasim_plugin.log.run_folder.schema import (
    ROLLOUTS,
    ROLLOUTS_TABLE,
    STEPS,
    STEPS_TABLE,
    SUMMARY,
)
from alpasim_plugin.log.run_folder.shapes import Summary


def ensure_tables(root: Path, say: Callable[[str], None]) -> None:
    """Make tables that are missing or damaged again from the rollouts, for this process.

    Nothing is driven, and nothing is written into the run folder: it may be read-only. The tables
    lie in a temporary folder until the process ends (`reader.table_path`).

    Args:
        root: The run folder.
        say: Called with one line where tables are made again.

    Raises:
        InputError: A table is missing or damaged, and so is a rollout.
    """
    REMADE.pop(real(root), None)
    try:
        read_json_as(Summary, root / SUMMARY)
        ROLLOUTS_TABLE.check(root / ROLLOUTS)
        STEPS_TABLE.check(root / STEPS)
        return
    except InputError as error:
        problem = error.message
    info = read_run_json(root)
    run = inspect_run(root)
    if run.tables_only:
        return  # whoever reads the damaged table says so
    if run.damage:
        raise InputError(f"{root}: {run.damage[0]}", again(info))
    if run.unfinished or not run.cells:
        done = f"{len(run.manifests)} of {len(run.cells)} rollouts are finished."
        raise InputError(f"{root}: {done}", again(info))
    from alpasim_plugin.runs.run import summary_of_run  # a run that is whole loads no loop

    say(f"note: {problem}; the tables are made from the rollouts")
    folder = TemporaryDirectory(prefix="simrun-tables-")
    with parsing(root, AGAIN, "manifests from which no table can be made"):
        summary_of_run(root, info, run.manifests, Path(folder.name))
    REMADE[real(root)] = folder


def again(info: Mapping[str, Any]) -> str:
    """Return the hint to give the command of a run again."""
    return f"Give its command again: {shlex.join(info['command'])}"
