"""Name a process so that another can tell whether it still runs; this one's memory."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

ENDED = ("Z", "X")  # states of a process that runs no more

Life = Literal["running", "gone", "elsewhere"]


@dataclass(frozen=True)
class ProcessName:
    """Identity of a process, distinct from that of a later process with the same number.

    Attributes:
        pid: Its number.
        host: Name of the machine.
        boot: Changes whenever the machine starts; equal in all containers of a machine.
        started: When the process started, in the system's own units; empty where the system does
            not say.
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
        return (
            "running" if is_running(self.pid) and started_of(self.pid) == self.started else "gone"
        )

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.since}"


def this_process(since: str) -> ProcessName:
    """Name this process; ``since`` as in `ProcessName`."""
    return ProcessName(os.getpid(), socket.gethostname(), boot_id(), started_of(os.getpid()), since)


@cache
def boot_id() -> str:
    """Return a text that changes whenever the machine starts; empty where the system does not
    say.
    """
    linux = Path("/proc/sys/kernel/random/boot_id")
    if linux.exists():
        return linux.read_text().strip()
    return _said_by("sysctl", "-n", "kern.bootsessionuuid")


def started_of(pid: int) -> str:
    """Return when a process started, in the system's own units; empty where there is none, or only
    what its parent has not yet fetched.
    """
    try:
        # The name of the program, in parentheses, may hold spaces. Fields 3 and 22: state, and
        # start in clock ticks after the machine's.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return "" if fields[0] in ENDED else fields[19]
    except OSError:
        state, _, start = (
            ("", "", "")
            if sys.platform == "linux"
            else _said_by("ps", "-o", "stat=,lstart=", "-p", str(pid)).partition(" ")
        )
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


def resident_mb(key: str) -> float | None:
    """Return an entry of ``/proc/self/status`` in 1e6 bytes, None where the system has no such
    file.
    """
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next(
        (float(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(f"{key}:")), None
    )
