"""The page of metrics says of each what its object says."""

from __future__ import annotations

from pathlib import Path

from evaluators.metrics import METRICS
from evaluators.metrics.docs import BEGIN, BEGIN_SCORES, END, HEAD, SCORES_HEAD
from evaluators.scores.table import BENCHMARKS


def rows_of(text: str, begin: str, head: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """Return the row of every metric of a table; a row may be of several."""
    lines = text.split(begin)[1].split(END)[0].splitlines()[2:]
    rows = [
        dict(zip(head, [cell.strip() for cell in line.strip("|\n").split("|")], strict=True))
        for line in lines
    ]
    return {name.strip("`"): row for row in rows for name in row[head[0]].split(", ")}


def test_the_page_of_metrics_lists_every_metric_with_its_unit_better_side_and_reduction(
    repo: Path,
) -> None:
    text = (repo / "docs" / "metrics.md").read_text(encoding="utf-8")
    page, scores = rows_of(text, BEGIN, HEAD), rows_of(text, BEGIN_SCORES, SCORES_HEAD)
    assert {*page, *scores} == set(METRICS), "run python -m evaluators.metrics.docs docs"
    assert set(scores) == set(BENCHMARKS)
    for name, row in page.items():
        facts = METRICS[name]
        said = (row["unit"], row["better"].replace("neither", "none"), row["over a rollout"])
        assert said == (facts.unit, facts.direction, facts.aggregation)
        assert row["measured at"] == facts.reference.removesuffix(", plan view")
        assert float(row["accepted"] or 0.0) == facts.accepted
        assert row["per step"]


def test_what_the_page_says_of_all_scores_once_is_so() -> None:
    for name, facts in BENCHMARKS.items():
        is_speed = name.endswith("_mps")
        assert (facts.unit, facts.direction) == (
            ("m/s", "lower") if is_speed else ("", "higher")
        ), name
        assert (facts.aggregation, facts.accepted, facts.reference) == ("last", 0.0, "")


def test_a_score_and_its_bounds_share_a_row(repo: Path) -> None:
    scores = rows_of(
        (repo / "docs" / "metrics.md").read_text(encoding="utf-8"), BEGIN_SCORES, SCORES_HEAD
    )
    assert scores["nuplan_score"] is scores["nuplan_score_least"] is scores["nuplan_score_most"]
    assert scores["nuplan_score"]["of a rollout"] == BENCHMARKS["nuplan_score"].help
