"""The tables of metrics in docs/metrics.md, from the metrics themselves: ``python -m
evaluators.metrics.docs docs``.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from evaluators.metrics.table import METRICS
from evaluators.scores.table import BENCHMARKS

PAGE = "metrics.md"
BEGIN, END = (
    "<!-- metrics: made by python -m evaluators.metrics.docs docs -->\n",
    "<!-- end of metrics -->\n",
)
BEGIN_SCORES = "<!-- scores: made by python -m evaluators.metrics.docs docs -->\n"
HEAD = (
    "metric",
    "per step",
    "measured at",
    "unit",
    "better",
    "over a rollout",
    "accepted",
    "invalid",
)
UNKNOWN = METRICS["collision_any"].invalid  # long, and of every contact: the page says it once
SCORES_HEAD = ("score or part", "of a rollout")  # the page says the rest once, of all of them


def metric_table() -> str:
    """Return the table: one metric a row, in the order in which reports show them; metrics that
    differ in their names alone share a row.
    """
    names: dict[tuple[str, ...], list[str]] = {}
    for name in METRICS.ordered(METRICS):
        one = METRICS[name]
        if name not in BENCHMARKS:
            better = {"none": "neither"}.get(one.direction, one.direction)
            accepted = f"{one.accepted:g}" if one.accepted else ""
            reference = one.reference.removesuffix(
                ", plan view"
            )  # as all footprints: a rule of the page
            invalid = one.invalid.replace(UNKNOWN, "obstacles unknown")
            said = (
                one.formula or one.help,
                reference,
                one.unit,
                better,
                one.aggregation,
                accepted,
                invalid,
            )
            names.setdefault(said, []).append(f"`{name}`")
    return _table(HEAD, ((", ".join(some), *said) for said, some in names.items()))


def score_table() -> str:
    """Return the table of other benchmarks' scores and their parts; the bounds of a score share its
    row.
    """
    bound = re.compile("_(least|most)$")
    rows = []
    for name, one in BENCHMARKS.items():
        if not bound.search(name):
            rows.append(
                (", ".join(f"`{it}`" for it in BENCHMARKS if bound.sub("", it) == name), one.help)
            )
    return _table(SCORES_HEAD, rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, ("---",) * len(head), *rows))


def main(folder: Path) -> None:
    """Rewrite the tables between the marks of the page in a folder."""
    text = (folder / PAGE).read_text(encoding="utf-8")
    for begin, table in ((BEGIN, metric_table()), (BEGIN_SCORES, score_table())):
        head, rest = text.split(begin)
        end = rest.index(END)
        text = head + begin + table + rest[end:]
    (folder / PAGE).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
