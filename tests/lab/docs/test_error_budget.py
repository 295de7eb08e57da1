"""The error budget: what samples add is a decomposition of the variance, what steps add is a paired
change.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.types import Trajectory
from tests.evaluators.eval_build import rollout, track


@pytest.fixture
def budget(repo: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    return importlib.import_module("error_budget")


def test_variance_of_seeds_and_of_scenes_add_up(budget: ModuleType) -> None:
    rng = np.random.default_rng(0)
    scene, families = np.repeat(np.arange(400), 5), np.arange(400)
    found = budget.sources(rng.normal(0, 1, 400)[scene] + rng.normal(0, 2, 2000), scene, families)
    assert found["scenes"] ** 2 + found["seeds"] ** 2 == pytest.approx(
        found["scenes and seeds"] ** 2
    )
    assert found["seeds"] == pytest.approx(1.966 * np.sqrt(4 / 5 / 400), rel=0.05)
    assert found["scenes"] == pytest.approx(1.966 * np.sqrt(1 / 400), rel=0.2)
    assert found["families"] == pytest.approx(found["scenes and seeds"]), (
        "each scene is a family of its own"
    )


def drives(
    budget: ModuleType, what: str, harm: float, event: float = 0.0
) -> dict[str, dict[str, float]]:
    out = {}
    for k in range(6):
        for renderer, far in (
            (budget.BASELINE, 1.0),
            (budget.FIXED, 0.5 + 0.1 * k + harm * (1 + 0.1 * (k % 2))),
        ):
            ms = 10.0 * (2.0 if what == "resolution" else 1.0)
            out[f"s/{k}|{what}|{renderer}"] = {
                budget.EVENT: event,
                budget.DISTANCE: far,
                "ms": ms,
                "frames": 40,
            }
    return out


def test_a_step_is_judged_by_its_paired_change_against_a_tenth_of_the_interval(
    budget: ModuleType, tmp_path: Path
) -> None:
    far = {budget.BASELINE: [1.0] * 6, budget.FIXED: [0.5 + 0.1 * k for k in range(6)]}
    rows = [
        {
            "renderer": name,
            "scene": f"test-{'ab'[k % 2]}-{k}",
            "seed": seed,
            budget.DISTANCE: m[k],
            budget.EVENT: float(k == seed and name == budget.BASELINE),
        }
        for name, m in far.items()
        for k in range(6)
        for seed in range(2)
    ]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "rollouts.parquet")
    known = {"raster": {"s/0": [1e-4, 1]}, "drives": {}}
    for what, harm, event in (
        ("", 0.0, 0.0),
        ("vehicle step", 1e-6, 0.0),
        ("resolution", 0.5, 1.0),
    ):
        known["drives"] |= drives(budget, what, harm, event)
    known["drives"] |= {
        key: row
        for key, row in drives(budget, "fixer precision", 0.0).items()
        if budget.FIXED in key
    }
    rescored = {key.replace("||", "|"): [row, row] for key, row in drives(budget, "", 0.0).items()}
    lines = budget.table(tmp_path, json.loads(json.dumps(known)), rescored).splitlines()
    of = {line.split(" | ")[0].removeprefix("| "): line for line in lines if line.startswith("| ")}
    assert "| missed | 12 of 12 (below 100.0 %) | 2.00 ± 0.00 |" in of["resolution"]
    assert "| met | 0 of 12 (below 26.5 %) | 1.00 ± 0.00 |" in of["vehicle step"]
    assert "| met | 0 of 12 " in of["fixer precision"]
    assert "| 6 | +0.0000 ± 0.0000 | 0.0 % | met |" in of[budget.EVALUATOR]
    assert lines.index(of["resolution"]) < lines.index(of["vehicle step"]), "the largest first"


def test_the_evaluators_step_is_halved_by_a_pose_between_every_two(budget: ModuleType) -> None:
    log = rollout(track(np.linspace(0.0, 7.9, 80), 0.0))
    ego: Trajectory = budget.finer(log).ego
    assert (len(ego), int(np.diff(ego.t_us).max())) == (159, 50_000)
    assert ego.xyz[1, 0] == pytest.approx(log.ego.xyz[:2, 0].mean())


def test_the_scenes_and_steps_are_those_of_the_page(budget: ModuleType, repo: Path) -> None:
    page = (repo / "docs" / "experiments" / "error-budget.md").read_text(encoding="utf-8")
    assert len(budget.scenes()) == 20
    for what in (*budget.STEPS, budget.EVALUATOR):
        assert f"*{what[0].upper()}{what[1:]}*" in page


def test_draws_of_a_scene_count_as_one_scene(budget: ModuleType) -> None:
    usual = {
        f"{name}|{arm}": {budget.EVENT: 0.0, budget.DISTANCE: 1.0}
        for name in ("s/0", "s/0#1", "s/1")
        for arm in (budget.FIXED, budget.BASELINE)
    }
    other = {
        key: {**row, budget.DISTANCE: 1.0 + 0.4 * key.startswith("s/0#1|" + budget.FIXED)}
        for key, row in usual.items()
    }
    found = budget.changed(usual, other)
    assert found["scenes"] == 2
    assert found["moved"][budget.DISTANCE] == pytest.approx([0.2, 0.0])
