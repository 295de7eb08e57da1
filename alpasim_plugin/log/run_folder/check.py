"""Compare a run folder with what it says of itself, and make its tables again where only they are
damaged; nothing is driven here.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading.files import as_shape
from alpasim_plugin.log.run_folder.manifests import (
    AGAIN,
    Contents,
    Damage,
    damaged_files,
    inspect_rollout,
    read_contents,
    read_manifest,
    read_run_json,
    write_run_json,
)
from alpasim_plugin.log.run_folder.schema import (
    CONTENTS,
    MANIFEST,
    ROLLOUTS_FOLDER,
    RUN_INFO,
    TABLES,
    rollout_folder,
)
from alpasim_plugin.log.run_folder.writer import writing

NOT_FINISHED = "missing: the run is not finished, or an older version wrote it"
NEWER = "newer than the tables"
REMADE = (*TABLES, CONTENTS, RUN_INFO)  # can be made again from the manifests


@dataclass(frozen=True)
class Inspection:
    """What was found in a run folder.

    Attributes:
        root: The folder.
        info: ``run.json``, or its copy in ``contents.json`` where it is damaged.
        contents: None where they are missing or damaged.
        cells: Folders of all rollouts of the run, in the order of the tables.
        damage: Damaged or missing files, those of the run itself first.
        unfinished: Folders of rollouts that were never finished.
        tables_only: The folder was copied without its rollouts.
    """

    root: Path
    info: Mapping[str, Any]
    contents: Contents | None
    cells: tuple[str, ...]
    damage: tuple[Damage, ...]
    unfinished: tuple[str, ...]
    tables_only: bool = False

    @property
    def whole(self) -> bool:
        """Tell whether the run is finished and nothing is damaged."""
        return not self.damage and not self.unfinished

    @property
    def of_run(self) -> list[Damage]:
        """List what is damaged outside the rollouts, or no longer fits them."""
        return [one for one in self.damage if not one.cell or one.problem == NEWER]

    @property
    def of_rollouts(self) -> list[Damage]:
        """List what is damaged in the rollouts."""
        return [one for one in self.damage if one.cell and one.problem != NEWER]

    @property
    def is_remakable(self) -> bool:
        """Tell whether everything that is damaged can be made again from the rollouts'
        manifests.
        """
        of_rollouts = self.of_rollouts or self.unfinished or self.tables_only
        return (
            bool(self.cells)
            and not of_rollouts
            and all(one.file in REMADE or one.cell for one in self.of_run)
        )


def inspect_run(
    root: Path, full: bool = False, on_cell: Callable[[int, int], None] | None = None
) -> Inspection:
    """Compare a run folder with its manifests and its contents.

    Args:
        root: The run folder.
        full: Read every file, whatever its size and time.
        on_cell: Called with the number of rollouts that were compared, and of all.

    Raises:
        InputError: The folder holds no run, or nothing is left that says what it should hold.
    """
    if not (root / RUN_INFO).exists() and not (root / CONTENTS).exists():
        raise InputError(
            f"{root / RUN_INFO}: no such file",
            "give a folder written by simrun run or simrun score",
        )
    info, contents, damage = _descriptions(root)
    if contents is not None:
        damage += damaged_files(root, contents, full)
    cells = tuple(contents.rollouts) if contents else planned_cells(info)
    if contents is not None and cells and not (root / ROLLOUTS_FOLDER).exists():
        return Inspection(root, info, contents, cells, tuple(damage), (), tables_only=True)
    unfinished = []
    for done, cell in enumerate(cells, 1):
        state = inspect_rollout(root, cell, full, known=contents is not None)
        damage += state.damage
        if state.manifest is None and not state.damage:
            unfinished.append(cell)
        elif (
            contents is not None
            and state.manifest is not None
            and state.checksum != contents.rollouts[cell]
        ):
            damage.append(Damage(cell, MANIFEST, NEWER))
        if on_cell is not None:
            on_cell(done, len(cells))
    return Inspection(root, info, contents, cells, tuple(damage), tuple(unfinished))


def _descriptions(root: Path) -> tuple[Mapping[str, Any], Contents | None, list[Damage]]:
    """Read the two files that describe a run; each can stand in for the other."""
    damage, errors = [], []
    info: Mapping[str, Any] | None = None
    contents: Contents | None = None
    try:
        info = read_run_json(root)
    except InputError as error:
        errors.append(error)
        damage.append(Damage("", RUN_INFO, error.message))
    try:
        contents = read_contents(root)
    except InputError as error:
        errors.append(error)
        damage.append(
            Damage("", CONTENTS, error.message if (root / CONTENTS).exists() else NOT_FINISHED)
        )
    if info is None and contents is None:
        raise InputError(
            f"{root}: {RUN_INFO}: {errors[0].message}; {CONTENTS}: {errors[1].message}",
            f"{AGAIN} (with --out {root})",
        )
    return info or (contents.run if contents else {}), contents, damage


def planned_cells(info: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the folders of the rollouts that ``run.json`` plans, in the order of the tables; of
    scored logs it names none.
    """
    if info.get("kind") == "score":
        return ()
    axes: Sequence[Sequence[Any]] = (
        list(info["scenes"]),
        info["renderers"],
        info["policies"],
        info["seeds"],
    )
    return tuple(
        rollout_folder(renderer, policy, scene, seed).as_posix()
        for scene, renderer, policy, seed in product(*axes)
    )


