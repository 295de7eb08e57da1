"""``simrun check policy``: what it prints, and that a policy's own prints do not break
``--json``.
"""

import json

import pytest

from alpasim_plugin.cli.main import run_command

TALKS = """
import numpy as np
from alpasim_plugin.core.types import Plan

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

class Centimetres(Talks):
    def act(self, observation):
        plan = super().act(observation)
        return Plan(plan.t_us, plan.times_us, 100 * plan.xy, plan.yaw)

class BadReset(Talks):
    def reset(self, seed, route):
        raise KeyError("route")

class NoSensors(Talks):
    sensors = "front"

class Fails(Talks):
    def __init__(self):
        raise OSError("weights.pt is missing")
"""


@pytest.fixture
def parts(tmp_path, monkeypatch):
    (tmp_path / "talking_policies.py").write_text(TALKS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_policy_that_prints_leaves_one_document_on_stdout(parts, capsys):
    assert run_command(["check", "policy", "talking_policies.py:Talks", "--json"]) == 0
    printed = capsys.readouterr()
    document = json.loads(printed.out)
    assert document["ok"]
    assert {
        "sensors",
        "values",
        "times",
        "frame",
        "direction",
        "side",
        "speed",
        "determinism",
        "reset",
    } <= {row["check"] for row in document["checks"]}
    assert "planning" in printed.err


def test_a_policy_that_cannot_be_made_is_a_finding_and_one_that_is_not_there_an_error(
    parts, capsys
):
    assert run_command(["check", "policy", "talking_policies.py:Fails"]) == 1
    out = capsys.readouterr().out
    assert out.startswith("FAIL made: ")
    assert "OSError: weights.pt is missing" in out
    assert run_command(["check", "policy", "talking_policies.py:Absent"]) == 2


SHORT = [
    "--workers",
    "1",
    "--no-report",
    "--set",
    "timing.duration_us=600000",
    "smoke/straight",
]
GREY = ["--renderer", "tests.runs.grey_renderer:Grey"]


def test_a_run_with_a_policy_that_prints_gives_one_document(parts, capsys):
    assert (
        run_command(
            [*GREY, "--policy", "talking_policies.py:Talks", "--out", "run", "--json", *SHORT]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["exit_code"] == 0


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("Transposed", "xy (2, 41)"),
        ("BadReset", "KeyError: 'route'"),
    ],
)
def test_in_a_run_the_faults_of_a_policy_are_its_own(parts, name, found, capsys):
    assert (
        run_command([*GREY, "--policy", f"talking_policies.py:{name}", "--out", "run", *SHORT]) == 2
    )
    told = capsys.readouterr().err
    assert found in told
    assert "1 by the policy's own fault" in told
    assert "infrastructure" not in told


def test_sensors_that_are_none_are_refused_before_anything_is_driven(parts, capsys):
    assert run_command([*GREY, "--policy", "talking_policies.py:NoSensors", *SHORT]) == 2
    assert "sensors is 'front'" in capsys.readouterr().err
    assert not list(parts.rglob("manifest.json"))
