"""Drivers to kill: processes of their own, forked from one that has imported everything, so that a
hundred of them take minutes.

A driver is the command line, from its entry point on: its own process group, signal handlers, lock
and workers.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch  # noqa: F401  imported before the forks

import evaluators.report  # noqa: F401
from alpasim_plugin.cli.main import main

T = TypeVar("T")
GIVE_UP_S = 300.0
FORK_FAILED = 99


@dataclass
class Driver:
    """A running command line; ``says`` is where its standard error goes."""

    pid: int
    says: Path
    code: int | None = None

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while it runs."""
        if self.code is None:
            done, status = os.waitpid(self.pid, os.WNOHANG)
            if done:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code

    def wait(self) -> int | None:
        """Wait for the exit code; None if the driver hangs, which is then killed."""
        until = time.monotonic() + GIVE_UP_S
        while self.poll() is None:
            if time.monotonic() > until:
                os.killpg(self.pid, signal.SIGKILL)
                os.waitpid(self.pid, 0)
                return None
            time.sleep(0.01)
        return self.code

    @property
    def said(self) -> str:
        """Give what it wrote to standard error."""
        return self.says.read_text(errors="replace")


def start(
    arguments: Sequence[str], says: Path, before: Callable[[], object] = lambda: None
) -> Driver:
    """Start a driver; ``before`` is called in it first."""
    pid = os.fork()
    if pid:
        return Driver(pid, says)
    try:
        os.setsid()
        out = os.open(says, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(out, 2)
        os.dup2(os.open(os.devnull, os.O_RDWR), 0)
        os.dup2(0, 1)
        sys.argv = ["simrun", *arguments]
        before()
        main()
    except SystemExit as leaving:
        sys.stderr.flush()
        os._exit(leaving.code if isinstance(leaving.code, int) else FORK_FAILED)
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(FORK_FAILED)


def in_child(work: Callable[[], T]) -> T:
    """Return what ``work`` returns, computed in a forked process, so that this one never starts a
    thread.
    """
    read, write = os.pipe()
    pid = os.fork()
    if not pid:
        os.close(read)
        with os.fdopen(write, "wb") as pipe:
            pickle.dump(work(), pipe)
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        data = pipe.read()
    os.waitpid(pid, 0)
    result: T = pickle.loads(data)
    return result


def processes_of(group: int) -> list[int]:
    """Return the processes of a process group that are neither gone nor zombies (Linux)."""
    alive = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[2]) == group and fields[0] != "Z":
                alive.append(int(entry.name))
    return alive


def workers_of(driver: int) -> list[int]:
    """Return the processes that a driver started, without Python's resource tracker (Linux)."""
    try:
        children = Path(f"/proc/{driver}/task/{driver}/children").read_text().split()
        return [
            int(child)
            for child in children
            if b"resource_tracker" not in Path(f"/proc/{child}/cmdline").read_bytes()
        ]
    except OSError:
        return []


def handles_signals(pid: int) -> bool:
    """Tell whether a driver has come as far as our handlers."""
    try:
        caught = next(
            line
            for line in Path(f"/proc/{pid}/status").read_text().splitlines()
            if line.startswith("SigCgt:")
        )
    except OSError:
        return False
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)
