"""Scores of finished rollouts are made again when the evaluators have changed, and only then; nothing is driven again."""

from __future__ import annotations

from pathlib import Path

import pytest

from alpasim_plugin.atomic import write_json
from alpasim_plugin.runtime import cell, plan
from alpasim_plugin.runtime.cell import MANIFEST
from alpasim_plugin.runtime.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runtime.recorder import LOG_NAME
from alpasim_plugin.runtime.run import execute_run
from alpasim_plugin.runtime.store import read_json
from evaluators import EVALUATORS_VERSION
from scenarios.suite import expand
from tests.runtime.test_runs import Heard


def one_rollout() -> RunPlan:
    refs = expand("smoke/straight", ("timing.duration_us=1200000",))
    return make_plan(refs, ("clean",), ("constant-velocity",), (0,), RunOptions(images="none"))


def run(of: RunPlan, root: Path) -> list[tuple[str, bool]]:
    heard = Heard()
    execute_run(of, root, 1, ["simrun"], heard, certificate="none")
    return heard.fates


def test_rollouts_are_scored_again_when_the_evaluators_changed_and_only_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = one_rollout()
    run(old, tmp_path)
    folder = tmp_path / old.cells[0].folder
    scored = read_json(folder / MANIFEST)
    assert scored["evaluators_version"] == EVALUATORS_VERSION
    driven = (folder / LOG_NAME).stat().st_mtime_ns
    older = scored["metrics"] | {"progress": scored["metrics"]["progress"] | {"value": -7.0}}  # as if other evaluators had made it
    write_json(folder / MANIFEST, scored | {"metrics": older})

    assert run(one_rollout(), tmp_path) == [("ok", True)]
    assert read_json(folder / MANIFEST)["metrics"] == older

    for module in (plan, cell):
        monkeypatch.setattr(module, "EVALUATORS_VERSION", EVALUATORS_VERSION + 1)
    new = one_rollout()
    assert new.key == old.key  # the same folder
    assert run(new, tmp_path) == [("ok", True)]
    again = read_json(folder / MANIFEST)
    assert again["metrics"] == scored["metrics"]
    assert (again["evaluators_version"], again["rollout_key"]) == (EVALUATORS_VERSION + 1, scored["rollout_key"])
    assert again["score_key"] != scored["score_key"]
    assert (folder / LOG_NAME).stat().st_mtime_ns == driven
