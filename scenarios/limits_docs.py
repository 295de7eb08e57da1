"""The tables of limits in docs/limits.md, from the bounds themselves: ``python -m scenarios.limits_docs docs``."""

from __future__ import annotations

import sys
from pathlib import Path

from alpasim_plugin.io import limits as bounds
from alpasim_plugin.io.limits import Bound, number
from scenarios import budget

PAGE = "limits.md"
BEGIN, END = "<!-- limits: made by python -m scenarios.limits_docs docs -->\n", "<!-- end of limits -->\n"


def limit_tables() -> str:
    """Return the tables: what one scenario may cost, and the range of every quantity."""
    single = [value for value in vars(bounds).values() if isinstance(value, Bound)]
    return f"\n## What one scenario may hold\n\n{_table(budget.BUDGETS)}\n## Ranges\n\n{_table(single)}\n"


def _table(rows: tuple[Bound, ...] | list[Bound]) -> str:
    lines = ["| quantity | unit | least | most | why |", "|---|---|---:|---:|---|"]
    lines += [f"| {row.name} | {row.unit} | {number(row.low)} | {number(row.high)} | {row.reason} |" for row in rows]
    return "\n".join(lines) + "\n"


def main(folder: Path) -> None:
    """Rewrite the tables between the marks of the page in a folder."""
    text = (folder / PAGE).read_text(encoding="utf-8")
    head, rest = text.split(BEGIN)
    (folder / PAGE).write_text(head + BEGIN + limit_tables() + END + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
