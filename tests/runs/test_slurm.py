"""Jobs through submitit's local executor: processes of this machine, but all of the way that jobs
of Slurm take.

`pytest -m slow tests/runs/test_slurm.py`, about a minute.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.runs.executors.assignment import Contents, assignment_as_here, identity_of
from alpasim_plugin.runs.executors.base import Lost, Resources
from alpasim_plugin.runs.executors.choice import Executor
from alpasim_plugin.runs.executors.pool import run_jobs
from alpasim_plugin.runs.run import execute_run
from tests.runs.remote_work import Scripted
from tests.runs.test_runs import Announced, cheap_plan, comparable

pytest.importorskip("submitit", reason="the extra [slurm] is not installed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1200),
]  # most of the time goes by while processes start


@pytest.fixture(autouse=True)
def private(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give the folder that sessions lie in."""
    folder = tmp_path_factory.mktemp("private")
    folder.chmod(0o700)
    monkeypatch.setenv("SIMRUN_SLURM", str(folder))
    return folder


def scripted(
    work: Scripted,
    items: list[str],
    folder: Path,
    expected: dict[str, str] | None = None,
    contents: Contents | None = None,
) -> dict:
    from alpasim_plugin.runs.executors.slurm_backend import SlurmBackend

    given = assignment_as_here(work, contents or Contents(), (), Resources(), 2, print)
    pool: SlurmBackend[str] = SlurmBackend(
        given if expected is None else replace(given, expected=expected), "@local", folder
    )
    try:
        return dict(run_jobs(pool, items, print))
    finally:
        pool.close()


def test_jobs_give_the_run_of_one_process(tmp_path: Path, private: Path) -> None:
    announced = Announced()
    plan = cheap_plan()
    execute_run(
        plan, tmp_path / "here", 1, ["simrun"], Announced(), certificate="none", report=False
    )
    executor = Executor("slurm", "@local")
    execute_run(
        plan,
        tmp_path / "jobs",
        2,
        ["simrun"],
        announced,
        certificate="none",
        report=False,
        executor=executor,
    )
    assert announced.results == [("ok", False)] * 4
    assert comparable(tmp_path / "jobs") == comparable(tmp_path / "here")
    assert list(private.iterdir()) == []


def test_every_item_has_a_result_though_jobs_die(tmp_path: Path) -> None:
    (notes := tmp_path / "notes").mkdir()
    contents = Contents()
    sha256 = contents.add_bytes(bytes(1000))
    found = scripted(
        Scripted(notes), ["a", "die", "die once", f"fetch {sha256}"], tmp_path, contents=contents
    )
    lost = found.pop("die")
    assert isinstance(lost, Lost)
    assert "3 workers died of it" in lost.found
    assert found == {"a": "A", "die once": "DIE ONCE", f"fetch {sha256}": 1000}
    assert list(tmp_path.iterdir()) == [notes]


def test_a_node_of_another_version_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(
        InfrastructureError, match=r"no node takes the work: .*scipy is .*, the driver has 0\.0\.1"
    ):
        scripted(Scripted(tmp_path), ["a"], tmp_path, {**identity_of(()), "scipy": "0.0.1"})


DRIVER = """
import sys
from pathlib import Path
from tests.runs.remote_work import Scripted
from tests.runs.test_slurm import scripted
scripted(Scripted(Path(sys.argv[1])), ["hold", "sleep 300"], Path(sys.argv[2]))
"""


def test_a_killed_driver_leaves_results_that_the_next_one_takes_over(
    tmp_path: Path, private: Path, repo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (notes := tmp_path / "notes").mkdir()
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(notes), str(tmp_path)],
        cwd=repo,
        env={**os.environ, "PYTHONPATH": str(repo)},
    )

    def until(there: Callable[[], object], what: str) -> None:
        end_s = time.monotonic() + 120
        while not there():
            assert time.monotonic() < end_s, what
            time.sleep(0.1)

    until(lambda: list(notes.glob("hold.*")) and list(notes.glob("sleep*")), "two jobs run")
    job = int(next(notes.glob("sleep*")).name.split(".")[-2])
    driver.kill()
    driver.wait()
    assert Path("/proc", str(job)).exists(), "a job of Slurm outlives its driver"
    (notes / "go").touch()
    until(
        lambda: list(private.glob("*/*/*_result.pkl")), "the job that was let go leaves its result"
    )
    found = scripted(Scripted(notes), ["hold", "c"], tmp_path)
    assert found == {"hold": "HOLD", "c": "C"}
    assert len(list(notes.glob("hold.*"))) == 1, "it was done once, by the job of the killed driver"
    assert "1 of its results are taken over, 1 of its jobs are cancelled" in capsys.readouterr().out
    until(lambda: not Path("/proc", str(job)).exists(), "the other job is cancelled")
    assert list(tmp_path.iterdir()) == [notes]
