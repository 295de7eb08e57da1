"""Name a process so that another can tell whether it still runs; end workers with the process that started them; this one's memory."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

PR_SET_PDEATHSIG = 1  # linux/prctl.h
ENDED = ("Z", "X")  # states of a process that runs no more
ORPHANED = 70  # exit code of a worker whose parent is gone (EX_SOFTWARE)

Life = Literal["running", "gone", "elsewhere"]


@dataclass(frozen=True)
class ProcessName:
    """Identity of a process, distinct from that of a later process with the same number.

    Attributes:
        pid: Its number.
        host: Name of the machine.
        boot: Changes whenever the machine starts; equal in all containers of a machine.
        started: When the process started, in the system's own units; empty where the system does not say.
        since: The same for people, ISO 8601, UTC.
    """

    pid: int
    host: str
    boot: str
    started: str
    since: str

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, for JSON."""
        return asdict(self)

    @property
    def life(self) -> Life:
        """Tell whether the process still runs; ``elsewhere`` if only another machine could tell."""
        if self.boot != boot_id():
            return "gone" if self.host == socket.gethostname() else "elsewhere"
        return "running" if is_running(self.pid) and started_of(self.pid) == self.started else "gone"

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.since}"


def this_process(since: str) -> ProcessName:
    """Name this process; ``since`` as in `ProcessName`."""
    return ProcessName(os.getpid(), socket.gethostname(), boot_id(), started_of(os.getpid()), since)


@cache
def boot_id() -> str:
    """Return a text that changes whenever the machine starts; empty where the system does not say."""
    linux = Path("/proc/sys/kernel/random/boot_id")
    if linux.exists():
        return linux.read_text().strip()
    return _said_by("sysctl", "-n", "kern.bootsessionuuid")


def started_of(pid: int) -> str:
    """Return when a process started, in the system's own units; empty where there is none, or only what its parent has not yet fetched."""
    try:
        # The name of the program, in parentheses, may hold spaces. Fields 3 and 22: state, and start in clock ticks after the machine's.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return "" if fields[0] in ENDED else fields[19]
    except OSError:
        state, _, start = ("", "", "") if sys.platform == "linux" else _said_by("ps", "-o", "stat=,lstart=", "-p", str(pid)).partition(" ")
        return "" if state[:1] in ENDED else start.strip()


def is_running(pid: int) -> bool:
    """Tell whether this machine has a process of this number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    return True


def _said_by(*command: str) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        return ""


def end_with_parent() -> None:
    """End this worker process as soon as its parent is gone, by whatever signal; call it first, in the worker's main thread.

    A thread waits for the end of a pipe that only the parent holds open, which works on every system. Linux kills the worker as well, so
    that one inside a long call that never returns to Python ends too. A parent that died before the request was made is noticed by the
    change of the parent's number.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent.pid:
        os._exit(ORPHANED)

    def watch() -> None:
        parent.join()
        os._exit(ORPHANED)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


def resident_mb(key: str) -> float | None:
    """Return an entry of ``/proc/self/status`` in 1e6 bytes, None where the system has no such file."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((float(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(f"{key}:")), None)
