"""The pages about driving say what their record says: over scenes and over families."""

import importlib
import json
import re

import numpy as np
import pytest

NUMBER = r"[-+]?\d+\.\d"


@pytest.fixture
def closed_loop(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    return importlib.import_module("closed_loop")


def test_pages_say_what_the_record_says(closed_loop):
    record = json.loads(closed_loop.RECORD.read_text())
    for path, text in closed_loop.written(record).items():
        assert path.read_text() == text, "run python docs/scripts/closed_loop.py"
    share = record["policies"]["learned"]["means"][closed_loop.EVENT]["3dgs"][0]
    text = closed_loop.sentence(record["policies"]["learned"], record["length"])
    assert f"{100 * share:.1f} % behind `3dgs`" in text
    index = (closed_loop.DOCS / "experiments" / "index.md").read_text()
    (row,) = (line for line in index.splitlines() if line.startswith("| Does it make driving"))
    said = closed_loop.RECORD.with_name("fixer-closed-loop.md").read_text() + text
    known = {abs(float(number)) for number in re.findall(NUMBER, said)}
    assert {abs(float(number)) for number in re.findall(NUMBER, row)} <= known


def test_over_families_the_difference_is_counted_tested_and_bounded_for_others(closed_loop):
    counts = {"bends": (1, 0), "hills": (4, 0), "towns": (1, 1)}  # of 4 rollouts
    events = {
        family: {"3dgs": [before, 4], "onefixer": [after, 4]}
        for family, (before, after) in counts.items()
    }
    over = closed_loop.over_families(events)
    assert (over.n_better, over.n_worse, over.p_value) == (2, 0, 0.5)
    low, high = over.bounds
    assert -100.0 <= low < -500 / 12 < 0.0 < high, "three families say little of others"
    assert (over.family, over.without_family) == ("hills", pytest.approx(-12.5))


def test_the_bounds_for_other_families_hold_where_one_in_ten_changes_greatly(closed_loop):
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(100):
        lost = np.where(rng.random(18) < 0.1, 8, 0)
        events = {str(i): {"3dgs": [int(n), 10], "onefixer": [0, 10]} for i, n in enumerate(lost)}
        low, high = closed_loop.over_families(events).bounds
        covered += low <= -8.0 <= high
    assert covered >= 95


def test_a_number_without_an_interval_has_no_bracket(closed_loop):
    entry = {"mean": 3.0, "ci95": 0.5, "ci95_clustered": None}
    numbers = closed_loop.numbers_of(entry, ("mean", "ci95", "ci95_clustered"))
    assert numbers == [3.0, 0.5, None, None]
    assert closed_loop.bracket(*numbers[2:], 1, ".1f") == ""
    assert closed_loop.bracket(0.02, 0.031, 100, "+.1f") == " [+2.0, +3.1]"
    paired = {"diff": -1.0, "ci95": None, "p_value": 0.0001}
    numbers = closed_loop.numbers_of(paired, ("diff", "ci95", "p_value"))
    assert numbers == [-1.0, None, None, 0.0001]
    assert closed_loop.chance(0.0001) == "< 0.001"
