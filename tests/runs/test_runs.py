"""Whole runs: workers, resume, failures, exit codes. Real parts throughout, on the shortest
scenes.
"""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.cores import usable_cores
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.log.run_folder.schema import slug
from alpasim_plugin.runs.cell import MANIFEST
from alpasim_plugin.runs.execute import thread_budget
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.grey_renderer import GREY
from tests.runs.short_runs import SHORT, Announced, comparable, plan_of


def cheap_plan(seeds=(0,)):
    """Plan four rollouts a seed that render next to nothing: what is reused does not depend on the
    renderer.
    """
    refs = [ref for name in ("smoke/straight", "smoke/lead_car") for ref in expand(name, SHORT)]
    return make_plan(refs, (GREY,), ("constant-velocity", "pure-pursuit"), seeds, RunOptions())


def run(plan, root, workers=1, resume=False):
    announced = Announced()
    return execute_run(plan, root, workers, ["simrun"], announced, resume, report=False), announced


@pytest.mark.slow
def test_one_and_two_workers_give_the_same_run(tmp_path):
    scenes = ("smoke/straight", "smoke/lead_car")
    _, one = run(plan_of(scenes=scenes), tmp_path / "one", workers=1)
    _, two = run(plan_of(scenes=scenes), tmp_path / "two", workers=2)
    assert one.results.count(("ok", False)) == two.results.count(("ok", False)) == 2 * len(scenes)
    assert comparable(tmp_path / "one") == comparable(tmp_path / "two")


def test_the_same_command_reuses_every_finished_rollout_and_runs_the_rest(tmp_path):
    plan = cheap_plan()
    run(plan, tmp_path)
    before = comparable(tmp_path)
    lost = tmp_path / plan.cells[1].folder / MANIFEST
    lost.unlink()  # as after a kill: the log is there, the completion marker is not
    _, announced = run(plan, tmp_path)
    assert sorted(announced.results) == [("ok", False), ("ok", True), ("ok", True), ("ok", True)]
    assert comparable(tmp_path) == before


@pytest.mark.slow
def test_a_folder_with_another_run_is_refused_unless_resumed(tmp_path):
    run(cheap_plan(), tmp_path)
    with pytest.raises(InputError):
        run(cheap_plan((0, 1)), tmp_path)
    result, announced = run(cheap_plan((0, 1)), tmp_path, resume=True)
    assert announced.results.count(("ok", True)) == 4
    assert result.n_rollouts == 8


def test_a_failing_policy_is_the_policys_fault_and_not_driven_again_unasked(tmp_path):
    broken = "tests.runs.broken_policies:ForgetsItsRoute"
    plan = make_plan(
        expand("smoke/straight", SHORT),
        (GREY,),
        ("constant-velocity", broken),
        (0, 1),
        RunOptions(),
    )
    result, _ = run(plan, tmp_path)
    assert (result.n_rollouts, result.n_failed, result.exit_code) == (4, 2, 2)
    assert result.summary.failures.by_class == {"policy": 2}
    rows = pq.read_table(tmp_path / "rollouts.parquet").to_pylist()
    assert {row["failure_class"] for row in rows if row["policy"] == broken} == {"policy"}
    assert all(row["collision_any"] is None for row in rows if row["policy"] == broken)
    _, announced = run(plan, tmp_path)
    assert sorted(announced.results) == [
        ("failed", True),
        ("failed", True),
        ("ok", True),
        ("ok", True),
    ]
    kept = [line for line in announced.notices if "failed before" in line]
    assert len(kept) == 2
    assert all("broken_policies.py" in line for line in kept)


def test_a_failure_that_may_come_from_the_world_outside_is_driven_again(tmp_path):
    broken = "tests.runs.broken_policies:Raises"  # ValueError: of a file, as likely as of its code
    plan = make_plan(expand("smoke/straight", SHORT), (GREY,), (broken,), (0,), RunOptions())
    for _ in range(2):
        _, announced = run(plan, tmp_path)
        assert announced.results == [("failed", False)]


