"""The folder in which a node drives, and what killed workers have left there.

Machines may share the file system: each has a folder of its own in it, since only it can tell which of its processes still run.
"""

from __future__ import annotations

import os
import socket
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from alpasim_plugin.process.processes import is_running
from alpasim_plugin.runtime.writing import remove_left_overs

GONE_S = 5.0  # within which a killed process must be gone


def scratch_root() -> Path:
    """Return where this node drives: a folder of the user and machine below ``$SIMRUN_SCRATCH``, or the system's temporary one."""
    return Path(os.environ.get("SIMRUN_SCRATCH") or tempfile.gettempdir(), f"simrun-{os.getuid()}-{socket.gethostname()}")


def measured_folder(run: str) -> Path:
    """Return where the processes of a run on this node share what they measure (`alpasim_plugin.io.measured`)."""
    return scratch_root() / "measured" / run


def sweep(pids: Sequence[int] = ()) -> None:
    """Remove what killed workers have left on this node, once these processes are gone.

    Only names that simrun gives are touched, and only those of processes that run no more.
    """
    until_s = time.monotonic() + GONE_S
    while any(is_running(pid) for pid in pids) and time.monotonic() < until_s:
        time.sleep(0.05)
    if scratch_root().is_dir():
        remove_left_overs(scratch_root())
