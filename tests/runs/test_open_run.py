"""Runs in a notebook: what docs/notebook.md shows works as it stands, and what is shown is what the
files hold.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alpasim_plugin import open_run
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runs.notebook import OpenRollout, OpenRun

pytestmark = pytest.mark.slow

pytest.importorskip("pandas")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "notebook.md"
SHORT = (
    "--set",
    "timing.duration_us=600000",
    "--set",
    "degradation.kind=surrogate",
    "--certify",
    "none",
    "--no-report",
    "--json",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give the working folder of the page, with its run."""
    folder = tmp_path_factory.mktemp("notebook")
    words = [
        "--renderer",
        "clean,3dgs",
        "--policy",
        "lane-camera",
        "--seeds",
        "2",
        "--out",
        str(folder / "runs" / "mine"),
        "smoke/curve",
    ]
    assert run_command([*words, *SHORT, "--workers", "1"]) == 0
    return folder


@pytest.fixture
def run(folder: Path) -> OpenRun:
    return open_run(folder / "runs" / "mine")


class Tags(HTMLParser):
    """Collects tags, and refuses what does not close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.seen: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_cells_of_the_page_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MPLBACKEND", "agg")
    space: dict[str, Any] = {}
    *cells, of_polars = re.findall(
        r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S
    )
    for cell in cells:
        exec(compile(cell, str(PAGE), "exec"), space)
    assert isinstance(space["rollout"], OpenRollout)
    assert capsys.readouterr().out.startswith("no event ")
    pytest.importorskip("polars", reason="the page's last cell needs polars; the others have run")
    exec(compile(of_polars, str(PAGE), "exec"), space)
    assert sorted(space["frames"].rollouts["renderer"].unique()) == ["3dgs", "clean"]


def test_tables_hold_what_the_files_hold(run: OpenRun) -> None:
    assert len(run) == len(run.rollouts) == 4
    one = run.rollout("3dgs", seed=1)
    row = run.rollouts.query("renderer == '3dgs' and seed == 1").iloc[0]
    assert row["progress"] == one.metrics["progress"]
    undefined = [name for name, value in one.metrics.items() if value is None]
    assert undefined, "a short drive alone on the road has metrics without a value"
    assert all(np.isnan(row[name]) and not row[f"{name}_valid"] for name in undefined)
    mean = run.summary.query("renderer == '3dgs' and metric == 'progress'")["mean"].item()
    assert mean == pytest.approx(
        np.mean([r.metrics["progress"] for r in run if r.renderer == "3dgs"])
    )
    assert set(run.paired["baseline"]) == {"clean"}
    steps = one.steps
    assert list(steps.index) == sorted(steps.index)
    logged = one.log(images=False).ego.t_us
    assert set(steps.index) <= set(logged.tolist())


def test_polars_frames_equal_those_of_pandas(run: OpenRun) -> None:
    pytest.importorskip("polars")
    other = open_run(run.folder, frames="polars")
    assert (
        other.rollouts.drop("failure", "failure_class").to_pandas()["progress"].tolist()
        == run.rollouts["progress"].tolist()
    )
    assert other.steps.height == len(run.steps)
    mine, theirs = run.rollout("clean", seed=0).steps, other.rollout("clean", seed=0).steps
    np.testing.assert_array_equal(
        mine["lateral_distance_m"].to_numpy(), theirs["lateral_distance_m"].to_numpy()
    )


def test_a_run_and_a_rollout_show_themselves(run: OpenRun) -> None:
    tags, text = Tags(run._repr_html_()), run._repr_html_()
    assert run.verdict[:20] in text
    assert tags.seen.count("img") == 1
    assert "lateral_distance_m" in text
    one = run.rollout("3dgs", seed=0)
    shown = one._repr_html_()
    assert Tags(shown).seen.count("img") == 1
    assert "no event" in shown
    assert repr(one) == "3dgs, lane-camera, smoke-curve, seed 0: no event"
    assert "4 rollouts" in repr(run)


def test_names_of_a_run_do_not_become_markup(run: OpenRun) -> None:
    one = run.rollout("3dgs", seed=0)
    object.__setattr__(one._rollout, "scene", "<script>alert(1)</script>\"'")
    try:
        assert "<script" not in one._repr_html_()
        Tags(one._repr_html_())
    finally:
        object.__setattr__(one._rollout, "scene", "smoke-curve")


def test_a_choice_that_is_none_and_a_missing_library_are_said(
    run: OpenRun, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="2 rollouts fit"):
        run.rollout("3dgs")
    with pytest.raises(InputError, match="0 rollouts fit"):
        run.rollout("onefixer")
    with pytest.raises(InputError, match="no such library"):
        open_run(run.folder, frames="csv")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="reading a run folder"):
        open_run(tmp_path)
    monkeypatch.setitem(sys.modules, "polars", None)  # as if it were not installed
    with pytest.raises(InputError, match=r"extra \[notebook\]"):
        open_run(run.folder, frames="polars")
