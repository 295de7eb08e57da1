"""Families of scenes as the unit of a difference, and the difference without one of them."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from alpasim_plugin.log.run_folder.columns import RolloutTable
from evaluators.statistics.families import family_bounds, grouped
from evaluators.statistics.summary import numbers

SCENES = [f"{family}-{k}" for family in ("bridge", "curve", "junction", "plain") for k in range(5)]


def rows(gained: str):
    """Two renderers, without an event but in all scenes of one family."""
    out = []
    for renderer in ("clean", "3dgs"):
        for scene in SCENES:
            hit = float(renderer == "3dgs" and scene.startswith(gained))
            of = {
                "renderer": renderer,
                "policy": "p",
                "scene": scene,
                "seed": 0,
                "status": "ok",
                "failure_class": "",
            }
            out.append(of | {"offroad": hit, "offroad_valid": True})
    return RolloutTable.of_table(pa.Table.from_pylist(out))


def test_a_difference_of_one_family_is_gone_without_it_and_wide_by_families():
    family_of = {scene: scene.split("-")[0] for scene in SCENES}
    entry = numbers(rows("curve"), "clean", family_of=family_of)["paired"]["3dgs"]["offroad"]
    assert entry["diff"] == 0.25
    assert entry["families"]["n"] == 4
    assert (
        entry["families"]["ci95"][0] < 0.0 < entry["ci95"][0]
    )  # scenes say that it is worse, families do not
    assert (entry["families"]["without"]["family"], entry["families"]["without"]["diff"]) == (
        "curve",
        0.0,
    )
    assert entry["families"]["without"]["ci95"][1] > 0.0
    assert "families" not in numbers(rows("curve"), "clean")["paired"]["3dgs"]["offroad"]
    assert (
        "families"
        not in numbers(rows("curve"), "clean", family_of=dict.fromkeys(SCENES, "one"))["paired"][
            "3dgs"
        ]["offroad"]
    )


def test_families_of_equal_size_have_the_t_interval_of_their_means():
    rng = np.random.default_rng(1)
    means = rng.normal(size=30)
    family = np.repeat(np.arange(6), 5)
    of_family = means.reshape(6, 5).mean(axis=1)
    want = stats.t.interval(0.95, 5, of_family.mean(), stats.sem(of_family))
    assert family_bounds(means, family) == pytest.approx(list(want))


def test_families_are_files_of_scenes_made_by_seeds_else_folders():
    assert grouped({"a-1": "x/a.yaml", "a-2": "x/a.yaml"}) == {"a-1": "x/a.yaml", "a-2": "x/a.yaml"}
    assert grouped({"a": "x/a.yaml", "b": "y/b.yaml"}) == {"a": "x", "b": "y"}
