"""What a process does at the moment, for whoever waits for it: a small file for each process."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.reading import read_json

WRITE_EVERY_S = 0.5
_here: list[tuple[Path, Stage]] = []  # the file of this process, and what it says; at most one


@dataclass
class Stage:
    """A part of some work.

    Attributes:
        began_s: When it began, in seconds of the monotonic clock, which processes of a machine share.
        done, total: How far it is; a total of 0 is unknown.
    """

    name: str
    began_s: float
    done: int = 0
    total: int = 0
    written_s: float = 0.0

    def text(self, now_s: float) -> str:
        """Say what is done, how far it is, and an estimate of what is left."""
        if not 0 < self.done <= self.total:
            return f"{self.name}, for {now_s - self.began_s:.0f} s"
        left_s = (now_s - self.began_s) * (self.total - self.done) / self.done
        return f"{self.name} {self.done}/{self.total}, about {left_s:.0f} s left"


@contextmanager
def shown_in(folder: Path) -> Iterator[None]:
    """Let `announce` write what this process does into a folder, until the end of the block."""
    path = folder / str(os.getpid())
    folder.mkdir(parents=True, exist_ok=True)
    _here[:] = [(path, Stage("", 0.0))]
    try:
        yield
    finally:
        _here.clear()
        path.unlink(missing_ok=True)


def announce(name: str, done: int = 0, total: int = 0) -> None:
    """Say what this process does now and how far it is; nothing where nobody asked for it."""
    if not _here:
        return
    path, last = _here[0]
    now_s = time.monotonic()
    if last.name == name and now_s - last.written_s < WRITE_EVERY_S:
        return
    began_s = last.began_s if last.name == name else now_s
    current = Stage(name, began_s, done, total, now_s)
    _here[0] = (path, current)
    with suppress(OSError):  # a disk that refuses ends the work elsewhere, with a reason
        path.write_text(json.dumps(asdict(current)), encoding="utf-8")


def stages_in(folder: Path) -> list[Stage]:
    """Return what the processes that write into a folder do, the longest first."""
    found = []
    for path in folder.glob("*"):
        with suppress(SimrunError, TypeError):  # it is written or removed just now
            found.append(Stage(**read_json(path)))
    return sorted(found, key=lambda one: one.began_s)
