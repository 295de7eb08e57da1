"""A Ray cluster of several nodes on this machine: the same results as without it, whatever dies.

`pytest -m slow tests/runs/test_ray.py`, about three minutes: a cluster's start takes most of it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.runs.executors.assignment import Contents, identity_of
from alpasim_plugin.runs.executors.base import Lost, Resources
from alpasim_plugin.runs.executors.choice import Executor
from alpasim_plugin.runs.executors.pool import run_jobs
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.cluster_nodes import Nodes, on
from tests.runs.grey_renderer import GREY
from tests.runs.on_ray import pool_on, run, scripted
from tests.runs.remote_work import Scripted
from tests.runs.test_runs import SHORT, Announced, cheap_plan, comparable, plan_of

pytest.importorskip("ray", reason="the extra [ray] is not installed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1200),
]  # most of the time goes by while processes start

GIB = 2**30
PATIENCE_S = 30.0  # for workers that do start, on a busy machine


def serving() -> set[int]:
    """Return the processes that are workers of ours."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if b"ray::Serving" in path.read_bytes():
                found.add(int(path.parent.name))
        except OSError:
            continue
    return found


def wait_until(done: Callable[[], bool], otherwise: str, limit_s: float = 60.0) -> None:
    until = time.monotonic() + limit_s
    while not done():
        assert time.monotonic() < until, otherwise
        time.sleep(0.1)


@pytest.fixture(scope="module")
def three() -> Iterator[Nodes]:
    nodes = Nodes(3)
    yield nodes
    nodes.close()


@pytest.fixture(scope="module")
def by_local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("local")
    execute_run(
        plan_of(scenes=("smoke/straight", "smoke/lead_car")),
        root,
        1,
        ["simrun"],
        Announced(),
        certificate="none",
        report=False,
    )
    return root


def test_one_and_three_nodes_give_the_run_of_one_process(
    tmp_path: Path, three: Nodes, by_local: Path
) -> None:
    plan = plan_of(scenes=("smoke/straight", "smoke/lead_car"))
    one = Nodes(1)
    try:
        run(plan, tmp_path / "one", on(one))
    finally:
        one.close()
    result, announced = run(plan, tmp_path / "three", on(three))
    assert announced.results == [("ok", False)] * 4
    assert result.exit_code == 0
    assert comparable(tmp_path / "one") == comparable(tmp_path / "three") == comparable(by_local)


def test_a_second_run_reuses_what_nodes_have_driven_without_them(
    tmp_path: Path, three: Nodes
) -> None:
    run(cheap_plan(), tmp_path, on(three))
    _, announced = run(cheap_plan(), tmp_path, Executor())
    assert announced.results == [("ok", True)] * 4


def test_every_item_has_a_result_though_workers_die(tmp_path: Path, three: Nodes) -> None:
    contents = Contents()
    sha256 = contents.add_bytes(bytes(3_000_000))
    items = ["a", "die", "die once", f"fetch {sha256}", *[f"sleep 0.05 #{i}" for i in range(40)]]
    found = scripted(three, Scripted(tmp_path), items, contents)
    lost = found.pop("die")
    assert isinstance(lost, Lost)
    assert "3 workers died of it" in lost.found
    assert found[f"fetch {sha256}"] == 3_000_000
    assert {item: got for item, got in found.items() if not item.startswith("fetch")} == {
        i: i.upper() for i in items if i[:3] not in ("fet", "die") or " once" in i
    }
    assert len({note.read_text() for note in tmp_path.iterdir()}) == 3


def test_an_item_that_hangs_is_ended_at_the_limit(tmp_path: Path, three: Nodes) -> None:
    found = scripted(three, Scripted(tmp_path), ["sleep 60", "a", "b"], limit_s=2.0)
    assert found.pop("sleep 60").hung
    assert found == {"a": "A", "b": "B"}


def test_a_raylet_that_is_killed_loses_nothing(tmp_path: Path, three: Nodes) -> None:
    doomed = three.add()
    process = doomed.all_processes["raylet"][0].process
    raylet = process.pid
    items = [f"sleep 0.5 #{i}" for i in range(24)]
    found = {}
    with pool_on(three, Scripted(tmp_path)) as pool:
        for item, got in run_jobs(pool, items, print):
            found[item] = got
            if (
                len(found) >= 4
                and raylet
                and any(doomed.node_id[:8] in name for name in pool.nodes())
            ):
                os.kill(raylet, signal.SIGKILL)
                # a worker of Ray ends when its raylet's process is gone, which one that nobody
                # waited for is not
                process.wait()
                raylet = 0
    three.cluster.worker_nodes.discard(doomed)
    assert raylet == 0, "the node was never used"
    assert found == {item: item.upper() for item in items}
    wait_until(lambda: not serving(), "a worker outlives its node")


