"""The table of metrics in docs/metrics.md, from the metrics themselves: ``python docs/scripts/metrics_page.py``."""

from __future__ import annotations

from pathlib import Path

from evaluators.metrics.table import METRICS

PAGE = Path(__file__).resolve().parents[1] / "metrics.md"
BEGIN, END = "<!-- metrics: made by python docs/scripts/metrics_page.py -->\n", "<!-- end of metrics -->\n"
HEAD = ("metric", "per step", "measured at", "unit", "better", "over a rollout", "accepted", "invalid")


def metric_table() -> str:
    """Return the table: one metric a row, in the order in which reports show them."""
    rows = []
    for name in METRICS.ordered(METRICS):
        one = METRICS[name]
        better = {"none": "neither"}.get(one.direction, one.direction)
        accepted = f"{one.accepted:g}" if one.accepted else ""
        rows.append((f"`{name}`", one.formula or one.help, one.reference, one.unit, better, one.aggregation, accepted, one.invalid))
    return "".join(f"| {' | '.join(row)} |\n" for row in (HEAD, ("---",) * len(HEAD), *rows))


def main() -> None:
    """Rewrite the table between the marks of the page."""
    head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    PAGE.write_text(head + BEGIN + metric_table() + END + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
