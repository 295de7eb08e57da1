"""A Ray cluster on this machine: the same results as without it, and a node that differs is refused.

`pytest -m slow tests/runs/test_ray.py`: a cluster's start takes most of the time.
"""

import os

import pytest

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.runs import ray_executor as ray_backend
from alpasim_plugin.runs.executor_choice import Executor, parse_executor
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.grey_renderer import GREY
from tests.runs.short_runs import SHORT, Announced, comparable, plan_of

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
def test_a_rollout_that_kills_its_workers_fails_alone(tmp_path, cluster):
    refs = expand("smoke/straight", SHORT)
    plan = make_plan(refs, (GREY,), ("constant-velocity", KILLER), (0,), RunOptions())
    result, announced = drive(plan, tmp_path, Executor("ray"))
    assert sorted(announced.results) == [("failed", False), ("ok", False)]
    assert result.exit_code == 4


@pytest.mark.slow
def test_more_than_any_node_has_is_an_error(tmp_path, cluster):
    with pytest.raises(InfrastructureError):
        drive(plan_of(), tmp_path, Executor("ray", cores=4096))


def test_a_node_that_differs_drives_nothing(tmp_path):
    plan = plan_of()
    cell = plan.cells[0]
    scenario = plan.scenarios[cell.scene]
    expected = ray_backend.identity_of(plan.parts)
    wrong = {**expected, "numpy": "0.0.1"}
    refused = ray_backend.drive_on_node(cell, plan.options, 1, scenario, plan.parts, wrong, None)
    assert isinstance(refused, InfrastructureError)
    driven = ray_backend.drive_on_node(cell, plan.options, 1, scenario, plan.parts, expected, None)
    assert isinstance(driven, ray_backend.DrivenRollout)
    assert ray_backend.write_rollout(driven, tmp_path)["status"] == "ok"
    assert (tmp_path / cell.folder / "rollout.asl").is_file()


@pytest.mark.parametrize(
    "text", ["slurm", "local?cores=2", "ray://head:1", "ray?cores=0", "ray?disks=1", "ray?gpus=x"]
)
def test_an_executor_that_does_not_exist_is_refused(text):
    with pytest.raises(InputError):
        parse_executor(text)
