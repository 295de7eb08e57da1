"""One writer at a time: a lock file that says who holds it and that a killed process does not keep.

The system releases the lock (``flock``) when its holder ends, however it ends; the text in the file
is for the message. Where the file system has no such locks, the text itself is the lock, and its
holder is asked for: number, start and machine tell whether it still runs.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from alpasim_plugin.core.atomic import disk_error, temporary_path
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.processes import ProcessName, this_process

NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
POLL_S = 0.1


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
        waiting: Called once with a line that says who is waited for.
        do_this: Advice where the folder cannot be written; None: one that follows from the cause.

    Raises:
        InfrastructureError: Another process holds it, or the folder cannot be written.
    """
    announced = False
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            taken, owner = _take(path)
        except OSError as error:
            raise disk_error(path, error, do_this) from error
        if taken is not None:
            break
        if not wait:
            named = _named(path)
            raise _in_use(named if named.exists() else path, what, owner)
        if not announced:
            waiting(f"waiting: {owner or 'another process'} writes {what}")
            announced = True
        time.sleep(POLL_S)
    try:
        os.utime(path)
        yield Held(path, path.stat().st_mtime_ns)
    finally:
        taken()


def holder_of(path: Path) -> ProcessName | None:
    """Return the process that holds a lock file, or None; nothing is locked, and a holder that is
    gone holds nothing.

    Where only another machine could tell whether the process still runs, it is taken to.
    """
    for one in (path, _named(path)):
        try:
            owner = _owner(one.read_bytes())
        except OSError:
            continue
        if owner is not None and owner.life != "gone":
            return owner
    return None


def _in_use(path: Path, what: str, owner: ProcessName | None) -> InfrastructureError:
    if owner is None:
        return InfrastructureError(
            f"{what}: another process is writing it",
            "wait for it (--wait), or name another folder",
        )
    if owner.life == "elsewhere":
        do_this = f"wait for it (--wait); if nothing runs there any more, remove {path}"
    else:
        do_this = f"wait for it (--wait), stop it (kill {owner.pid}), or name another folder"
    return InfrastructureError(f"{what}: {owner} is writing it", do_this)


Release = Callable[[], None]


def _take(path: Path) -> tuple[Release | None, ProcessName | None]:
    """Try once; return how to release the lock, or None and who holds it."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = _owner(_text(handle))
        os.close(handle)
        return None, owner
    except OSError as error:
        os.close(handle)
        if error.errno in NO_LOCKS:
            return _take_by_text(path)
        raise
    owner = _owner(_text(handle))
    # Some network file systems lock within one machine only: what another machine left there is not
    # ours to take.
    if owner is not None and owner.life == "elsewhere":
        os.close(handle)
        return None, owner
    try:
        _write(handle, _own_text())
    except OSError:
        os.close(handle)
        raise

    def release() -> None:
        try:
            _write(handle, b"")
        finally:
            os.close(handle)

    return release, None


def _take_by_text(path: Path) -> tuple[Release | None, ProcessName | None]:
    """Try once without the help of the file system: whoever makes the file with its name in it
    holds the lock.
    """
    named, mine = _named(path), temporary_path(path)
    mine.write_bytes(_own_text())
    try:
        for _ in range(2):
            try:
                os.link(mine, named)
            except FileExistsError:
                text = named.read_bytes() if named.exists() else b""
                owner = _owner(text)
                if owner is None or owner.life != "gone" or not _put_aside(named, text):
                    return None, owner
            else:
                return lambda: named.unlink(missing_ok=True), None
    finally:
        mine.unlink(missing_ok=True)
    return None, None


def _named(path: Path) -> Path:
    """Return the file that is the lock where the file system has none."""
    return path.with_name(path.name + ".owner")


def _put_aside(named: Path, text: bytes) -> bool:
    """Remove the file of a holder that is gone; False if another process took the lock meanwhile,
    which keeps it.
    """
    aside = temporary_path(named)
    try:
        named.rename(aside)
    except FileNotFoundError:
        return True
    stale = aside.read_bytes() == text
    if not stale:
        with contextlib.suppress(FileExistsError):
            os.link(aside, named)
    aside.unlink()
    return stale


def _own_text() -> bytes:
    return (
        json.dumps(this_process(datetime.now(UTC).isoformat(timespec="seconds")).as_dict()).encode()
        + b"\n"
    )


def _text(handle: int) -> bytes:
    return os.pread(handle, 4096, 0)


def _write(handle: int, text: bytes) -> None:
    os.ftruncate(handle, 0)
    os.pwrite(handle, text, 0)


def _owner(text: bytes) -> ProcessName | None:
    """Read who holds the lock; None where nobody says so."""
    try:
        fields = json.loads(text)
        return ProcessName(
            int(fields["pid"]), *(str(fields[key]) for key in ("host", "boot", "started", "since"))
        )
    except (ValueError, KeyError, TypeError):
        return None
