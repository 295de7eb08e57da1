"""``simrun fork`` as a user meets it."""

from __future__ import annotations

from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.test_fork import CELL, SHORT
from tests.runs.test_runs import Announced


@pytest.mark.slow
def test_the_verb_reports_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "run"
    plan = make_plan(
        expand("smoke/lead_car", SHORT), ("clean",), ("lane-camera",), (0,), RunOptions()
    )
    execute_run(plan, root, 1, ["simrun"], Announced(), report=False)
    assert run_command(["fork", f"{root}/{CELL}", "--at", "0.6", "--out", str(tmp_path / "f")]) == 0
    assert "continuation      equal to the log, bit for bit" in capsys.readouterr().out
    assert run_command(["fork", f"{root}/{CELL}", "--at", "0.6", "--renderer", "clena"]) == 2
    assert run_command(["fork", str(root), "--at", "0.6"]) == 2