def test_a_node_with_another_version_is_refused_by_name(
    tmp_path: Path, three: Nodes, capsys: pytest.CaptureFixture[str]
) -> None:
    fake = tmp_path / "site" / "scipy-0.0.1.dist-info"
    fake.mkdir(parents=True)
    (fake / "METADATA").write_text("Metadata-Version: 2.1\nName: scipy\nVersion: 0.0.1\n")
    other = three.add(env_vars={"PYTHONPATH": f"{fake.parent}:{os.environ.get('PYTHONPATH', '')}"})
    (tmp_path / "notes").mkdir()
    found = scripted(three, Scripted(tmp_path / "notes"), [f"sleep 0.3 #{i}" for i in range(30)])
    three.cluster.remove_node(other)
    assert len(found) == 30
    said = capsys.readouterr().out
    assert f"/{other.node_id[:8]} is set aside: scipy is 0.0.1, the driver has" in said
    assert all(other.node_id[:8] not in note.read_text() for note in (tmp_path / "notes").iterdir())


def test_no_node_of_the_right_version_is_an_error_that_names_it(tmp_path: Path) -> None:
    with (
        pool_on(None, Scripted(tmp_path), expected={**identity_of(()), "scipy": "0.0.1"}) as pool,
        pytest.raises(
            InfrastructureError,
            match=r"no node takes the work: .*scipy is .*, the driver has 0\.0\.1",
        ),
    ):
        dict(run_jobs(pool, ["a"], print))


def test_a_straggler_is_done_again_on_another_node(tmp_path: Path, three: Nodes) -> None:
    items = ["late 3000", *[f"sleep 0.2 #{i}" for i in range(20)]]
    found = scripted(three, Scripted(tmp_path), items)
    assert found == {item: item.upper() for item in items}
    first, second = (note.read_text().split()[0] for note in tmp_path.glob("late*"))
    assert first != second


def test_workers_go_where_what_they_declare_is(tmp_path: Path, three: Nodes) -> None:
    large = three.add(num_cpus=4, num_gpus=1, memory=3 * GIB)
    for resources, workers in (
        (Resources(1, gpus=0.5), 2),
        (Resources(1, memory_gib=1.0, gpus=0.1), 3),
        (Resources(2), 2),
    ):
        with pool_on(three, Scripted(tmp_path), resources=resources) as pool:
            until = time.monotonic() + 120
            while len(pool.free(workers)) < workers:
                assert time.monotonic() < until, resources
                pool.wait(0.2)
            seen_until = time.monotonic() + 5
            while time.monotonic() < seen_until:
                assert len(places := pool.free(workers)) == workers, resources
                pool.wait(0.5)
            assert all(large.node_id[:8] in place.node for place in places), resources
            assert len(pool.nodes()) == 1
    three.cluster.remove_node(large)


def test_more_than_any_node_has_is_an_error_that_says_so(tmp_path: Path, three: Nodes) -> None:
    with (
        pool_on(three, Scripted(tmp_path), resources=Resources(64)) as pool,
        pytest.raises(InfrastructureError) as caught,
    ):
        dict(run_jobs(pool, ["a"], print))
    assert "cores=64" in caught.value.message
    assert "no node has that much" in caught.value.message


HANGING = """
import sys, time
if any(word.endswith("default_worker.py") for word in sys.orig_argv):
    time.sleep(3600)
"""


