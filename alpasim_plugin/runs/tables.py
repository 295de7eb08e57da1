"""Make the tables of a run folder again from its rollouts."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.log.run_folder.check import inspect_run
from alpasim_plugin.log.run_folder.manifests import AGAIN, read_run_json
from alpasim_plugin.log.run_folder.schema import REPORTS, TABLES
from alpasim_plugin.log.run_folder.writer import writing


def ensure_tables(root: Path, say: Callable[[str], None]) -> None:
    """Make the tables and reports of a run folder that lacks them from its rollouts.

    Nothing is driven. A rollout that is damaged is named; the tables are left as they are.

    Args:
        root: The run folder.
        say: Called with one line for each thing that is missing or damaged.

    Raises:
        InputError: Tables are missing and a rollout is missing or damaged.
        InfrastructureError: Another process writes the folder, or it is read-only.
    """
    lost = [name for name in TABLES if not (root / name).is_file()]
    if not lost:
        return
    from alpasim_plugin.runs.run import finish_run  # a run that is whole loads no loop

    info = read_run_json(root)
    with writing(root):
        found = inspect_run(root)
        if found.damage:
            raise InputError(f"{root}: {found.damage[0]}", again(info))
        if found.unfinished or not found.cells:
            raise InputError(
                f"{root}: {len(found.manifests)} of {len(found.cells)} rollouts are finished.",
                again(info),
            )
        say(f"note: {root}: {lost[0]} is missing and is made again from the rollouts")
        with parsing(root, AGAIN, "manifests from which no table can be made"):
            finish_run(root, found.manifests, {}, (root / REPORTS[0]).exists())


def again(info: Mapping[str, Any]) -> str:
    """Return the hint to give the command of a run again."""
    return f"Give its command again: {shlex.join(info['command'])}"
