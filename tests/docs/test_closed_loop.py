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


def test_the_interval_over_families_is_t_on_the_sums_of_their_residuals(closed_loop):
    counts = {"bends": (1, 0), "hills": (4, 0), "towns": (1, 1)}  # of 4 rollouts
    events = {
        family: {"3dgs": [before, 4], "onefixer": [after, 4]}
        for family, (before, after) in counts.items()
    }
    # -1, -4 and 0 of 4 rollouts: mean -5/12, residuals 2/3, -7/3 and 5/3, t of 2 degrees 4.3027
    half = 100 * 4.3027 * np.sqrt(3 / 2 * (4 / 9 + 49 / 9 + 25 / 9)) / 12
    low, high, family, rest = closed_loop.over_families(events)
    assert (low, high) == pytest.approx((-500 / 12 - half, -500 / 12 + half), rel=1e-4)
    assert (family, rest) == ("hills", pytest.approx(-12.5))
