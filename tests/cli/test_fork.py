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


def test_a_part_of_the_users_own_drives_again_only_if_it_is_named_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    base = "from policies.simple import ConstantVelocity\n\n\n"
    Path("own.py").write_text(f"{base}class Own(ConstantVelocity):\n    pass\n")
    short = ["--set", "timing.duration_us=1000000", "--set", "timing.warmup_us=200000"]
    drive = ["run", "--renderer", "clean", "--policy", "own.py:Own", "--images", "none", *short]
    assert run_command([*drive, "--out", "run", "smoke/straight"]) == 0
    (cell,) = Path("run").glob("rollouts/*/*/*/*")
    again = ["fork", str(cell), "--at", "0.5", "--out", "forked"]
    assert run_command(again) == 2
    assert run_command([*again, "--policy", "pure-pursuit"]) == 2
    assert run_command([*again, "--own", "own.py:Own"]) == 0
