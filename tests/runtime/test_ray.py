"""A Ray cluster of several nodes on this machine: the same results as without it, whatever dies.

`pytest -m slow tests/runtime/test_ray.py`, about three minutes: a cluster's start takes most of it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from alpasim_plugin.errors import InfrastructureError
from alpasim_plugin.runtime.executors.base import Resources
from alpasim_plugin.runtime.executors.choice import Executor
from alpasim_plugin.runtime.executors.dispatch import dispatch
from alpasim_plugin.runtime.executors.identity import identity_of
from alpasim_plugin.runtime.executors.placing import Contents
from alpasim_plugin.runtime.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runtime.run import RunResult, execute_run
from alpasim_plugin.runtime.workers import Lost
from scenarios.suite import expand
from tests.runtime.grey_renderer import GREY
from tests.runtime.remote_work import Scripted
from tests.runtime.test_runs import SHORT, Heard, cheap_plan, comparable, plan_of

pytest.importorskip("ray", reason="the extra [ray] is not installed")
pytestmark = pytest.mark.slow

SYSTEM = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500, "health_check_failure_threshold": 4}


def patiently(start: Callable[[], Any]) -> Any:
    """Start a node; Ray gives one 30 s to come up, which a busy machine may exceed."""
    for _ in range(3):
        try:
            return start()
        except Exception as error:
            if "timed out during startup" not in str(error):
                raise
    return start()


class Nodes:
    """A cluster on this machine, a core a node; its raylets can be killed."""

    def __init__(self, number: int) -> None:
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 1, "include_dashboard": False, "_system_config": SYSTEM}
        self.cluster = patiently(lambda: Cluster(initialize_head=True, head_node_args=head))
        for _ in range(number - 1):
            self.add()

    @property
    def address(self) -> str:
        return str(self.cluster.address)

    def add(self, **more: Any) -> Any:
        return patiently(lambda: self.cluster.add_node(num_cpus=1, **more))

    def close(self) -> None:
        self.cluster.shutdown()


@pytest.fixture(scope="module")
def three() -> Iterator[Nodes]:
    nodes = Nodes(3)
    yield nodes
    nodes.close()


def on(nodes: Nodes) -> Executor:
    return Executor("ray", nodes.address)


def run(plan: RunPlan, root: Path, executor: Executor, **more: Any) -> tuple[RunResult, Heard]:
    heard = Heard()
    result = execute_run(plan, root, None, ["simrun"], heard, certificate="none", report=False, executor=executor, **more)
    return result, heard


def scripted(nodes: Nodes, work: Scripted, items: list[str], contents: Contents | None = None, limit_s: float | None = None) -> dict:
    from alpasim_plugin.runtime.executors.ray_pool import RayPool, connected

    with connected(nodes.address):
        pool: RayPool[str] = RayPool(work, contents or Contents(), identity_of(()), (), Resources(), 8, print)
        try:
            return dict(dispatch(pool, items, print, limit_s))
        finally:
            pool.close()


@pytest.fixture(scope="module")
def by_local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("local")
    execute_run(plan_of(scenes=("smoke/straight", "smoke/lead_car")), root, 1, ["simrun"], Heard(), certificate="none", report=False)
    return root


def test_one_and_three_nodes_give_the_run_of_one_process(tmp_path: Path, three: Nodes, by_local: Path) -> None:
    plan = plan_of(scenes=("smoke/straight", "smoke/lead_car"))
    one = Nodes(1)
    try:
        run(plan, tmp_path / "one", on(one))
    finally:
        one.close()
    result, heard = run(plan, tmp_path / "three", on(three))
    assert heard.fates == [("ok", False)] * 4
    assert result.exit_code == 0
    assert comparable(tmp_path / "one") == comparable(tmp_path / "three") == comparable(by_local)


def test_a_second_run_reuses_what_nodes_have_driven_without_them(tmp_path: Path, three: Nodes) -> None:
    run(cheap_plan(), tmp_path, on(three))
    _, heard = run(cheap_plan(), tmp_path, Executor())
    assert heard.fates == [("ok", True)] * 4


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
    raylet = doomed.all_processes["raylet"][0].process.pid
    items = [f"sleep 0.5 #{i}" for i in range(24)]
    from alpasim_plugin.runtime.executors.ray_pool import RayPool, connected

    found = {}
    with connected(three.address):
        pool: RayPool[str] = RayPool(Scripted(tmp_path), Contents(), identity_of(()), (), Resources(), 8, print)
        try:
            for item, got in dispatch(pool, items, print):
                found[item] = got
                if len(found) >= 4 and raylet and any(doomed.node_id[:8] in name for name in pool.nodes()):
                    os.kill(raylet, signal.SIGKILL)
                    raylet = 0
        finally:
            pool.close()
    three.cluster.worker_nodes.discard(doomed)
    assert raylet == 0, "the node was never used"
    assert found == {item: item.upper() for item in items}


def test_a_node_with_another_version_is_refused_by_name(tmp_path: Path, three: Nodes, capsys: pytest.CaptureFixture[str]) -> None:
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
    from alpasim_plugin.runtime.executors.ray_pool import RayPool, connected

    with connected(None):
        pool: RayPool[str] = RayPool(Scripted(tmp_path), Contents(), {**identity_of(()), "scipy": "0.0.1"}, (), Resources(), 8, print)
        with pytest.raises(InfrastructureError, match=r"no node takes the work: .*scipy is .*, the driver has 0\.0\.1"):
            dict(dispatch(pool, ["a"], print))
        pool.close()


def test_stopping_ends_the_workers_and_removes_what_they_left(tmp_path: Path, three: Nodes) -> None:
    from alpasim_plugin.runtime.executors.ray_pool import RayPool, connected

    with connected(three.address):
        pool: RayPool[str] = RayPool(Scripted(tmp_path), Contents(), identity_of(()), (), Resources(), 8, print)
        outcomes = dispatch(pool, ["a", "sleep 100 #1", "sleep 100 #2"], print)
        assert next(outcomes)[0] == "a"
        until = time.monotonic() + 30
        while len(list(tmp_path.iterdir())) < 3 and time.monotonic() < until:
            list(pool.wait(0.1))
            for place in pool.free():
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
from alpasim_plugin.runtime.executors.choice import Executor
from alpasim_plugin.runtime.run import execute_run
from tests.runtime.test_runs import Heard, cheap_plan
execute_run(cheap_plan((0, 1, 2)), Path(sys.argv[1]), None, ["simrun"], Heard(), certificate="none", report=False,
            executor=Executor("ray", sys.argv[2]))
"""


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


