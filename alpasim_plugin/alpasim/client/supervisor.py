"""Start a command and end it with whoever asked: ``python supervisor.py GRACE_S COMMAND...``; the
standard library alone, run as a script.

Standard input is a pipe that only the asking process holds open. When it ends, by whatever signal
that process died, the command and all that it started get SIGTERM (which a container's client hands
on to its container), and SIGKILL after the grace time. The exit code is the command's; 128 + N
where signal N ended it.
"""

import ctypes
import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress

PR_SET_PDEATHSIG = 1  # linux/prctl.h
NOT_STARTED = 127
POLL_S = 0.02


def main(grace_s: float, command: list[str]) -> int:
    """Run a command until it ends or standard input does; return its exit code."""
    bell, ring = os.pipe()
    for end in (bell, ring):
        os.set_blocking(end, False)
    # with a handler, the signal's number is written to the pipe below
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGTERM, lambda *_: None)
    signal.set_wakeup_fd(ring, warn_on_full_buffer=False)
    try:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, start_new_session=True, preexec_fn=_die_with_parent
        )
    except OSError as error:
        print(f"{command[0]}: {error.strerror or error}", flush=True)
        return NOT_STARTED
    while child.poll() is None:
        ready, _, _ = select.select([sys.stdin.fileno(), bell], [], [])
        woken_by = os.read(bell, 64) if bell in ready else b""
        if sys.stdin.fileno() in ready or signal.SIGTERM in woken_by:
            _signal_group(child.pid, signal.SIGTERM)
            end_s = time.monotonic() + grace_s
            while child.poll() is None and time.monotonic() < end_s:
                time.sleep(POLL_S)
            _signal_group(child.pid, signal.SIGKILL)
            break
    _signal_group(child.pid, signal.SIGKILL)  # what the command left running behind it
    code = child.wait()
    return code if code >= 0 else 128 - code


def _signal_group(group: int, number: int) -> None:
    # macOS answers EPERM for a group of ended processes
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, number)


def _die_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]), sys.argv[2:]))
