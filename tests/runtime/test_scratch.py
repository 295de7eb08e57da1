"""What killed workers leave on a node is removed, and nothing of anybody else."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from alpasim_plugin.io.atomic import temporary_path
from alpasim_plugin.runtime.executors.scratch import scratch_root, sweep

NO_PROCESS = 2**22 + 1  # above the most that Linux gives
LATER_S = 4_102_444_800.0  # of a file system whose clock is far ahead of this machine's


def left_over(folder: Path, pid: int) -> Path:
    made = temporary_path(folder / "rollout")
    path = made.with_name(made.name.replace(f".{os.getpid()}.", f".{pid}."))
    path.mkdir(parents=True)
    os.utime(path, (LATER_S, LATER_S))
    return path


def test_only_what_gone_processes_of_this_machine_have_left_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SIMRUN_SCRATCH", str(tmp_path))
    gone, running = left_over(scratch_root(), NO_PROCESS), left_over(scratch_root(), os.getpid())
    monkeypatch.setattr(socket, "gethostname", lambda: "another")
    of_another = left_over(scratch_root(), NO_PROCESS)
    monkeypatch.undo()
    monkeypatch.setenv("SIMRUN_SCRATCH", str(tmp_path))
    sweep()
    assert not gone.exists()
    assert running.exists()
    assert of_another.exists()
