"""Find the run folders below a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.run_folder.schema import CONTENTS, LOCK, RUN_INFO
from evaluators.runs.entry import DOING, RunEntry, read_entry

MARKS = frozenset((RUN_INFO, CONTENTS, LOCK))  # the first file of a run folder is its lock
SKIPPED = frozenset(("node_modules", "__pycache__", "site-packages"))


def find_runs(roots: Sequence[Path], with_summary: bool = False) -> list[RunEntry]:
    """Describe every run folder below some folders, or those folders themselves, the newest first.

    A folder that a killed run left behind is one too. Nothing is searched inside a run folder, so forks inside a run are part of it.

    Args:
        roots: Folders; one that is reached twice is listed once.
        with_summary: As for `read_entry`.

    Raises:
        InputError: A root is not a folder.
    """
    found: dict[tuple[int, int], Path] = {}
    for root in roots:
        if not root.is_dir():
            what = "a file" if root.exists() else "no such folder"
            raise InputError(DOING, str(root), what, "name the folder that holds the run folders; simrun run writes them below runs/")
        for folder in _run_folders(root, set()):
            state = folder.stat()
            found.setdefault((state.st_dev, state.st_ino), folder)
    return sorted((read_entry(folder, with_summary) for folder in found.values()), key=_newest_first)


def _run_folders(folder: Path, seen: set[tuple[int, int]]) -> Iterator[Path]:
    """Yield the run folders below a folder, in the order of names; links are followed, circles are not."""
    state = folder.stat()
    if (state.st_dev, state.st_ino) in seen:
        return
    seen.add((state.st_dev, state.st_ino))
    try:
        with os.scandir(folder) as scanned:
            entries = sorted(scanned, key=lambda entry: entry.name)
    except PermissionError:
        yield folder  # it may be one: listed as what cannot be read
        return
    if any(entry.name in MARKS for entry in entries):
        yield folder
        return
    for entry in entries:
        if not entry.name.startswith(".") and entry.name not in SKIPPED and entry.is_dir():
            yield from _run_folders(Path(entry.path), seen)


def _newest_first(entry: RunEntry) -> tuple[float, str]:
    """Sort by start; a folder that does not say when it was begun comes last."""
    began = entry.started_at
    return (-began.timestamp() if began is not None else float("inf"), str(entry.folder))
