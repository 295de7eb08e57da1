"""The gate's self-test: right only where every broken renderer is caught and the healthy control is
not.
"""

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs.self_test import (
    CONTROL,
    REFERENCE,
    Trial,
    gate_against,
)
from evaluators.statistics.gate import GateSpec, MetricRule
from tests.evaluators.gate_tables import add, rows, table_of


def trial(margin, is_broken, change, limit=None):
    rules = {"lateral_distance_m": MetricRule(margin=margin, max=limit)}
    name = "broken-black" if is_broken else CONTROL
    first = table_of(rows(REFERENCE))
    again = table_of(add(change)(rows(name)))
    spec = GateSpec(version=1, metrics=rules, min_scenes=100)  # the self-test asks for no more
    return Trial(name, is_broken, gate_against(again, spec, first, name))


def test_a_sensitive_gate_is_right_about_both():
    caught = trial(0.1, True, 0.5)
    assert (caught.is_right, caught.caught_by) == (True, ["lateral_distance_m"])
    assert trial(0.1, False, 0.0).is_right


def test_a_blunt_gate_and_a_gate_that_fails_everything_are_both_found_out():
    assert not trial(5.0, True, 0.5).is_right
    assert not trial(0.1, False, 0.0, limit=0.0).is_right


@pytest.mark.slow
def test_the_default_gate_catches_every_broken_renderer_in_closed_loop(tmp_path, capsys):
    assert run_command(["gate", "--self-test", "--out", str(tmp_path / "self")]) == 0
    out = capsys.readouterr().out
    assert out.count("caught by") == 6
    assert "clean, driven again: not called worse" in out
