"""One writer at a time; a holder that was killed holds nothing."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from alpasim_plugin.core import lock
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.lock import one_writer
from alpasim_plugin.core.processes import this_process

HOLDER = """
import errno, sys, time
from pathlib import Path
from alpasim_plugin.core import lock
def no_flock(handle, how):
    raise OSError(errno.ENOLCK, "no locks")
if sys.argv[2] == "text":
    lock.fcntl.flock = no_flock
with lock.one_writer(Path(sys.argv[1]), "writing", "a folder"):
    print("held", flush=True)
    time.sleep(60)
"""


def hold(path: Path, how: str = "flock") -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), how], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def no_flock(handle: int, how: int) -> None:
    raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))


@pytest.fixture(params=["flock", "text"])
def how(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Give both ways to lock: with the file system's help, and without."""
    if request.param == "text":
        monkeypatch.setattr(lock.fcntl, "flock", no_flock)
    return str(request.param)


def test_a_second_process_is_refused_by_name_and_a_killed_one_holds_nothing(
    tmp_path: Path, how: str
) -> None:
    path = tmp_path / "folder" / ".lock"
    process = hold(path, how)
    with (
        pytest.raises(
            InfrastructureError, match=f"process {process.pid} on .* is writing it"
        ) as caught,
        one_writer(path, "writing", "it"),
    ):
        pass
    assert "--wait" in caught.value.hint
    assert f"kill {process.pid}" in caught.value.hint
    process.send_signal(signal.SIGKILL)
    process.wait()
    for _ in range(2):
        with one_writer(path, "writing", "it"):
            pass


def test_who_waits_says_for_whom_and_gets_the_lock(tmp_path: Path, how: str) -> None:
    path, said = tmp_path / ".lock", []
    process = hold(path, how)
    threading.Timer(0.2, process.kill).start()
    with one_writer(path, "writing", "folder x", wait=True, waiting=said.append):
        assert len(said) == 1
        assert f"process {process.pid}" in said[0]
        assert "folder x" in said[0]
    process.wait()


def test_the_holder_itself_is_refused_a_second_time(tmp_path: Path, how: str) -> None:
    path = tmp_path / ".lock"
    with (
        one_writer(path, "writing", "it"),
        pytest.raises(InfrastructureError),
        one_writer(path, "writing", "it"),
    ):
        pass


@pytest.mark.parametrize(
    ("change", "is_stale"),
    [
        ({"host": "another", "boot": "another"}, False),  # nobody here can tell whether it runs
        ({"boot": "another"}, True),  # this machine has been started anew
        ({"pid": 2**22 + 1}, True),
        ({"started": "1"}, True),  # the number belongs to a younger process
    ],
)
def test_what_a_holder_left_is_judged_by_machine_number_and_start(
    tmp_path: Path, how: str, change: dict[str, object], is_stale: bool
) -> None:
    path = tmp_path / ".lock"
    named = path if how == "flock" else path.with_name(".lock.owner")
    named.write_text(json.dumps(this_process("2026-01-01T00:00:00+00:00").as_dict() | change))
    if is_stale:
        with one_writer(path, "writing", "it"):
            pass
        return
    with (
        pytest.raises(InfrastructureError, match="on another") as caught,
        one_writer(path, "writing", "it"),
    ):
        pass
    assert f"remove {named if how == 'text' else path}" in caught.value.hint


def test_the_time_of_the_lock_is_after_what_was_there_before(tmp_path: Path) -> None:
    (tmp_path / "before").write_text("")
    time.sleep(0.01)
    with one_writer(tmp_path / ".lock", "writing", "it") as held:
        assert (tmp_path / "before").stat().st_mtime_ns < held.since_ns
        time.sleep(0.01)
        (tmp_path / "after").write_text("")
        assert (tmp_path / "after").stat().st_mtime_ns > held.since_ns
