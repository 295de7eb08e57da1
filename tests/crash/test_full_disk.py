"""A disk that is full at any write of a run: nothing is lost, and the same command finishes
(`python -m tests.crash` kills as well).
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.log.run_folder.check import inspect_run
from tests.runs.test_run_folders import plan_of, run
from tests.runs.test_runs import comparable


class Disk:
    """Refuses one of the writes of this process; every file of simrun ends with an fsync."""

    def __init__(self, refused: int) -> None:
        self.left = refused

    def fsync(self, handle: int) -> None:
        self.left -= 1
        if self.left == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give the run that no disk refused."""
    folder = tmp_path_factory.mktemp("whole")
    run(folder, plan_of((0,)))
    return folder


QUICK = (4, 10, 12)  # facts of a rollout, a manifest, a table
WRITES = 17  # of the run


@pytest.mark.parametrize(
    "refused",
    [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in range(1, WRITES + 1)],
)
def test_a_run_with_a_refused_write_says_so_and_the_same_command_finishes_it(
    refused: int, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of((0,))
    disk = Disk(refused)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", disk.fsync)
        try:
            announced = run(tmp_path / "full", plan)
        except InfrastructureError as error:  # a write of the run itself
            advice = error.hint
        else:  # a write of a rollout, which is a failed one then
            assert [status for status, _ in announced.results].count("failed") == 1
            advice = "free disk space"
    assert "free disk space" in advice
    assert disk.left <= 0
    finished = sum(path.stat().st_size > 0 for path in (tmp_path / "full").rglob("manifest.json"))
    again = run(tmp_path / "full", plan)
    assert len(again.results) == 2
    assert finished <= 2
    assert inspect_run(tmp_path / "full", full=True).whole
    assert comparable(tmp_path / "full") == comparable(whole)