def test_a_node_that_starts_no_process_is_set_aside_and_others_do_its_work(
    tmp_path: Path, three: Nodes, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(HANGING)
    stuck = three.add(
        num_cpus=2,
        env_vars={"PYTHONPATH": f"{tmp_path / 'site'}:{os.environ.get('PYTHONPATH', '')}"},
    )
    (tmp_path / "notes").mkdir()
    items = [f"sleep 0.5 #{i}" for i in range(12)]
    with pool_on(three, Scripted(tmp_path / "notes"), start_s=PATIENCE_S) as pool:
        assert dict(run_jobs(pool, items, print)) == {item: item.upper() for item in items}
        said, until = "", time.monotonic() + 10 * PATIENCE_S
        while " is set aside: " not in said:
            assert time.monotonic() < until, said
            pool.free(8)
            pool.wait(0.5)
            said += capsys.readouterr().out
        assert len(pool.nodes()) == 3
    three.cluster.remove_node(stuck)
    aside = [line for line in said.splitlines() if "set aside" in line]
    assert len(aside) == 1
    assert (
        f"/{stuck.node_id[:8]} is set aside: no process has started there within {PATIENCE_S:g} s"
        in aside[0]
    )


def test_an_only_node_whose_worker_is_never_ready_is_an_error_that_names_it(tmp_path: Path) -> None:
    versions = tmp_path / "site" / "scipy-0.0.1.dist-info"
    versions.mkdir(parents=True)
    os.mkfifo(
        versions / "METADATA"
    )  # reading it never ends, as on a file system that does not answer
    one = Nodes(
        1, env_vars={"PYTHONPATH": f"{tmp_path / 'site'}:{os.environ.get('PYTHONPATH', '')}"}
    )
    head = str(one.cluster.head_node.node_id)
    try:
        with (
            pool_on(one, Scripted(tmp_path), start_s=PATIENCE_S) as pool,
            pytest.raises(InfrastructureError) as caught,
        ):
            dict(run_jobs(pool, ["a"], print))
    finally:
        one.close()
    assert (
        f"/{head[:8]}: its worker has started, but was not ready within {PATIENCE_S:g} s"
        in caught.value.message
    )
    assert "file systems of these nodes" in caught.value.hint


def test_a_node_whose_core_another_driver_holds_is_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import ray

    one = Nodes(1)
    try:
        with pool_on(one, Scripted(tmp_path), start_s=PATIENCE_S) as pool:
            holder = ray.remote(num_cpus=1)(Holder).remote()
            ray.get(holder.held.remote())
            began, said = time.monotonic(), ""
            while time.monotonic() < began + 2.5 * PATIENCE_S:
                assert not pool.free(8)
                pool.wait(0.5)
                said += capsys.readouterr().out
            assert "others may hold its cores" in said
            assert " is set aside" not in said
            ray.kill(holder)
            assert dict(run_jobs(pool, ["a"], print)) == {"a": "A"}
    finally:
        one.close()


class Holder:
    """Another driver's worker."""

    def held(self) -> None:
        """Answer."""


def test_stopping_ends_the_workers_and_removes_what_they_left(tmp_path: Path, three: Nodes) -> None:
    with pool_on(three, Scripted(tmp_path)) as pool:
        outcomes = run_jobs(pool, ["a", "sleep 100 #1", "sleep 100 #2"], print)
        assert next(outcomes)[0] == "a"
        until = time.monotonic() + 30
        while len(list(tmp_path.iterdir())) < 3 and time.monotonic() < until:
            list(pool.wait(0.1))
            for place in pool.free(8):
                pool.start(place.worker, ["sleep 100 #2"])
        pool.close()
        pids = [int(note.name.split(".")[-2]) for note in tmp_path.iterdir()]
        until = time.monotonic() + 10
        while any(Path("/proc", str(pid)).exists() for pid in pids):
            assert time.monotonic() < until, "a worker outlives the run"
            time.sleep(0.05)


DRIVER = """
import sys
from pathlib import Path
from alpasim_plugin.runs.executors.choice import Executor
from alpasim_plugin.runs.run import execute_run
from tests.runs.test_runs import Announced, cheap_plan
execute_run(cheap_plan((0, 1, 2)), Path(sys.argv[1]), None, ["simrun"], Announced(), certificate="none", report=False,
            executor=Executor("ray", sys.argv[2]))
"""


def test_a_killed_driver_leaves_no_worker_and_the_same_command_goes_on(
    tmp_path: Path, three: Nodes, repo: Path
) -> None:
    command = [sys.executable, "-c", DRIVER, str(tmp_path / "run"), three.address]
    driver = subprocess.Popen(command, cwd=repo, env={**os.environ, "PYTHONPATH": str(repo)})
    until = time.monotonic() + 200
    while len(list((tmp_path / "run").rglob("manifest.json"))) < 2:
        assert time.monotonic() < until
        time.sleep(0.02)
    assert serving()
    driver.kill()
    driver.wait()
    wait_until(lambda: not serving(), "a worker outlives its driver")
    done = len(list((tmp_path / "run").rglob("manifest.json")))
    assert done < 12
    _, announced = run(cheap_plan((0, 1, 2)), tmp_path / "run", on(three))
    assert announced.results.count(("ok", True)) == done
    assert len(announced.results) == 12
    run(cheap_plan((0, 1, 2)), tmp_path / "here", Executor())
    assert comparable(tmp_path / "run") == comparable(tmp_path / "here")


KILLER = "tests.runs.broken_policies:KillsItsProcess"


def test_a_rollout_that_kills_its_workers_fails_alone(tmp_path: Path, three: Nodes) -> None:
    refs = [ref for name in ("smoke/straight", "smoke/lead_car") for ref in expand(name, SHORT)]
    plan = make_plan(refs, (GREY,), ("constant-velocity", KILLER), (0,), RunOptions())
    result, announced = run(plan, tmp_path / "run", on(three))
    assert sorted(announced.results) == [("failed", False)] * 2 + [("ok", False)] * 2
    assert result.exit_code == 4
    for cell in result.summary["failures"]["cells"]:
        assert cell["policy"] == KILLER
        assert "3 workers died of it" in cell["error"]["message"]


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """Give a file system of 64 KiB, less than a rollout takes."""
    disk = tmp_path / "tiny"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)],
        check=False,
        capture_output=True,
    )
    if mounted.returncode:
        pytest.skip(f"cannot mount a tiny disk: {mounted.stderr.decode().strip()}")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


def test_a_node_whose_disk_is_full_is_set_aside(
    tmp_path: Path, three: Nodes, tiny_disk: Path
) -> None:
    full = three.add(env_vars={"SIMRUN_SCRATCH": str(tiny_disk)})
    result, announced = run(cheap_plan((0, 1, 2)), tmp_path / "run", on(three))
    three.cluster.remove_node(full)
    assert announced.results == [("ok", False)] * 12
    assert result.exit_code == 0
    aside = [text for text in announced.notices if "set aside" in text]
    assert len(aside) == 1
    assert full.node_id[:8] in aside[0]
    assert "No space left on device" in aside[0]
