"""Be the only writer of a run folder, and remove what killed writers left in it."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from alpasim_plugin.io.lock import one_writer
from alpasim_plugin.process.processes import is_running

LOCK = ".simrun.lock"
DOING = "writing a run folder"
_TEMPORARY = re.compile(r"\..+\.(\d+)\.[0-9a-f]{8}\.tmp")  # as `alpasim_plugin.io.atomic.temporary_path` makes them


@contextmanager
def writing(root: Path, wait: bool = False, waiting: Callable[[str], None] = print) -> Iterator[None]:
    """Be the only writer of a run folder during the block; left-overs of killed writers are removed first.

    Args:
        root: The run folder; made if it does not exist.
        wait: Wait for another writer; otherwise refuse.
        waiting: Called once with a line that says who is waited for.

    Raises:
        InfrastructureError: Another process writes the folder, or it is read-only.
    """
    with one_writer(root / LOCK, DOING, f"folder {root}", wait, waiting) as held:
        remove_left_overs(root, held.since_ns)
        yield


def remove_left_overs(root: Path, before_ns: int | None = None) -> list[Path]:
    """Remove temporary files and folders of processes that are gone; return them.

    Only names that simrun gives are touched, only those older than the lock, and only if no process of this machine has the number in the
    name. Run folders inside this one (forks) have writers of their own and are left alone.

    Args:
        root: A run folder whose lock is held, or a folder that only this machine's processes write.
        before_ns: When the lock was taken, by the clock of the file system; None: of any time.
    """
    removed = []
    for at, folders, files in os.walk(root):
        here = Path(at)
        if here != root and LOCK in files:
            folders.clear()
            continue
        for name in [*files, *folders]:
            matched = _TEMPORARY.fullmatch(name)
            if matched is None or is_running(int(matched[1])):
                continue
            path = here / name
            if before_ns is not None and path.lstat().st_mtime_ns >= before_ns:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
                folders.remove(name)
            else:
                path.unlink()
            removed.append(path)
    return removed
