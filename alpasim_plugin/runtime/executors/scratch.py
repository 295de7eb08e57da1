"""The folder in which a node drives, and what killed workers have left there.

Machines may share the file system: each has a folder of its own in it, since only it can tell which of its processes still run.
"""

from __future__ import annotations

import os
import socket
import stat
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


def measured_folder(run: str) -> Path | None:
    """Return where the processes of a run on this node share what they measure (`alpasim_plugin.io.measured`).

    None: nowhere, since `scratch_root` cannot be made, belongs to another user, or others may write there. Its name can be guessed, so
    whoever was there first could decide what this run takes for its machine's speed.
    """
    root = scratch_root()
    try:
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = root.lstat()
    except OSError:
        return None
    is_private = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o022
    return root / "measured" / run if is_private else None


def sweep(pids: Sequence[int] = ()) -> None:
    """Remove what killed workers have left on this node, once these processes are gone.

    Only names that simrun gives are touched, and only those of processes that run no more.
    """
    until_s = time.monotonic() + GONE_S
    while any(is_running(pid) for pid in pids) and time.monotonic() < until_s:
        time.sleep(0.05)
    if scratch_root().is_dir():
        remove_left_overs(scratch_root())
