"""A command of the user's as a child process, whose output is passed on. It does not outlive this
process.
"""

import atexit
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from alpasim_plugin.core.errors import InputError

SUPERVISOR = Path(__file__).with_name("supervisor.py")
GRACE_S = 5.0  # between asking the command to end and ending it
LAST_LINES = 20
LINE_BYTES = 8192  # longer lines are cut into several


class Child:
    """A running command, in a process group of its own under a supervisor
    (`alpasim_plugin.alpasim.client.supervisor`).

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
        self._heard = heard
        self._ended = ended
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
    names = {128 + int(number): number.name for number in signal.Signals}
    return f"exit code {code}" + (f" ({names[code]})" if code in names else "")