KEPT = (
    "pool",
    "determinism",
    "exit_code",
    "alpasim",
)  # members of run.json that the rollouts do not tell
SHOWN = 5


def prepare_reading(
    root: Path, say: Callable[[str], None], remake: Callable[[Inspection], None]
) -> None:
    """Check a run folder before its tables are read.

    Tables that are missing or damaged are made again if every rollout is whole. Damaged rollouts
    are named; nothing is driven.

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
            say(
                f"warning: damaged: {root}/{one}; the tables are whole; simrun check {shlex.quote(str(root))} --repair"
            )
        if len(found.of_rollouts) > SHOWN:
            say(
                f"warning: {len(found.of_rollouts) - SHOWN} more damaged files: simrun check {shlex.quote(str(root))}"
            )
        return
    if not os.access(root, os.W_OK):
        raise InputError(
            f"{root}: {found.of_run[0]}, and the folder is read-only",
            "copy the folder to where it can be written, and repair the copy: simrun check COPY --repair",
        )
    with writing(root):  # whoever writes it now is named here
        found = inspect_run(root)
        if found.of_run:
            _check_remakable(found)
            for one in found.of_run:
                say(f"warning: damaged: {root}/{one}; made again from the rollouts")
            remake(found)


def _check_remakable(found: Inspection) -> None:
    if found.unfinished:
        raise InputError(
            f"{found.root}: the run is not finished: {len(found.cells) - len(found.unfinished)} of {len(found.cells)} rollouts are finished",
            f"give its command again: {command_of(found)}",
        )
    if not found.is_remakable:
        problem = [
            *found.of_rollouts,
            *(one for one in found.of_run if one.file not in REMADE),
            *found.of_run,
        ][0]
        raise InputError(
            f"{found.root}: {problem}",
            f"simrun check {shlex.quote(str(found.root))} --repair",
        )


def restore_run(found: Inspection) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Write ``run.json`` again if it is damaged; return the manifests, and what they do not tell of
    the run.

    Raises:
        InputError: A manifest is damaged.
    """
    if any(one.file == RUN_INFO for one in found.damage):
        write_run_json(found.root, found.info)
    manifests = [read_manifest(found.root / cell)[0] for cell in found.cells]
    config = as_shape(
        dict[str, Any],
        found.info["config"],
        f"{found.root / RUN_INFO}, config",
        "make the run again",
    )
    lost = {
        "pool": {
            "workers": config.get("workers"),
            "threads_per_worker": config.get("threads_per_worker"),
            "wall_s": None,
            "frames": sum(int(m.get("frames") or 0) for m in manifests),
            "frames_per_s_total": None,
        },
        "determinism": {
            "status": "skipped",
            "reason": "the run was stopped before it repeated a rollout",
        },
    }
    return manifests, lost | {key: found.info[key] for key in KEPT if key in found.info}


def command_of(found: Inspection) -> str:
    """Return the command that made a run, to be typed."""
    return shlex.join(found.info["command"])
