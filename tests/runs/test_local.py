"""Workers that die, hang or lose their parent cost their own item and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.runs.executors.base import Lost
from alpasim_plugin.runs.executors.local import map_jobs, run_in_processes, run_or_retry


def work(item: str) -> str:
    """Do what the item says."""
    if item == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if (
        item.startswith("dies once ")
        and not (seen := Path(item.removeprefix("dies once "))).exists()
    ):
        seen.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if item == "leaves":
        os._exit(3)
    if item == "hangs":
        time.sleep(60)
    if item == "raises":
        raise ValueError("no")
    if item == "cannot be sent":
        return lambda: item  # type: ignore[return-value]
    return item.upper()


def test_every_item_has_a_result_and_a_worker_that_dies_costs_only_its_own() -> None:
    items = ["a", "dies", "b", "leaves", "c", "d"]
    found = dict(run_in_processes(work, items, 2, 1))
    assert {item: got for item, got in found.items() if isinstance(got, str)} == {
        "a": "A",
        "b": "B",
        "c": "C",
        "d": "D",
    }
    assert found["dies"] == Lost("its worker process ended (killed by SIGKILL)")
    assert found["leaves"] == Lost("its worker process ended (exit code 3)")


def test_an_item_that_hangs_is_ended_at_the_limit_and_the_others_are_not() -> None:
    found = dict(run_in_processes(work, ["hangs", "a"], 1, 1, limit_s=0.5))
    assert found["a"] == "A"
    assert found["hangs"] == Lost("it did not finish within 0.5 s", hung=True)


LOAD = "from alpasim_plugin.core.subprocesses import load_for_copies; load_for_copies(['colorsys'])"


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
def test_copies_answer_as_fresh_workers_do_and_have_what_was_loaded(repo: Path) -> None:
    """And they import nothing from the working directory, without a variable that would keep a
    user's own command from it.
    """
    code = (
        "import os, sys\n"
        "from alpasim_plugin.runs.executors.local import run_in_processes\n"
        "from tests.runs.test_local import loaded, work\n"
        f"{LOAD}\n"
        "found = dict(run_in_processes(work, ['a', 'dies', 'leaves', 'b'], 2, 1))\n"
        "print([getattr(found[item], 'found', found[item]) for item in ('a', 'dies', 'leaves', 'b')])\n"
        "print([got for _, got in run_in_processes(loaded, ['colorsys'], 1, 1)], 'colorsys' in sys.modules)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(repo)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    ended = (
        "'its worker process ended (killed by SIGKILL)', 'its worker process ended (exit code 3)'"
    )
    assert done.stdout == f"['A', {ended}, 'B']\n[(True, None)] False\n"


def test_what_copies_share_is_what_a_drive_needs_and_nothing_that_their_collectors_look_through() -> (
    None
):
    code = (
        "import gc, sys, alpasim_plugin.runs.executors.ahead\n"
        "print(gc.isenabled(), gc.get_freeze_count() > 10_000)\n"
        "print({'av', 'matplotlib', 'scipy.interpolate', 'scipy.spatial', 'scipy.special', 'torch'} & sys.modules.keys())"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "True True\nset()\n"
    )


def loaded(module: str) -> tuple[bool, str | None]:
    return module in sys.modules, os.environ.get("PYTHONSAFEPATH")


@pytest.mark.slow
def test_what_lost_its_worker_runs_once_more_after_all_others(tmp_path: Path) -> None:
    once = f"dies once {tmp_path / 'seen'}"
    found = list(
        run_or_retry(work, [once, "dies", "hangs", "a", "b"], 2, 1, 2.0, lambda item: None)
    )
    assert {item for item, _ in found[-2:]} == {once, "dies"}
    results = dict(found)
    assert (results[once], results["a"], results["b"]) == (once.upper(), "A", "B")
    assert (
        results["dies"].found
        == "its worker process ended (killed by SIGKILL), twice, without an error message"
    )
    assert "out-of-memory killer" in results["dies"].do_this
    assert results["hangs"].hung
    assert "--time-limit" in results["hangs"].do_this


def test_what_was_finished_before_its_worker_died_is_not_done_again(tmp_path: Path) -> None:
    assert dict(run_or_retry(work, ["dies", "a"], 2, 1, None, {"dies": "kept"}.get)) == {
        "dies": "kept",
        "a": "A",
    }


@pytest.mark.parametrize("workers", [1, 3])
def test_results_do_not_depend_on_the_number_of_workers(workers: int) -> None:
    assert dict(map_jobs(work, ["a", "b", "c", "d"], workers)) == {
        "a": "A",
        "b": "B",
        "c": "C",
        "d": "D",
    }


def test_a_result_that_is_lost_ends_work_that_needs_all_of_them() -> None:
    with pytest.raises(InfrastructureError, match="killed by SIGKILL"):
        list(map_jobs(work, ["a", "dies", "b"], 2))


@pytest.mark.parametrize(
    ("item", "error"), [("raises", "no"), ("cannot be sent", "cannot be sent to the parent")]
)
def test_an_error_ends_the_work_and_reaches_the_parent(item: str, error: str) -> None:
    with pytest.raises(Exception, match=error):
        dict(run_in_processes(work, [item, "a"], 1, 1))


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("copies", [False, True])
def test_workers_end_when_their_parent_is_killed(tmp_path: Path, repo: Path, copies: bool) -> None:
    (tmp_path / "driver.py").write_text(
        "import os, time\n"
        "from pathlib import Path\n"
        "from alpasim_plugin.runs.executors.local import map_jobs, run_in_processes, run_or_retry\n"
        "def work(folder):\n"
        "    Path(folder, str(os.getpid())).touch()\n"
        "    time.sleep(60)\n"
        "if __name__ == '__main__':\n"
        f"    {LOAD if copies else 'pass'}\n"
        f"    list(run_in_processes(work, [{str(tmp_path / 'pids')!r}] * 2, 2, 1))\n"
    )
    (tmp_path / "pids").mkdir()
    driver = subprocess.Popen(
        [sys.executable, str(tmp_path / "driver.py")], env={**os.environ, "PYTHONPATH": str(repo)}
    )
    until = time.monotonic() + 60
    while len(pids := list((tmp_path / "pids").iterdir())) < 2 and time.monotonic() < until:
        time.sleep(0.02)
    driver.kill()
    driver.wait()
    assert len(pids) == 2
    until = time.monotonic() + 10
    while any(
        Path("/proc", pid.name).exists()
        and " Z " not in Path("/proc", pid.name, "stat").read_text()
        for pid in pids
    ):
        assert time.monotonic() < until, "a worker outlives its parent"
        time.sleep(0.02)