def test_a_policy_without_its_file_is_tried_again(tmp_path):
    plan = make_plan(
        expand("smoke/straight", SHORT),
        (GREY,),
        ("tests.runs.broken_policies:MissesItsWeights",),
        (0,),
        RunOptions(),
    )
    for _ in range(2):  # the file may be there the second time: nothing of the first is kept
        with pytest.raises(PolicyError):
            run(plan, tmp_path)


@pytest.mark.slow
def test_a_killed_run_loses_no_finished_rollout(tmp_path):
    words = "--renderer clean --policy lane-camera --seeds 3 --workers 1 --no-report"
    command = [sys.executable, "-m", "alpasim_plugin.cli.main", "smoke/straight", *words.split()]
    command += ["--set", SHORT[0], "--out"]
    killed = tmp_path / "killed"
    whole = tmp_path / "whole"
    process = subprocess.Popen(
        [*command, str(killed)],
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    give_up = time.monotonic() + 90
    while not list(killed.rglob(MANIFEST)) and time.monotonic() < give_up:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    done = {path: path.stat().st_mtime_ns for path in killed.rglob(MANIFEST)}
    assert 1 <= len(done) < 3
    again = subprocess.run([*command, str(killed)], capture_output=True, text=True, check=True)
    assert again.stderr.count("(reused)") == len(done)
    assert {path: path.stat().st_mtime_ns for path in done} == done
    subprocess.run([*command, str(whole)], capture_output=True, check=True)
    assert comparable(killed) == comparable(whole)


@pytest.mark.slow
def test_a_full_disk_fails_the_rollout_and_keeps_the_finished_ones(tmp_path):
    """A file-size limit stands in for a full disk: the system refuses the same writes with an error
    of the same kind.
    """
    code = (
        "import resource, sys\n"
        "from alpasim_plugin.cli.main import run_command\n"
        "limit = int(sys.argv[1])\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))\n"
        "sys.exit(run_command(sys.argv[2:]))\n"
    )
    common = [
        "--renderer",
        "clean",
        "--policy",
        "lane-camera",
        "--workers",
        "1",
        "--set",
        SHORT[0],
        "--resume",
    ]
    common += ["--out", str(tmp_path)]
    base = [sys.executable, "-c", code]
    fine = subprocess.run(
        [*base, str(10**9), "--seeds", "0,1", *common, "smoke/straight"],
        capture_output=True,
        text=True,
    )
    assert fine.returncode == 0, fine.stderr
    kept = {p: p.read_bytes() for p in tmp_path.rglob("rollout.asl")}
    full = subprocess.run(
        [*base, "20000", "--seeds", "0,1,2", *common, "smoke/straight"],
        capture_output=True,
        text=True,
    )
    assert full.returncode == 4, full.stderr
    assert "free disk space" in full.stderr or "File too large" in full.stderr
    assert {p: p.read_bytes() for p in kept} == kept


def test_workers_times_threads_never_exceed_the_cores():
    cores = usable_cores()
    for wanted in (None, 1, 2, 3, 64):
        for cells in (0, 1, 2, 1000):
            budget = thread_budget(wanted, cells)
            assert budget.workers >= 1
            assert budget.per_worker >= 1
            assert wanted is not None or budget.workers * budget.per_worker <= max(cores, 1)


@pytest.mark.slow
def test_what_two_suites_list_is_driven_once_and_another_scenario_of_its_id_is_refused():
    refs = [*expand("suites/smoke"), *expand("suites/hard")]  # both list hard/hard_brake
    plan = make_plan(refs, ("clean",), ("log-replay",), (0,), RunOptions())
    assert len(refs) == len(plan.cells) + 1
    refs = [
        *expand("smoke/straight"),
        replace(expand("smoke/straight")[0], overrides=("timing.duration_us=2000000",)),
    ]
    with pytest.raises(InputError):
        make_plan(refs, ("clean",), ("log-replay",), (0,), RunOptions())


def test_names_become_safe_folders_that_never_collide():
    assert slug("onefixer@1") == "onefixer@1"
    assert slug("../../etc").startswith("etc-")
    assert len({slug(name) for name in ("a/b", "a-b", "a:b", "a b", "", "-")}) == 6
    assert len(slug("x" * 300)) < 100
    assert slug("x" * 300) != slug("x" * 299)
