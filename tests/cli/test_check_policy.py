"""``simrun check-policy``: what it prints, and that a policy's own prints do not break ``--json``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command

TALKS = """
import numpy as np
from alpasim_plugin.types import Plan

class Talks:
    sensors = ()

    def __init__(self):
        print("loading weights")

    def reset(self, seed, route):
        print("reset")

    def act(self, observation):
        print("planning")
        times_us = observation.t_us + 100_000 * np.arange(41, dtype=np.int64)
        x = observation.ego.speed_mps * 1e-6 * (times_us - observation.t_us)
        return Plan(observation.t_us, times_us, np.stack([x, 0 * x], axis=1), 0 * x)

class Transposed(Talks):
    def act(self, observation):
        plan = super().act(observation)
        return Plan(plan.t_us, plan.times_us, plan.xy.T, plan.yaw)

class Fails(Talks):
    def __init__(self):
        raise OSError("weights.pt is missing")
"""


@pytest.fixture
def parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "talking_policies.py").write_text(TALKS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_policy_that_prints_leaves_one_document_on_stdout(parts: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check-policy", "talking_policies.py:Talks", "--json"]) == 0
    printed = capsys.readouterr()
    document = json.loads(printed.out)
    assert document["ok"]
    assert {"sensors", "values", "times", "frame", "units", "side", "determinism", "reset"} <= {row["check"] for row in document["checks"]}
    assert "planning" in printed.err


def test_a_fault_is_exit_code_1_and_a_line(parts: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check-policy", "talking_policies.py:Transposed"]) == 1
    assert "FAIL values: in the situation 'straight' the plan has times_us (41,), xy (2, 41)" in capsys.readouterr().out


def test_a_policy_that_cannot_be_made_or_found_is_a_four_part_error(parts: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check-policy", "talking_policies.py:Fails"]) == 4
    assert "weights.pt is missing" in capsys.readouterr().err
    assert run_command(["check-policy", "talking_policies.py:Absent"]) == 2


def test_a_run_with_a_policy_that_prints_gives_one_document(parts: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rest = ["--workers", "1", "--certify", "none", "--no-report", "--json", "--set", "timing.duration_us=600000", "smoke/straight"]
    command = ["--renderer", "tests.runtime.grey_renderer:Grey", "--policy", "talking_policies.py:Talks", "--out", "run", *rest]
    assert run_command(command) == 0
    assert json.loads(capsys.readouterr().out)["exit_code"] == 0
