"""``simrun fork`` and ``simrun probe`` as a user meets them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.test_fork import CELL, SHORT
from tests.runs.test_runs import Announced


@pytest.mark.slow
def test_the_verbs_report_what_they_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "run"
    plan = make_plan(
        expand("smoke/lead_car", SHORT), ("clean",), ("lane-camera",), (0,), RunOptions()
    )
    execute_run(plan, root, 1, ["simrun"], Announced(), certificate="none", report=False)
    assert (
        run_command(
            ["fork", str(root), "--cell", CELL, "--at", "0.6", "--out", str(tmp_path / "fork")]
        )
        == 0
    )
    assert "continuation      equal to the log, bit for bit" in capsys.readouterr().out
    asked = ["--renderers", "clean,broken-frozen", "--out", str(tmp_path / "p"), "--json"]
    assert run_command(["probe", str(root), "--cell", CELL, *asked]) == 0
    assert json.loads(capsys.readouterr().out)["probe"]["along"] == CELL
    assert (
        run_command(["fork", str(root), "--cell", CELL, "--at", "0.6", "--renderer", "clena"]) == 2
    )
    assert "did you mean 'clean'" in capsys.readouterr().err
