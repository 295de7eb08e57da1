"""A Ray cluster on this machine: the same results as without it, and a node that differs is refused.

`pytest -m slow tests/runs/test_ray.py`: a cluster's start takes most of the time.
"""

import os
import pickle
import socket
import subprocess
import sys

import pytest

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.runs import ray_executor as ray_backend
from alpasim_plugin.runs.executor_choice import Executor, parse_executor
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.grey_renderer import GREY
from tests.runs.short_runs import SHORT, Announced, comparable, plan_of

QUICK = ("--renderer", "clean", "--policy", "constant-velocity", "--no-report")
KILLER = "tests.runs.broken_policies:KillsItsProcess"


@pytest.fixture(scope="module")
def cluster(repo):
    pytest.importorskip("ray", reason="the extra [ray] is not installed")
    with pytest.MonkeyPatch.context() as patch:
        # nodes import nothing from the working directory
        patch.setenv("PYTHONPATH", os.pathsep.join([os.environ.get("PYTHONPATH", ""), str(repo)]))
        with ray_backend.connected(""):
            yield


def drive(plan, root, executor):
    announced = Announced()
    run = execute_run(plan, root, 2, ["simrun"], announced, report=False, executor=executor)
    return run, announced


@pytest.mark.slow
def test_a_cluster_gives_the_run_of_one_process(tmp_path, cluster):
    plan = plan_of(scenes=("smoke/straight", "smoke/lead_car"))
    drive(plan, tmp_path / "local", Executor())
    result, announced = drive(plan, tmp_path / "ray", Executor("ray"))
    assert announced.results == [("ok", False)] * 4
    assert result.exit_code == 0
    assert comparable(tmp_path / "ray") == comparable(tmp_path / "local")


@pytest.mark.slow
def test_a_rollout_that_kills_its_workers_is_lost_alone(tmp_path, cluster):
    """A run checks the policy here first, and does not drive it."""
    refs = expand("smoke/straight", SHORT)
    plan = make_plan(refs, (GREY,), ("constant-velocity", KILLER), (0,), RunOptions())
    cells = plan.cells
    results = ray_backend.run_on_ray(plan, cells, tmp_path, Executor("ray"), 2, None)
    by_policy = {cell.policy.name: result for cell, result in results}
    assert by_policy["constant-velocity"].status == "ok"
    assert "3 workers died" in by_policy[KILLER].reason


@pytest.mark.slow
def test_more_than_any_node_has_is_an_error(tmp_path, cluster):
    with pytest.raises(InfrastructureError):
        drive(plan_of(), tmp_path, Executor("ray", cores=4096))


def job_of(plan):
    """Return what a node is given: the first rollout, its scene, the names of the parts."""
    cell = plan.cells[0]
    names = ray_backend.names_of(plan.parts)
    return pickle.dumps((cell, plan.options, 1, None)), plan.scenarios[cell.scene], names


def test_a_node_that_differs_drives_nothing(tmp_path):
    plan = plan_of()
    job, scenario, names = job_of(plan)
    expected = ray_backend.identity_of(*names)
    wrong = {**expected, "numpy": "0.0.1"}
    refused = ray_backend.drive_on_node(job, scenario, names, wrong)
    assert isinstance(refused, InfrastructureError)
    driven = ray_backend.drive_on_node(job, scenario, names, expected)
    assert isinstance(driven, ray_backend.DrivenRollout)
    assert ray_backend.write_rollout(driven, tmp_path).status == "ok"
    assert (tmp_path / plan.cells[0].folder / "rollout.asl").is_file()


USERS = """
from pathlib import Path
from policies.simple import ConstantVelocity

class Mine(ConstantVelocity):
    files = (Path(__file__).with_name("weights.bin"),)
"""


def test_a_node_without_a_policys_file_is_named_and_so_is_one_with_other_weights(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(USERS)
    weights = tmp_path / "weights.bin"
    weights.write_bytes(b"first")
    plan = plan_of((f"{file}:Mine",))
    job, scenario, names = job_of(plan)
    expected = ray_backend.identity_of(*names)
    assert ray_backend.identity_of(*names) == expected
    weights.write_bytes(b"trained again")
    retrained = ray_backend.identity_of(*names)
    assert ray_backend.differences_of(expected, retrained) != []
    assert ray_backend.differences_of(retrained, ray_backend.identity_of(*names)) == []
    file.unlink()
    weights.unlink()
    refused = ray_backend.drive_on_node(job, scenario, names, expected)
    assert isinstance(refused, InfrastructureError)
    assert f"node {socket.gethostname()} differs" in refused.message
    assert f"code of {file}:Mine is not there" in refused.message
    assert f"{weights} is not there" in refused.message


@pytest.mark.parametrize("address", ["127.0.0.1:1", "[::1]:1", "ray://127.0.0.1:1"])
def test_a_cluster_at_which_nobody_listens_is_refused_at_once(address):
    with pytest.raises(OSError, match=r"refused|assign"):
        ray_backend.require_listening(address)


@pytest.mark.parametrize("address", ["", "auto", "local"])
def test_what_ray_looks_up_itself_is_left_to_it(address):
    ray_backend.require_listening(address)


def test_a_dead_cluster_of_the_environment_fails_and_nothing_is_driven_here(tmp_path):
    """In a process of its own: one that is connected to a cluster stays with it."""
    pytest.importorskip("ray", reason="the extra [ray] is not installed")
    words = [sys.executable, "-m", "alpasim_plugin.cli.main", "--executor", "ray", *QUICK]
    environment = os.environ | {"RAY_ADDRESS": "127.0.0.1:1"}
    done = subprocess.run(
        [*words, "--out", str(tmp_path), "smoke/straight"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 4
    assert "127.0.0.1:1" in done.stderr
    assert list(tmp_path.rglob("rollout.asl")) == []


@pytest.mark.parametrize(
    "text", ["slurm", "local?cores=2", "ray://head:1", "ray?cores=0", "ray?disks=1", "ray?gpus=x"]
)
def test_an_executor_that_does_not_exist_is_refused(text):
    with pytest.raises(InputError):
        parse_executor(text)
