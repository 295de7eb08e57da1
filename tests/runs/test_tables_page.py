"""The queries of docs/runs.md, run as they stand there and compared with the run's own
statistics.
"""

import re
from pathlib import Path

import pytest

from evaluators.statistics.opening import read_run
from tests.pages.make_run import Plan, make_run

duckdb = pytest.importorskip("duckdb", reason="duckdb is not installed: pip install duckdb")
SCENES = ("smoke-straight", "urban-left_turn", "hard-curve")
FAILED = ("3dgs", "smoke-straight", 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Give a folder with ``runs/mine`` and ``runs/other``; one rollout of the first failed."""
    root = tmp_path_factory.mktemp("tables")
    small = {
        "scenes": SCENES,
        "seeds": (0, 1),
        "steps": 20,
        "clips": False,
    }
    make_run(root / "runs" / "mine", Plan(renderers=("clean", "3dgs"), fail=[FAILED], **small))
    make_run(root / "runs" / "other", Plan(renderers=("clean",), rng_seed=8, **small))
    return root


@pytest.fixture
def run(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return read_run(folder / "runs" / "mine")


def rows(repo, number):
    page = (repo / "docs" / "runs.md").read_text(encoding="utf-8")
    queries = re.findall(r"^```sql\n(.*?)^```", page, re.S | re.M)
    found = duckdb.execute(queries[number])
    names = [column[0] for column in found.description]
    return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def test_means_of_many_runs_are_those_of_their_summaries(repo, run):
    found = {(Path(row["filename"]).parent.name, row["renderer"]): row for row in rows(repo, 0)}
    assert set(found) == {("mine", "clean"), ("mine", "3dgs"), ("other", "clean")}
    for (name, renderer), row in found.items():
        held = read_run(Path("runs", name)).summary.metrics[renderer]
        failed = 1 if (name, renderer) == ("mine", "3dgs") else 0
        assert (row["ran"], row["failed"]) == (6 - failed, failed)
        for metric in ("offroad", "lateral_distance_m"):
            assert row[metric] == pytest.approx(held[metric].mean, rel=1e-12)
        assert row["valid"] == held["lateral_distance_m"].n_rollouts
