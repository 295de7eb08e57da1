"""What a process does at the moment, for whoever waits for it: a small file for each process."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.files import read_text

_files: list[Path] = []  # of this process; at most one


@contextmanager
def shown_in(folder: Path) -> Iterator[None]:
    """Let `announce` write what this process does into a folder, until the end of the block."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / str(os.getpid())
    _files[:] = [path]
    try:
        yield
    finally:
        _files.clear()
        path.unlink(missing_ok=True)


def announce(text: str) -> None:
    """Say what this process does now; nothing where nobody asked for it."""
    for path in _files:
        with suppress(OSError):  # a disk that refuses ends the work elsewhere, with a reason
            path.write_text(text, encoding="utf-8")


def stages_in(folder: Path) -> list[str]:
    """Return what the processes that write into a folder do."""
    stages = []
    for path in sorted(folder.glob("*")):
        with suppress(SimrunError):  # its process has ended just now
            stages.append(read_text(path))
    return stages
