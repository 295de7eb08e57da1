"""Workers that die, hang or lose their parent cost their own item and nothing else."""

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.garbage import OBJECTS
from alpasim_plugin.lab.jobs import map_jobs
from alpasim_plugin.runs import local_executor as local
from alpasim_plugin.runs.local_executor import Lost, run_jobs
from tests.examples import first_of


def work(item):
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
        time.sleep(3600)
    if item == "stops":
        os.kill(os.getpid(), signal.SIGSTOP)
    if item == "raises":
        raise ValueError("no")
    if item == "cannot be sent":
        return lambda: item  # type: ignore[return-value]
    return item.upper()


@pytest.mark.slow
def test_every_item_has_a_result_and_what_lost_its_worker_runs_once_more(tmp_path):
    once = f"dies once {tmp_path / 'seen'}"
    found = dict(run_jobs(work, ["a", "dies", "b", "leaves", once, "c", "d"], 2))
    assert isinstance(found.pop("dies"), Lost)
    assert isinstance(found.pop("leaves"), Lost)
    assert found == {item: item.upper() for item in ("a", "b", "c", "d", once)}


@pytest.mark.slow
def test_an_item_that_hangs_is_ended_at_the_limit_and_the_others_are_not():
    found = dict(run_jobs(work, ["hangs", "a"], 1, limit_s=10.0))
    assert found["a"] == "A"
    assert "within 10 s" in found["hangs"].reason


@pytest.mark.slow
def test_an_item_whose_worker_is_stopped_is_ended_at_the_limit(
    monkeypatch,
):
    monkeypatch.setattr(local, "OVERTIME_S", 1.0)
    found = dict(run_jobs(work, ["stops", "a"], 2, limit_s=10.0))
    assert found["a"] == "A"
    assert "within 10 s" in found["stops"].reason


@pytest.mark.parametrize("threads", first_of([2, 1]))
def test_a_worker_has_its_threads_and_passes_no_safe_path_on(threads):
    ((_, seen),) = run_jobs(environment, ["OMP_NUM_THREADS"], 1, threads, limit_s=60.0)
    assert seen == (str(threads), None)
    assert "PYTHONSAFEPATH" not in os.environ


def collected_after(_):
    return gc.get_threshold()[0]


def test_a_worker_looks_for_cycles_as_seldom_as_a_command():
    assert [count for _, count in run_jobs(collected_after, ["once"], 1, limit_s=60.0)] == [OBJECTS]


def environment(name):
    return os.environ.get(name), os.environ.get("PYTHONSAFEPATH")


@pytest.mark.parametrize("workers", first_of([3, 1]))
def test_results_do_not_depend_on_the_number_of_workers(workers):
    assert dict(map_jobs(work, ["a", "b", "c", "d"], workers)) == {
        "a": "A",
        "b": "B",
        "c": "C",
        "d": "D",
    }


def test_a_result_that_is_lost_ends_work_that_needs_all_of_them():
    with pytest.raises(InfrastructureError):
        list(map_jobs(work, ["a", "dies", "b"], 2))


@pytest.mark.parametrize(
    ("item", "error"), [("raises", ValueError), ("cannot be sent", AttributeError)]
)
def test_an_error_ends_the_work_and_reaches_the_parent(item, error):
    with pytest.raises(error):
        dict(run_jobs(work, [item, "a"], 2))


@pytest.mark.parametrize("item", first_of(["hangs", "stops"]))
def test_work_that_is_left_early_ends_its_workers(item):
    outcomes = run_jobs(work, [item, "a"], 2)
    assert next(outcomes) == ("a", "A")
    outcomes.close()  # would outlast the test's time limit if it waited for the item
    assert multiprocessing.active_children() == []


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("threads", first_of([2, 1]))
def test_workers_end_when_their_parent_is_killed(tmp_path, repo, threads):
    (tmp_path / "driver.py").write_text(
        "import os, time\n"
        "from pathlib import Path\n"
        "from alpasim_plugin.runs.local_executor import run_jobs\n"
        "def work(folder):\n"
        "    Path(folder, str(os.getpid())).touch()\n"
        "    time.sleep(60)\n"
        "if __name__ == '__main__':\n"
        f"    list(run_jobs(work, [{str(tmp_path / 'pids')!r}] * 2, 2, {threads}))\n"
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


def leave_a_process(item):
    """Leave a process that sleeps, as the item says, and return its number; with a path, write it
    there and die.
    """
    receiver, sender = os.pipe()
    child = os.fork()
    if child == 0:
        if item.endswith("session"):
            os.setsid()
        if item == "orphan" and os.fork():
            os._exit(0)
        os.write(sender, str(os.getpid()).encode())
        while True:
            time.sleep(3600)
    left = int(os.read(receiver, 32))
    if os.path.isabs(item):
        with Path(item).open("a") as numbers:
            print(left, file=numbers)
        os.kill(os.getpid(), signal.SIGKILL)
    return left


def leave_a_process_or_work(item):
    return leave_a_process(item) if os.path.isabs(item) else work(item)


def is_running(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    return state != "Z"


def is_gone(process):
    until_s = time.monotonic() + 60.0
    while is_running(process) and time.monotonic() < until_s:
        time.sleep(0.02)
    return not is_running(process)


@pytest.mark.skipif(sys.platform != "linux", reason="it finds processes in /proc")
def test_what_a_job_leaves_running_ends_with_its_worker():
    items = ["child", "session", "orphan"]
    left = dict(run_jobs(leave_a_process, items, 1, parts_of=lambda item: "mine.py:Leaves"))
    assert sorted(left) == sorted(items)
    assert all(map(is_gone, left.values()))


def lose_a_worker_beside_others(numbers):
    """Run a job that leaves a process behind as its worker dies, and two others."""
    jobs = ["a", numbers, "b"]  # one worker of the others lives on
    results = dict(run_jobs(leave_a_process_or_work, jobs, 2, limit_s=60.0))
    assert isinstance(results.pop(numbers), Lost)
    assert results == {"a": "A", "b": "B"}


@pytest.mark.skipif(sys.platform != "linux", reason="it finds processes in /proc")
@pytest.mark.parametrize("name", ["numbers", "session"])
def test_what_a_job_leaves_running_ends_with_a_worker_that_dies(tmp_path, name):
    numbers = tmp_path / name
    # A process of its own: where workers were forked with another number of threads before, these
    # would be started anew, and what they leave in a session of its own would have no heir.
    script = (
        f"from tests.runs import test_local as t; t.lose_a_worker_beside_others({str(numbers)!r})"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=280)
    left = [int(line) for line in numbers.read_text().split()]
    assert left
    assert all(map(is_gone, left))


def compile_a_kernel(item):
    """Let Numba make its lock between processes, as it does when it compiles."""
    import numba

    threading.Thread(target=time.sleep, args=(3600,)).start()  # which does not keep the worker
    return numba.get_num_threads()


def test_workers_leave_no_semaphore_to_the_system():
    script = (
        "from tests.runs import test_local as t\n"
        "print(len(list(t.run_jobs(t.compile_a_kernel, [1, 2, 3], 2))))"
    )
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, check=True, timeout=280, capture_output=True, text=True)
    assert done.stdout == "3\n"
    assert "semaphore" not in done.stderr
