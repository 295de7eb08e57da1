"""What a reader does with a damaged run folder: its tables are made again from the manifests if those are whole; nothing is driven here."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.reading.files import as_shape
from alpasim_plugin.run_folder.check import REMADE, Inspection, inspect_run
from alpasim_plugin.run_folder.manifests import read_manifest, write_run_json
from alpasim_plugin.run_folder.schema import DOING, RUN_INFO
from alpasim_plugin.run_folder.writer import writing

KEPT = ("pool", "determinism", "exit_code", "alpasim")  # members of run.json that the rollouts do not tell
SHOWN = 5


def prepare_reading(root: Path, say: Callable[[str], None], remake: Callable[[Inspection], None]) -> None:
    """Check a run folder before its tables are read.

    Tables that are missing or damaged are made again if every rollout is whole. Damaged rollouts are named; nothing is driven.

    Args:
        root: The run folder.
        say: Called with one line for each thing that is damaged.
        remake: Makes the tables again, under the lock of the folder.

    Raises:
        InputError: The tables cannot be trusted and cannot be made again from what is there.
        InfrastructureError: Another process is writing the folder.
    """
    found = inspect_run(root)
    if found.tables_only:
        say(f"note: {root} has no rollouts, only tables")
    if not found.of_run:
        for one in found.of_rollouts[:SHOWN]:
            say(f"warning: damaged: {root}/{one}; the tables are whole; simrun check {shlex.quote(str(root))} --repair")
        if len(found.of_rollouts) > SHOWN:
            say(f"warning: {len(found.of_rollouts) - SHOWN} more damaged files: simrun check {shlex.quote(str(root))}")
        return
    if not os.access(root, os.W_OK):
        do_this = "copy the folder to where it can be written, and repair the copy: simrun check COPY --repair"
        raise InputError(DOING, str(root), f"{found.of_run[0]}, and the folder is read-only", do_this)
    with writing(root):  # whoever writes it now is named here
        found = inspect_run(root)
        if found.of_run:
            _check_remakable(found)
            for one in found.of_run:
                say(f"warning: damaged: {root}/{one}; made again from the rollouts")
            remake(found)


def _check_remakable(found: Inspection) -> None:
    if found.unfinished:
        there = f"{len(found.cells) - len(found.unfinished)} of {len(found.cells)} rollouts are finished"
        raise InputError(DOING, str(found.root), f"the run is not finished: {there}", f"give its command again: {command_of(found)}")
    if not found.is_remakable:
        problem = [*found.of_rollouts, *(one for one in found.of_run if one.file not in REMADE), *found.of_run][0]
        raise InputError(DOING, str(found.root), str(problem), f"simrun check {shlex.quote(str(found.root))} --repair")


def restore_run(found: Inspection) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Write ``run.json`` again if it is damaged; return the manifests, and what they do not tell of the run.

    Raises:
        InputError: A manifest is damaged.
    """
    if any(one.file == RUN_INFO for one in found.damage):
        write_run_json(found.root, found.info)
    manifests = [read_manifest(found.root / cell)[0] for cell in found.cells]
    config = as_shape(dict[str, Any], found.info["config"], f"{found.root / RUN_INFO}, config", DOING, "make the run again")
    lost = {
        "pool": {
            "workers": config.get("workers"),
            "threads_per_worker": config.get("threads_per_worker"),
            "wall_s": None,
            "frames": sum(int(m.get("frames") or 0) for m in manifests),
            "frames_per_s_total": None,
        },
        "determinism": {"status": "skipped", "reason": "the run was stopped before it repeated a rollout"},
    }
    return manifests, lost | {key: found.info[key] for key in KEPT if key in found.info}


def command_of(found: Inspection) -> str:
    """Return the command that made a run, to be typed."""
    return shlex.join(found.info["command"])
