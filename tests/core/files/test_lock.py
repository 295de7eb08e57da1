"""One writer at a time: others are refused or wait, and a killed holder keeps nothing."""

import os
import subprocess
import sys

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.files.lock import is_locked, one_writer

HOLDER = """
import sys, time
from pathlib import Path
from alpasim_plugin.core.files.lock import one_writer
with one_writer(Path(sys.argv[1]), "a folder"):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def holder(path, seconds, repo):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), str(seconds)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(repo)},
    )
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_writer_is_refused_until_the_first_is_killed(tmp_path, repo):
    path = tmp_path / "new" / ".lock"
    first = holder(path, 60.0, repo)
    assert is_locked(path)
    with pytest.raises(InfrastructureError), one_writer(path, "a folder"):
        pass
    first.kill()
    first.communicate()
    assert not is_locked(path)
    with one_writer(path, "a folder") as held:
        assert held.since_ns == path.stat().st_mtime_ns
        assert is_locked(path)
    assert not is_locked(path)


def test_a_writer_that_waits_says_so_once(tmp_path, repo):
    first = holder(tmp_path / ".lock", 1.0, repo)
    lines = []
    with one_writer(tmp_path / ".lock", "folder x", wait=True, waiting=lines.append):
        assert first.wait(10) == 0
    first.communicate()
    assert len(lines) == 1
    assert "folder x" in lines[0]
