"""The page of metrics says of each what its object says."""

from __future__ import annotations

from pathlib import Path

from evaluators.metrics import METRICS
from evaluators.metrics.docs import BEGIN, END, HEAD


def test_the_page_of_metrics_lists_every_metric_with_its_unit_better_side_and_reduction(repo: Path) -> None:
    text = (repo / "docs" / "metrics.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|\n").split("|")] for line in text.split(BEGIN)[1].split(END)[0].splitlines()[2:]]
    page = {row[0].strip("`"): dict(zip(HEAD, row, strict=True)) for row in rows}
    assert set(page) == set(METRICS), "run python -m evaluators.metrics.docs docs"
    for name, facts in METRICS.items():
        said = (page[name]["unit"], page[name]["better"].replace("neither", "none"), page[name]["over a rollout"])
        assert said == (facts.unit, facts.direction, facts.aggregation)
        assert page[name]["measured at"] == facts.reference
        assert float(page[name]["accepted"] or 0.0) == facts.accepted
        assert page[name]["per step"]
