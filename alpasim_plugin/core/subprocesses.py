"""Workers of our own: what they may import, and that none outlives this process; and what parts
print.

Standard output belongs to the command: what parts print goes to standard error, so that ``--json``
stays one document. In a run it also goes to a file beside the rollout's log.
"""

import contextlib
import ctypes
import io
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from alpasim_plugin.core.cores import system_lines

SAFE_PATH = "PYTHONSAFEPATH"  # keeps Python from importing from the working directory
OURS = "simrun"  # our value of it
SET_CHILD_SUBREAPER = 36  # of prctl(2)
ENDED = "ZXx"  # states of a process
GENERATIONS = 100  # of orphans, at most
MOMENT_S = 0.01
ORPHANED = 70  # exit code of a worker whose parent is gone (EX_SOFTWARE)
MOST_BYTES = 4 << 20  # of one rollout, and of what is printed outside of them
LEFT_OUT = "\n(the rest is left out)\n"


@contextmanager
def safe_path() -> Iterator[None]:
    """Let Python processes that are started during the block import nothing from the working
    directory.

    ``python -c`` and ``python -m``, by which workers are started, would look for the standard
    library there first. The process that was started calls `own_path_only`, so that a user's
    command that it starts is not concerned.
    """
    if SAFE_PATH in os.environ:
        yield
        return
    os.environ[SAFE_PATH] = OURS
    try:
        yield
    finally:
        del os.environ[SAFE_PATH]


def own_path_only() -> None:
    """Take the working directory off this worker's import path, unless the user's ``PYTHONPATH``
    names it; undo `safe_path`.
    """
    forget_safe_path()
    user_folders = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    working_folder = os.path.realpath(os.getcwd())
    sys.path[:] = [
        folder
        for folder in sys.path
        if folder in user_folders or os.path.realpath(folder) != working_folder
    ]


def forget_safe_path() -> None:
    """Undo `safe_path` in the process that was started, for those that it starts itself."""
    if os.environ.get(SAFE_PATH) == OURS:
        del os.environ[SAFE_PATH]


def lead_group() -> None:
    """Make this worker the leader of a process group, so that what parts start in it ends with it
    (`end_group`); on Linux a process whose own parent has ended stays its child as well.
    """
    if not hasattr(os, "setpgid"):
        return
    os.setpgid(0, 0)
    adopt_orphans()


def adopt_orphans() -> None:
    """On Linux, become the parent of each process below this one whose own parent has ended."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def end_group(leader: int) -> None:
    """End what is left of the process group of a worker, the worker itself included."""
    if hasattr(os, "killpg"):
        with contextlib.suppress(OSError):  # nothing is left of it
            os.killpg(leader, signal.SIGKILL)


def end_descendants() -> None:
    """End all processes that this one has started, and those that they have started; on Linux."""
    parents = dict(_processes())
    line = [os.getpid()]
    while line:
        parent = line.pop()
        children = [pid for pid, its_parent in parents.items() if its_parent == parent]
        line += children
        for pid in children:
            with contextlib.suppress(OSError):  # it has ended meanwhile
                os.kill(pid, signal.SIGKILL)


def end_orphans(parent: int, kept: Collection[int]) -> None:
    """End the processes that have come to a parent because their own has ended, and what comes after
    them in the same way; on Linux.

    Args:
        parent: A process that has called `adopt_orphans`.
        kept: Its own children.
    """
    for _ in range(GENERATIONS):
        orphans = {pid for pid, its_parent in _processes() if its_parent == parent}.difference(kept)
        if not orphans:
            return
        for pid in orphans:
            with contextlib.suppress(OSError):  # it has ended meanwhile
                os.kill(pid, signal.SIGKILL)
        time.sleep(MOMENT_S)  # until they have handed on their children


def parent_of(pid: int) -> int | None:
    """Return the parent of a process, where the system lists them; None where it has ended."""
    return dict(_processes()).get(pid)


def _processes() -> Iterator[tuple[int, int]]:
    """Yield the processes of this machine, each with its parent, where the system lists them."""
    for folder in Path("/proc").glob("[0-9]*"):
        facts = "".join(system_lines(folder / "stat")).rpartition(")")[2].split()
        if facts and facts[0] not in ENDED:  # no facts: it has ended meanwhile
            yield int(folder.name), int(facts[1])


def end_with_parent() -> None:
    """End this worker process, and its group, as soon as its parent is gone, however that ended."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        end_descendants()
        if hasattr(os, "getpgrp") and os.getpgrp() == os.getpid():
            end_group(os.getpid())
        os._exit(ORPHANED)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


class _Output(io.TextIOBase):
    """Standard error, and a file that is made when there is something to write."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._written = 0
        self._closing_line = LEFT_OUT
        self._file: TextIO | None = None
        self._lock = threading.Lock()

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        """Write to both, up to the limit; several threads may."""
        with self._lock:
            output = text
            self._written += len(text)
            if self._written >= MOST_BYTES:
                output = self._closing_line
                self._closing_line = ""
            sys.stderr.write(output)
            if self._path is not None:
                if self._file is None:
                    self._file = self._path.open("w", encoding="utf-8", errors="replace")
                self._file.write(output)
                self._file.flush()
        return len(text)

    def flush(self) -> None:
        sys.stderr.flush()

    def end(self) -> None:
        """Close the file; later text goes to standard error alone."""
        with self._lock:
            self._path = None
            if self._file is not None:
                self._file.close()


_open = [_Output(None)]


@contextmanager
def parts_print_to_stderr(file: Path | None = None) -> Iterator[None]:
    """Send what is printed during the block to standard error, and to ``file``, which is made only
    if something is printed.
    """
    output = _Output(file)
    _open.append(output)
    try:
        with contextlib.redirect_stdout(output):
            yield
    finally:
        _open.remove(output)
        output.end()


def say(line: str) -> None:
    """Pass on a line that a part in another process printed; any thread may call it."""
    _open[-1].write(f"{line}\n")
