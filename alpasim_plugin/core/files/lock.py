"""One writer at a time, by a lock file (`filelock`). The system releases the lock when its holder
ends, however it ends.
"""

import fcntl
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.files.atomic import disk_error
from alpasim_plugin.core.printing import warn


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
    target: str,
    wait: bool = False,
    waiting: Callable[[str], None] = warn,
    do_this: str | None = None,
) -> Iterator[Held]:
    """Hold a lock file during the block.

    Args:
        path: The lock file; its folder is made if it does not exist.
        target: What is written under the lock, for errors.
        wait: Wait until it is free; otherwise refuse.
        waiting: Called once with a line that says what is waited for.
        do_this: Advice where the folder cannot be written; None: one that follows from the cause.

    Raises:
        InfrastructureError: Another process holds it, or the folder cannot be written.
        InputError: Something else lies at the path than a lock file.
    """
    if os.path.exists(path.parent) and not os.path.isdir(path.parent):
        raise InputError(f"{path.parent}: a file, not a folder", "Name a folder.")
    lock = FileLock(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(path) and not _is_own_file(path):
            raise InputError(
                f"{path}: no lock file, but a link, a folder, a device, or a file with other names",
                "remove it",
            )
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if not wait:
                raise InfrastructureError(
                    f"{target}: another process is writing it",
                    "wait until it ends, or name another folder",
                ) from None
            waiting(f"waiting: another process writes {target}")
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
    """Tell whether a process holds a lock file; nothing is written, and what is no lock file is held
    by nobody.
    """
    try:
        if not _is_own_file(path):
            return False
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _is_own_file(path: Path) -> bool:
    """Tell whether a path is a regular file with one name: to open another file for writing would
    empty it.
    """
    state = path.lstat()
    return stat.S_ISREG(state.st_mode) and state.st_nlink == 1
