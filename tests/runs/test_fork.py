"""Going back into a logged rollout and continuing it."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.core.types import SensorSpec
from alpasim_plugin.log import read_asl, read_facts, write_facts
from alpasim_plugin.log.run_folder.manifests import read_run_json, write_run_json
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.runs.fork import Change, fork_rollout, merge_sensors
from alpasim_plugin.runs.logged_rollout import find_rollout
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.repeat import log_trace
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.examples import first_of
from tests.runs.short_runs import Announced

BARE = ("environment.buildings=0", "environment.trees_per_100m=0", "environment.poles_spacing_m=0")
SHORT = (
    "timing.duration_us=1200000",
    "timing.warmup_us=200000",
    "degradation.kind=none",
    *BARE,
)
CELL = "clean/lane-camera/smoke-lead_car/0"
AT_US = 600_000


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Make a run of a scene with a reactive car ahead behind two renderers, one of which makes the
    policy lose its lane.
    """
    folder = tmp_path_factory.mktemp("run")
    plan = make_plan(
        expand("smoke/lead_car", SHORT),
        ("clean", "broken-frozen"),
        ("lane-camera",),
        (0,),
        RunOptions(),
    )
    execute_run(plan, folder, 1, ["simrun"], Announced(), report=False)
    return folder


@pytest.fixture(scope="module")
def past(root):
    return find_rollout(root, CELL)


@pytest.fixture(scope="module")
def changed(past, tmp_path_factory):
    """Continue behind the frozen renderer."""
    folder = tmp_path_factory.mktemp("changed")
    go(past, folder, renderer="broken-frozen")
    return folder


def go(past, root, **change):
    return fork_rollout(past, Change(AT_US, **change), root, ["simrun", "fork"])  # type: ignore[arg-type]


def forked(root):
    return next(path.parent for path in root.rglob("manifest.json") if "fork" in read_json(path))


@pytest.mark.parametrize("renderer", first_of(["clean", "broken-frozen"]))
def test_a_part_that_is_named_again_continues_with_its_history(root, tmp_path, renderer):
    past = find_rollout(root, CELL.replace("clean", renderer))
    go(past, tmp_path, renderer=renderer)
    assert read_json(tmp_path / "run.json")["fork"]["of"] == past.name
    assert log_trace(past.folder) == log_trace(forked(tmp_path))


@pytest.mark.parametrize(
    "change", [{}, pytest.param({"policy": "pure-pursuit", "seed": 5}, marks=pytest.mark.slow)]
)
def test_a_change_takes_effect_at_its_instant_and_not_before(past, changed, tmp_path, change):
    if change:
        go(past, tmp_path, **change)
    one, other = (
        read_asl(folder / "rollout.asl")
        for folder in (past.folder, forked(tmp_path if change else changed))
    )
    at_us = past.scenario.start_us + AT_US
    plans = {plan.now_us: plan.trajectory.xyz for plan in other.plans}
    same = {
        plan.now_us: np.array_equal(plan.trajectory.xyz, plans[plan.now_us]) for plan in one.plans
    }
    assert all(equal for t_us, equal in same.items() if t_us < at_us)
    assert not any(equal for t_us, equal in same.items() if t_us > at_us)
    before = one.ego.t_us <= at_us
    np.testing.assert_array_equal(one.ego.xyz[before], other.ego.xyz[before])
    assert not np.array_equal(one.ego.xyz[~before], other.ego.xyz[~before])


def test_the_run_folder_pairs_the_continuation_with_the_original(past, changed):
    rows = pq.read_table(changed / "rollouts.parquet").to_pylist()
    assert [row["renderer"] for row in rows] == ["clean", "broken-frozen from 0.6 s"]
    here, there = (read_json(folder / "summary.json") for folder in (changed, past.root))
    assert here["paired"]["broken-frozen from 0.6 s"]["route_distance_m"]["n_cells"] == 1
    mean = here["metrics"]["clean"]["route_distance_m"]["mean"]
    assert mean == there["metrics"]["clean"]["route_distance_m"]["mean"]
    assert "broken-frozen from 0.6 s" in (changed / "report.html").read_text()


def test_a_replay_that_leaves_the_log_names_component_and_step(past, tmp_path):
    copy = tmp_path / "copy" / past.manifest.path
    copy.mkdir(parents=True)
    for file in past.folder.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    facts = read_facts(copy / "frames.jsonl")
    facts[3]["rgb_sha256"] = "0" * 16
    write_facts(copy / "frames.jsonl", facts)
    moved = replace(past, root=tmp_path / "copy")
    with pytest.raises(InfrastructureError, match="frames at step 3, camera front"):
        go(moved, tmp_path / "out", renderer="clean")
    assert not (tmp_path / "out" / "run.json").exists()


@pytest.mark.slow
def test_a_policy_that_ends_its_process_after_the_change_is_named(past, tmp_path):
    result = go(
        past, tmp_path, policy=f"{Path(__file__).with_name('bad_parts.py')}:policy_end_process"
    )
    assert result.exit_code == 2
    (failed,) = result.summary.failures.cells
    assert failed.error.failure_class == "policy"
    assert "bad_parts.py:" in failed.error.message


def test_a_new_policy_keeps_the_controller_that_its_run_named(past):
    named = replace(past.cell, controller=resolve("controller", "perfect"))
    change = Change(AT_US, policy="pure-pursuit")
    assert change.apply(named, RunOptions(controller="perfect")).controller.name == "perfect"
    assert change.apply(named, RunOptions()).controller.name == "bicycle"


def test_instants_outside_and_folders_in_use_are_refused(past, root, tmp_path):
    for after_us in (-1, 1_200_000, 10**12):
        with pytest.raises(InputError, match=r"the rollout lasts 1\.2 s"):
            fork_rollout(past, Change(after_us, "clean"), tmp_path, [])
    with pytest.raises(InputError, match="it holds a run already"):
        fork_rollout(past, Change(AT_US, "clean"), root, [])
    with pytest.raises(InputError):
        fork_rollout(past, Change(AT_US), tmp_path, [])


def test_rollouts_are_found_by_name_or_folder_and_near_names_are_offered(root, past):
    assert find_rollout(root, past.manifest.path).cell == past.cell
    with pytest.raises(InputError, match="no such rollout among its 2") as caught:
        find_rollout(root, "claen/lane-camera/smoke-lead_car/0")
    assert CELL in caught.value.hint


def test_a_scenario_that_has_changed_is_refused(root, tmp_path):
    info = read_run_json(root)
    scene = info.scenes["smoke-lead_car"]
    _, *overrides = scene.ref.overrides
    ref = replace(scene.ref, overrides=("timing.duration_us=1100000", *overrides))
    info = replace(info, scenes={"smoke-lead_car": replace(scene, ref=ref)})
    changed = shutil.copytree(root, tmp_path / "run")
    (changed / "files.json").unlink()  # else run.json is damaged
    write_run_json(changed, info)
    with pytest.raises(InputError, match="has changed since the log was written"):
        find_rollout(changed, CELL)


def test_two_policies_share_a_camera_at_the_shorter_period(straight_road):
    first = (SensorSpec("front", 200_000), SensorSpec("left", 200_000))
    then = (SensorSpec("front", 100_000), SensorSpec("left"), SensorSpec("rear"))
    assert merge_sensors(first, then, straight_road) == (
        SensorSpec("front", 100_000),
        SensorSpec("left"),
        SensorSpec("rear"),
    )
    between_plans = (SensorSpec("front", 50_000),)
    with pytest.raises(InputError, match="sees it every 200000 us, the new one every 50000 us"):
        merge_sensors(first, between_plans, straight_road)
