"""One writer at a time, by a lock file (`filelock`). The system releases the lock when its holder
ends, however it ends.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from alpasim_plugin.core.atomic import disk_error
from alpasim_plugin.core.errors import InfrastructureError


@dataclass(frozen=True)
class Held:
    """A lock that this process holds.

    Attributes:
        since_ns: When it was taken, by the clock of the file system; a left-over of an earlier
            holder is older.
    """

    path: Path
    since_ns: int


@contextmanager
def one_writer(
    path: Path,
    what: str,
    wait: bool = False,
    waiting: Callable[[str], None] = print,
    do_this: str | None = None,
) -> Iterator[Held]:
    """Hold a lock file during the block.

    Args:
        path: The lock file; its folder is made if it does not exist.
        what: What is written under the lock, for errors.
        wait: Wait until it is free; otherwise refuse.
        waiting: Called once with a line that says what is waited for.
        do_this: Advice where the folder cannot be written; None: one that follows from the cause.

    Raises:
        InfrastructureError: Another process holds it, or the folder cannot be written.
    """
    lock = FileLock(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if not wait:
                raise InfrastructureError(
                    f"{what}: another process is writing it",
                    "wait for it (--wait), or name another folder",
                ) from None
            waiting(f"waiting: another process writes {what}")
            lock.acquire()
        os.utime(path)
        held = Held(path, path.stat().st_mtime_ns)
    except OSError as error:
        lock.release()
        raise disk_error(path, error, do_this) from error
    try:
        yield held
    finally:
        lock.release()


def is_locked(path: Path) -> bool:
    """Tell whether a process holds a lock file; nothing is locked, and nothing is written."""
    if not path.exists() or not os.access(path, os.W_OK):
        return False
    try:
        with FileLock(path, timeout=0):
            return False
    except Timeout:
        return True
