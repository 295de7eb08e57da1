"""Whole runs with fixers: any number of workers, resume, and what every table says of an untrained
fixer.
"""

import json
import os
import shutil

import pyarrow.parquet as pq
import pytest

from alpasim_plugin.log import read_asl
from alpasim_plugin.runs.cell import MANIFEST
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.short_runs import Announced, comparable

pytestmark = pytest.mark.slow

SMALL_NET = (
    "weights.bundle=null",
    "dit.width=32",
    "dit.blocks=1",
    "dit.head_width=16",
    "dit.mlp_width=32",
    "untrained=random",
)
SCENE = ("timing.duration_us=1500000", "cameras=[{name: front, width: 96, height: 64}]")


def plan_of(fixer=SMALL_NET):
    refs = expand("smoke/straight", SCENE)
    return make_plan(
        refs, ("clean", "onefixer-dit-tiny+clean"), ("lane-camera",), (0,), RunOptions(fixer=fixer)
    )


def run(plan, root, workers=1, resume=False, report=False):
    announced = Announced()
    execute_run(plan, root, workers, ["simrun"], announced, resume, "none", report)
    return announced.results


@pytest.fixture(scope="module", autouse=True)
def _one_core():
    """Keep runs of one worker at one thread: two wait for each other on a busy machine."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    yield
    os.sched_setaffinity(0, before)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Give a finished run of one worker."""
    root = tmp_path_factory.mktemp("run")
    run(plan_of(), root, report=True)
    return root


@pytest.mark.slow
def test_the_same_command_continues_and_another_setting_does_not_reuse(finished, tmp_path):
    plan = plan_of()
    root = tmp_path / "run"
    shutil.copytree(finished, root)
    before = comparable(finished)
    fixed = next(cell for cell in plan.cells if cell.renderer.name == "onefixer-dit-tiny+clean")
    (root / fixed.folder / MANIFEST).unlink()
    assert sorted(run(plan, root)) == [("ok", False), ("ok", True)]
    assert comparable(root) == before
    again = run(plan_of(fixer=(*SMALL_NET, "tolerance_m=0")), root, resume=True)
    assert again == [("ok", True), ("ok", False)]  # the plain renderer's is reused


def test_an_untrained_fixer_is_called_so_everywhere(finished):
    said = "untrained (random)"
    info = json.loads((finished / "run.json").read_text())
    assert said in info["fixers"]["onefixer-dit-tiny+clean"]["label"]
    assert info["fixers"]["onefixer-dit-tiny+clean"]["settings"]["dit"]["width"] == 32
    assert info["config"]["fixer"] == list(SMALL_NET)
    assert info["weights"] == {}
    summary = json.loads((finished / "summary.json").read_text())
    entry = summary["fixers"]["onefixer-dit-tiny+clean"]
    assert said in entry["label"]
    assert entry["trained"] is False
    assert list(summary["fixers"]) == ["onefixer-dit-tiny+clean"]
    manifest = json.loads(
        next(finished.glob("rollouts/onefixer-dit-tiny+clean/**/manifest.json")).read_text()
    )
    assert said in manifest["fixer"]["label"]
    assert said in (finished / "summary.md").read_text().replace("\\", "")
    page = (finished / "report.html").read_text()
    assert '<div class="caution">onefixer-dit-tiny+clean is' in page
    assert 'id="table-fixers"' in page
    log = read_asl(
        next(finished.glob("rollouts/onefixer-dit-tiny+clean/**/rollout.asl")), images=False
    )
    assert said in log.info["versions"]["sensorsim"]


def test_hits_and_pose_errors_are_in_the_tables(finished):
    summary = json.loads((finished / "summary.json").read_text())
    entry = summary["fixers"]["onefixer-dit-tiny+clean"]
    assert entry["frames"] == 15
    assert entry["predicted"] == 15 - 3
    assert 0 < entry["hits"] <= entry["predicted"]
    assert entry["hit_rate"] == pytest.approx(entry["hits"] / entry["predicted"], abs=1e-4)
    stages = summary["speed"]["onefixer-dit-tiny+clean"]["stages"]
    assert {
        "render",
        "map",
        "fix",
    } <= set(stages)
    assert sum(stage["share"] for stage in stages.values()) == pytest.approx(1.0, abs=0.001)
    steps = pq.read_table(finished / "steps.parquet").to_pylist()
    shown = [row["value"] for row in steps if row["metric"] == "pose_error_m"]
    assert len(shown) == entry["frames"]
    assert max(shown) <= 0.02
    assert max(shown) == pytest.approx(entry["shown_error"]["camera_m"])
