"""The page of metrics says of each what its object says."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from evaluators.metrics import METRICS


def test_the_page_of_metrics_lists_every_metric_with_its_unit_better_side_and_reduction(
    repo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    made = importlib.import_module("metrics_page")
    text = (repo / "docs" / "metrics.md").read_text(encoding="utf-8")
    rows = [
        [cell.strip() for cell in line.strip("|\n").split("|")] for line in text.split(made.BEGIN)[1].split(made.END)[0].splitlines()[2:]
    ]
    page = {row[0].strip("`"): dict(zip(made.HEAD, row, strict=True)) for row in rows}
    assert set(page) == set(METRICS), "run python docs/scripts/metrics_page.py"
    for name, facts in METRICS.items():
        said = (page[name]["unit"], page[name]["better"].replace("neither", "none"), page[name]["over a rollout"])
        assert said == (facts.unit, facts.direction, facts.aggregation)
        assert page[name]["measured at"] == facts.reference
        assert float(page[name]["accepted"] or 0.0) == facts.accepted
        assert page[name]["per step"]
