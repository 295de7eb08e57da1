"""Scores of finished rollouts are made again when the evaluators have changed, and only then;
nothing is driven again.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from alpasim_plugin.log.run_folder.manifests import write_manifest
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.schema import LOG_NAME, MANIFEST
from alpasim_plugin.runs import plan
from alpasim_plugin.runs.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.test_runs import Announced


def one_rollout() -> RunPlan:
    refs = expand("smoke/straight", ("timing.duration_us=1200000",))
    return make_plan(refs, ("clean",), ("constant-velocity",), (0,), RunOptions(images="none"))


def run(of: RunPlan, root: Path) -> list[tuple[str, bool]]:
    announced = Announced()
    execute_run(of, root, 1, ["simrun"], announced, report=False)
    return announced.results


def test_rollouts_are_scored_again_when_the_evaluators_changed_and_only_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = one_rollout()
    run(old, tmp_path)
    folder = tmp_path / old.cells[0].folder
    scored = read_json(folder / MANIFEST)
    driven = (folder / LOG_NAME).stat().st_mtime_ns
    older = scored["metrics"] | {
        "progress": scored["metrics"]["progress"] | {"value": -7.0}
    }  # as if other evaluators had made it
    write_manifest(folder, scored | {"metrics": older})

    assert run(one_rollout(), tmp_path) == [("ok", True)]
    assert read_json(folder / MANIFEST)["metrics"] == older

    own = plan.own_code_digest
    monkeypatch.setattr(
        plan,
        "own_code_digest",
        lambda module: own(module) + ("edited" if module.endswith("scoring") else ""),
    )
    new = one_rollout()
    assert new.command_key == old.command_key  # the same folder
    assert run(new, tmp_path) == [("ok", True)]
    again = read_json(folder / MANIFEST)
    assert again["metrics"] == scored["metrics"]
    assert again["rollout_key"] == scored["rollout_key"]
    assert again["score_key"] != scored["score_key"]
    assert (folder / LOG_NAME).stat().st_mtime_ns == driven
