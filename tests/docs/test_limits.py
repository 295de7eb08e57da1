"""The page of limits is made from the bounds."""

from __future__ import annotations

from pathlib import Path

from scenarios.limits_docs import BEGIN, END, limit_tables


def test_the_page_of_limits_shows_every_bound(repo: Path) -> None:
    text = (repo / "docs" / "limits.md").read_text(encoding="utf-8")
    assert text.split(BEGIN)[1].split(END)[0] == limit_tables(), "run python -m scenarios.limits_docs docs"
