"""The gate's self-test: right only where every broken renderer is caught and the healthy control is
not.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs.self_test import (
    CONTROL,
    REFERENCE,
    SUITE,
    Trial,
    broken_renderers,
    judge_pair,
)
from evaluators.statistics.gate import GateSpec, MetricRule, load_gate
from scenarios.suite import load_suite
from tests.evaluators.test_gate import rows


def trial(spec: GateSpec, is_broken: bool, **candidate: float) -> Trial:
    name = "broken-black" if is_broken else CONTROL
    both = [*rows(renderer=REFERENCE, n_scenes=12), *rows(renderer=name, n_scenes=12, **candidate)]
    return Trial(name, is_broken, judge_pair(spec, both, name, 12))


def test_a_sensitive_gate_is_right_about_both() -> None:
    spec = load_gate("default")[0].model_copy(
        update={"metrics": {"route_distance_m": MetricRule(margin=0.1)}}
    )
    assert spec.min_scenes > 12  # the self-test asks for no more scenes than its suite has
    caught = trial(spec, True, shift=0.5)
    assert (caught.is_right, caught.caught_by) == (True, ["route_distance_m"])
    assert trial(spec, False).is_right


def test_a_blunt_gate_and_a_gate_that_fails_everything_are_both_found_out() -> None:
    blunt = GateSpec(version=1, metrics={"route_distance_m": MetricRule(margin=5.0)})
    assert not trial(blunt, True, shift=0.5).is_right
    fails_all = GateSpec(version=1, metrics={"route_distance_m": MetricRule(max=0.0)})
    assert not trial(fails_all, False).is_right


def test_undecided_is_not_caught() -> None:
    spec = GateSpec(version=1, metrics={"route_distance_m": MetricRule(margin=0.1)})
    unsure = trial(spec, True, shift=0.11, spread=1.0)
    assert unsure.verdict.outcome.cause == "undecided"
    assert not unsure.is_right


def test_the_suite_and_the_faults_are_the_documented_ones() -> None:
    assert len(load_suite(SUITE)) == 12
    assert sorted(broken_renderers()) == [
        f"broken-{n}" for n in ("black", "blurred", "frozen", "late", "mirrored", "shifted")
    ]


@pytest.mark.slow
def test_the_default_gate_catches_every_broken_renderer_in_closed_loop(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["gate", "--self-test", "--out", str(tmp_path / "self")]) == 0
    out = capsys.readouterr().out
    assert out.count("caught by") == 6
    assert "clean, other noise: not called worse" in out