def test_a_killed_driver_leaves_no_worker_and_the_same_command_goes_on(tmp_path: Path, three: Nodes, repo: Path) -> None:
    command = [sys.executable, "-c", DRIVER, str(tmp_path / "run"), three.address]
    driver = subprocess.Popen(command, cwd=repo, env={**os.environ, "PYTHONPATH": str(repo)})
    until = time.monotonic() + 200
    while len(list((tmp_path / "run").rglob("manifest.json"))) < 2:
        assert time.monotonic() < until
        time.sleep(0.02)
    workers = serving()
    driver.kill()
    driver.wait()
    assert workers
    until = time.monotonic() + 60
    while serving() & workers:
        assert time.monotonic() < until, "a worker outlives its driver"
        time.sleep(0.1)
    done = len(list((tmp_path / "run").rglob("manifest.json")))
    assert done < 12
    _, heard = run(cheap_plan((0, 1, 2)), tmp_path / "run", on(three))
    assert heard.fates.count(("ok", True)) == done
    assert len(heard.fates) == 12
    run(cheap_plan((0, 1, 2)), tmp_path / "here", Executor())
    assert comparable(tmp_path / "run") == comparable(tmp_path / "here")


KILLER = "tests.runtime.broken_policies:KillsItsProcess"


def test_a_rollout_that_kills_its_workers_fails_alone(tmp_path: Path, three: Nodes) -> None:
    refs = [ref for name in ("smoke/straight", "smoke/lead_car") for ref in expand(name, SHORT)]
    plan = make_plan(refs, (GREY,), ("constant-velocity", KILLER), (0,), RunOptions())
    result, heard = run(plan, tmp_path / "run", on(three))
    assert sorted(heard.fates) == [("failed", False)] * 2 + [("ok", False)] * 2
    assert result.exit_code == 4
    for cell in result.summary["failures"]["cells"]:
        assert cell["policy"] == KILLER
        assert "3 workers died of it" in cell["error"]["found"]


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """Give a file system of 64 KiB, less than a rollout takes."""
    disk = tmp_path / "tiny"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)], check=False, capture_output=True)
    if mounted.returncode:
        pytest.skip("mounting needs root")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


def test_a_node_whose_disk_is_full_is_set_aside(tmp_path: Path, three: Nodes, tiny_disk: Path) -> None:
    full = three.add(env_vars={"SIMRUN_SCRATCH": str(tiny_disk)})
    result, heard = run(cheap_plan((0, 1, 2)), tmp_path / "run", on(three))
    three.cluster.remove_node(full)
    assert heard.fates == [("ok", False)] * 12
    assert result.exit_code == 0
    aside = [text for text in heard.notices if "set aside" in text]
    assert len(aside) == 1
    assert full.node_id[:8] in aside[0]
    assert "No space left on device" in aside[0]
