"""What killed workers leave on a node is removed, and nothing of anybody else."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from alpasim_plugin.core.atomic import temporary_path
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.runs.executors.assignment import measured_folder, scratch_root, sweep

NO_PROCESS = 2**22 + 1  # above the most that Linux gives
LATER_S = 4_102_444_800.0  # of a file system whose clock is far ahead of this machine's


def left_over(folder: Path, pid: int) -> Path:
    made = temporary_path(folder / "rollout")
    path = made.with_name(made.name.replace(f".{os.getpid()}.", f".{pid}."))
    path.mkdir(parents=True)
    os.utime(path, (LATER_S, LATER_S))
    return path


def test_only_what_gone_processes_of_this_machine_have_left_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_measurements_and_scratch_are_in_a_folder_of_this_user_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIMRUN_SCRATCH", str(tmp_path))
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path))
    folder = measured_folder("run")
    assert folder is not None
    for made in (scratch_root(), folder.parent):
        assert made.stat().st_mode & 0o777 == 0o700
        made.chmod(0o777)
    assert measured_folder("run") is None, "others may write there"
    with pytest.raises(InfrastructureError, match="another user could write it"):
        scratch_root()
    made.rename(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").chmod(0o700)
    made.symlink_to(tmp_path / "elsewhere")
    assert measured_folder("run") is None, "a link, which whoever made it can turn"
