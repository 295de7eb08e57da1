"""The judges' part of the quality table as markdown: metrics of whole sets, the paper's own names,
and which judges were asked.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def judged_markdown(summary: Mapping[str, Any]) -> str:
    """Return the tables of ``sets`` and ``paper`` of a summary, or nothing where no judge was
    asked.
    """
    if "sets" not in summary:
        return ""
    sets, paper = summary["sets"], summary["paper"]
    head = ["set metric, n vectors", *paper, "truth: half against half", "dimensions"]
    rows = []
    for metric, cell in sets.items():
        values = [_set_cell(cell["variants"][name]) for name in paper]
        oracle = "" if cell["oracle"] is None else f"{cell['oracle']:.4g}"
        rows.append([metric, *values, oracle, str(cell["dimensions"])])
    out = "\n" + _table(head, rows)
    out += (
        "\nA p-value is that of the difference from "
        + str(summary["baseline"])
        + ", by swapping clips. Fewer vectors than dimensions: mostly bias.\n"
    )
    names = list(next(iter(paper.values()), {}))
    out += "\n" + _table(
        ["the paper's metric", *paper],
        [[name, *(_paper_cell(paper[v][name]) for v in paper)] for name in names],
    )
    judges = ", ".join(f"{file} {digest[:12]}" for file, digest in summary["judges"].items())
    return out + f"\nJudges, as frozen: {judges}.\n"


def _set_cell(entry: Mapping[str, Any]) -> str:
    if entry["value"] is None:
        return f"null ({entry['reason']})"
    test = f", p {entry['p_value']:.3f}" if "p_value" in entry else ""
    return f"{entry['value']:.4g} (n {entry['n']}{test})"


def _paper_cell(cell: Mapping[str, Any]) -> str:
    return (
        f"{cell['value']:.4g}"
        if cell["value"] is not None
        else "null (" + str(cell["reason"]).partition(":")[0] + ")"
    )


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---", *(["---:"] * (len(head) - 1))], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
