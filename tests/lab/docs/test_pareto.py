"""Closed-loop error against cost: which settings are shown to be on the front, behind it, or
neither.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest


@pytest.fixture
def pareto(repo: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    return importlib.import_module("pareto")


def test_a_setting_is_on_the_front_behind_it_or_undecided(pareto: ModuleType) -> None:
    ms, error_m = np.linspace(10.0, 12.0, 8), np.linspace(0.10, 0.12, 8)
    apart = np.where(np.arange(8) % 2, 1.5, 0.5)
    made = {
        "cheap": (ms, 3 * error_m),
        "exact": (3 * ms, error_m),
        "wasteful": (4 * ms, 4 * error_m),
        "unsure": (3.1 * ms, apart * error_m),
    }
    points = {name: pareto.Point(*pair, 0) for name, pair in made.items()}
    found = {name: pareto.place(name, points) for name in points}
    assert found == {
        "cheap": "front",
        "exact": "front",
        "wasteful": "behind",
        "unsure": "undecided (1)",
    }


def test_the_page_has_the_table_of_its_record(pareto: ModuleType, repo: Path) -> None:
    record = json.loads((repo / "docs" / "experiments" / "pareto-drives.json").read_text())
    assert pareto.table(pareto.points_of(record)) in pareto.PAGE.read_text(encoding="utf-8")
