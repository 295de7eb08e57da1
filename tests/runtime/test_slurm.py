"""Jobs through submitit's local executor: processes of this machine, but all of the way that jobs of Slurm take.

`pytest -m slow tests/runtime/test_slurm.py`, about a minute.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from alpasim_plugin.errors import InfrastructureError
from alpasim_plugin.runtime.executors.base import Resources
from alpasim_plugin.runtime.executors.choice import Executor
from alpasim_plugin.runtime.executors.dispatch import dispatch
from alpasim_plugin.runtime.executors.identity import identity_of
from alpasim_plugin.runtime.executors.placing import Contents
from alpasim_plugin.runtime.run import execute_run
from alpasim_plugin.runtime.workers import Lost
from tests.runtime.remote_work import Scripted
from tests.runtime.test_runs import Heard, cheap_plan, comparable

pytest.importorskip("submitit", reason="the extra [slurm] is not installed")
pytestmark = pytest.mark.slow


def scripted(
    work: Scripted, items: list[str], folder: Path, expected: dict[str, str] | None = None, contents: Contents | None = None
) -> dict:
    from alpasim_plugin.runtime.executors.slurm_pool import SlurmPool

    pool: SlurmPool[str] = SlurmPool(work, contents or Contents(), expected or identity_of(()), (), Resources(), 2, "@local", folder, print)
    try:
        return dict(dispatch(pool, items, print))
    finally:
        pool.close()


def test_jobs_give_the_run_of_one_process(tmp_path: Path) -> None:
    heard = Heard()
    plan = cheap_plan()
    execute_run(plan, tmp_path / "here", 1, ["simrun"], Heard(), certificate="none", report=False)
    executor = Executor("slurm", "@local")
    execute_run(plan, tmp_path / "jobs", 2, ["simrun"], heard, certificate="none", report=False, executor=executor)
    assert heard.fates == [("ok", False)] * 4
    assert comparable(tmp_path / "jobs") == comparable(tmp_path / "here")
    assert not (tmp_path / "jobs" / ".slurm").exists()


def test_every_item_has_a_result_though_jobs_die(tmp_path: Path) -> None:
    (notes := tmp_path / "notes").mkdir()
    contents = Contents()
    sha256 = contents.add_bytes(bytes(1000))
    found = scripted(Scripted(notes), ["a", "die", "die once", f"fetch {sha256}"], tmp_path, contents=contents)
    lost = found.pop("die")
    assert isinstance(lost, Lost)
    assert "3 workers died of it" in lost.found
    assert found == {"a": "A", "die once": "DIE ONCE", f"fetch {sha256}": 1000}
    assert list(tmp_path.iterdir()) == [notes]


def test_a_node_of_another_version_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InfrastructureError, match=r"no node takes the work: .*scipy is .*, the driver has 0\.0\.1"):
        scripted(Scripted(tmp_path), ["a"], tmp_path, {**identity_of(()), "scipy": "0.0.1"})


DRIVER = """
import sys
from pathlib import Path
from tests.runtime.remote_work import Scripted
from tests.runtime.test_slurm import scripted
scripted(Scripted(Path(sys.argv[1])), ["a", "b", "sleep 300"], Path(sys.argv[2]))
"""


def test_a_killed_driver_leaves_results_that_the_next_one_takes_over(
    tmp_path: Path, repo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (notes := tmp_path / "notes").mkdir()
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(notes), str(tmp_path)], cwd=repo, env={**os.environ, "PYTHONPATH": str(repo)}
    )
    until = time.monotonic() + 120
    while not list(notes.glob("sleep*")):
        assert time.monotonic() < until
        time.sleep(0.1)
    driver.send_signal(signal.SIGSTOP)  # results from here on are not taken
    job = int(next(notes.glob("sleep*")).name.split(".")[-2])
    driver.kill()
    driver.wait()
    assert Path("/proc", str(job)).exists(), "a job of Slurm outlives its driver"
    found = scripted(Scripted(notes), ["a", "b", "c"], tmp_path)
    assert found == {"a": "A", "b": "B", "c": "C"}
    assert "1 of its jobs are cancelled" in capsys.readouterr().out
    until = time.monotonic() + 30
    while Path("/proc", str(job)).exists():
        assert time.monotonic() < until, "the job was not cancelled"
        time.sleep(0.1)
    assert list(tmp_path.iterdir()) == [notes]
