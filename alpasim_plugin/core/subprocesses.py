"""Child processes: workers of our own, and a command of the user's, whose output is passed on. None
outlives this process.

Standard output belongs to the command: what parts print goes to standard error, so that ``--json``
stays one document. In a run it also goes to a file beside the rollout's log.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from alpasim_plugin.core.errors import InputError

SAFE_PATH, OURS = (
    "PYTHONSAFEPATH",
    "simrun",
)  # variable that keeps Python from importing from the working directory; our value of it
ORPHANED = 70  # exit code of a worker whose parent is gone (EX_SOFTWARE)
SUPERVISOR = Path(__file__).with_name("supervisor.py")
GRACE_S = 5.0  # between asking the command to end and ending it
LAST_LINES = 20
LINE_BYTES = 8192  # longer lines are cut into several


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
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    here = os.path.realpath(os.getcwd())
    sys.path[:] = [
        folder for folder in sys.path if folder in given or os.path.realpath(folder) != here
    ]


def forget_safe_path() -> None:
    """Undo `safe_path` in the process that was started, for those that it starts itself."""
    if os.environ.get(SAFE_PATH) == OURS:
        del os.environ[SAFE_PATH]


def end_with_parent() -> None:
    """End this worker process as soon as its parent is gone, however that ended."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(ORPHANED)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


class Child:
    """A running command, in a process group of its own under a supervisor
    (`alpasim_plugin.core.supervisor`).

    Args:
        command: Program and arguments; no shell reads them.
        environment: Variables beside those of this process.
        heard: Called with every line of its standard output and error, from a thread.
        ended: Called once, when it is stopped.

    Raises:
        InputError: The system has no process groups.

    Attributes:
        last: The last lines that it printed.
    """

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        heard: Callable[[str], None],
        ended: Callable[[], None],
    ) -> None:
        if sys.platform == "win32":
            raise InputError(
                f"{command[0]}: Windows has no process groups to end it with",
                "use Linux, macOS or WSL",
            )
        self.last: deque[str] = deque(maxlen=LAST_LINES)
        self._heard, self._ended = heard, ended
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(SUPERVISOR), str(GRACE_S), *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **environment},
            # Ctrl-C in a terminal is for simrun alone, which then ends the command
            start_new_session=True,
        )
        self._pump = threading.Thread(target=self._listen, name="child-output", daemon=True)
        self._pump.start()
        _running.append(self)

    def end_within(self, seconds: float) -> int | None:
        """Return the exit code (128 + N after signal N) if the command ends within a time; None if
        it still runs.
        """
        try:
            code = self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        self._pump.join(1.0)  # a grandchild that left the group may keep the pipe open for ever
        return code

    def stop(self) -> None:
        """End the command and what it started; harmless if it has ended."""
        if self not in _running:
            return
        _running.remove(self)
        assert self._process.stdin is not None
        self._process.stdin.close()
        if self.end_within(GRACE_S + 2.0) is None:
            self._process.kill()
            self._process.wait()
        self._ended()

    def _listen(self) -> None:
        output = self._process.stdout
        assert output is not None
        with output:
            for line in iter(lambda: output.readline(LINE_BYTES), b""):
                text = line.decode(errors="replace").rstrip("\r\n")
                self.last.append(text)
                self._heard(text)


_running: list[Child] = []


def end_children() -> None:
    """Stop every command that this process has started: at the end of a run, and of the process."""
    while _running:
        _running[0].stop()


atexit.register(end_children)


def exit_reason(code: int) -> str:
    """Say how a command ended.

    Example:
        >>> exit_reason(3), exit_reason(137)
        ('exit code 3', 'exit code 137 (SIGKILL)')
    """
    names = {128 + int(one): one.name for one in signal.Signals}
    return f"exit code {code}" + (f" ({names[code]})" if code in names else "")


MOST_BYTES = 4 << 20  # of the file; a part that prints without end does not fill the disk
_LEFT_OUT = "\n(the rest is left out)\n"
_open: list[_Output] = []


class _Output(io.TextIOBase):
    """Standard error, and a file that is made when there is something to write."""

    def __init__(self, path: Path | None) -> None:
        self._path, self._written = path, 0
        self._file: TextIO | None = None
        self._lock = threading.Lock()

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        """Write to both; several threads may."""
        sys.stderr.write(text)
        with self._lock:
            if self._path is not None and self._written < MOST_BYTES:
                if self._file is None:
                    self._file = self._path.open("w", encoding="utf-8", errors="replace")
                self._written += len(text)
                self._file.write(text if self._written < MOST_BYTES else _LEFT_OUT)
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
    output = _open[-1] if _open else sys.stderr
    output.write(f"{line}\n")
