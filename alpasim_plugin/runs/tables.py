"""Make the tables of a run folder again from its rollouts, for a command that reads them."""

import os
import shlex
from collections.abc import Callable
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, real
from alpasim_plugin.core.files.places import temporary_folder
from alpasim_plugin.log.run_folder.check import inspect_files, inspect_run
from alpasim_plugin.log.run_folder.manifests import AGAIN, read_run_json
from alpasim_plugin.log.run_folder.reader import REMADE
from alpasim_plugin.log.run_folder.records import RunInfo
from alpasim_plugin.log.run_folder.schema import FILES, GATE_FILES, REPORTS, TABLES


def ensure_tables(root: Path, say: Callable[[str], None]) -> None:
    """Refuse a run folder with a file that is not the one that was written, and make tables that
    are missing or damaged again from the rollouts, for this process.

    Nothing is driven, and nothing is written into the run folder: it may be read-only. The tables
    lie in a temporary folder until the process ends (`reader.table_path`).

    Args:
        root: The run folder.
        say: Called with one line where tables are made again.

    Raises:
        InputError: A file is not the one that was written, or a table is missing or damaged, and so
            is a rollout.
    """
    REMADE.pop(real(root), None)
    info = read_run_json(root)
    run = inspect_run(root)
    damage = [*inspect_files(root), *run.damage]
    tables = [fault for fault in damage if not fault.cell and fault.file in TABLES]
    for fault in damage:
        is_made_again = fault in tables or fault.file in (FILES, *REPORTS, *GATE_FILES)
        if not is_made_again and os.path.exists(root / fault.path):
            raise InputError(f"{root}: {fault}", again(info))
    if not tables:
        return
    if run.damage or run.tables_only:
        raise InputError(f"{root}: {[*run.damage, *tables][0]}", again(info))
    if run.unfinished or not run.cells:
        done = f"{len(run.manifests)} of {len(run.cells)} rollouts are finished."
        raise InputError(f"{root}: {done}", again(info))
    from alpasim_plugin.runs.summary import write_summary  # a run that is whole loads no loop

    say(f"note: {root}: {tables[0]}; the tables are made from the rollouts")
    folder = temporary_folder("simrun-tables-")
    with parsing(root, AGAIN, "manifests from which no table can be made"):
        write_summary(root, info, run.manifests, Path(folder.name))
    REMADE[real(root)] = folder


def again(info: RunInfo) -> str:
    """Return the hint to give the command of a run again."""
    return f"Give its command again: {shlex.join(info.command)}"
