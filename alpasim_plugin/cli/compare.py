"""``simrun compare``: paired differences within a run or between two runs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from alpasim_plugin.errors import InputError
from evaluators.gate.across import Comparison, compare_runs, compare_within
from evaluators.gate.spec import load_gate
from evaluators.report.metric_info import HEADLINE
from evaluators.report.run_folder import read_run
from evaluators.report.tables import PairRow, pair_rows

EPILOG = """
Examples:

- `simrun compare runs/nightly --baseline clean`

- `simrun compare runs/main runs/change`: the second run minus the first, on shared cells

- `simrun compare runs/main runs/change --gate configs/gates/default.yaml --json`
"""
EVERY_MISSING = 10**9
SHOWN_MISSING = 10


def compare(
    runs: Annotated[list[Path], typer.Argument(help="One run folder, or two: the second is compared with the first.")],
    baseline: Annotated[str | None, typer.Option("--baseline", help="Renderer to compare with (of the first run).")] = None,
    gate: Annotated[str | None, typer.Option("--gate", help="Take the margins from this gate file.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Print every metric, not only the headline ones.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Print paired differences on shared scene-seed cells, with verdicts; cells without a pair are listed."""
    del debug
    if len(runs) > 2:
        raise InputError("comparing runs", f"{len(runs)} folders", "more than two", "name one run, or two")
    margins: dict[str, float] = {}
    if gate is not None:
        margins = {name: rule.margin for name, rule in load_gate(gate)[0].metrics.items() if rule.margin is not None}
    found = [read_run(run) for run in runs]
    listed = EVERY_MISSING if as_json else SHOWN_MISSING
    result = (
        compare_within(found[0], baseline, margins, listed)
        if len(found) == 1
        else compare_runs(found[0], found[1], baseline, margins, listed)
    )
    if as_json:
        print(json.dumps({"runs": [str(run) for run in runs], "notes": list(result.notes), "paired": result.paired}))
        return
    _print(result, [*HEADLINE, *margins] if not every else None)


def _print(result: Comparison, only: Sequence[str] | None) -> None:
    console = Console()
    for note in result.notes:
        print(f"note: {note}")
    rows = [row for row in pair_rows({"paired": result.paired}) if only is None or row.metric in only]
    for arm in result.paired:
        mine = [row for row in rows if row.arm == arm]
        if mine:
            console.print(_table(arm, mine, result.paired[arm]))
        for line in _missing(result.paired[arm]):
            print(line)


def _table(arm: str, rows: Sequence[PairRow], entries: Mapping[str, Mapping[str, Any]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=f"{arm} minus {rows[0].baseline}", title_justify="left")
    for head in ("metric", "difference", "95 %", "p", "margin", "pairs", "verdict"):
        table.add_column(head, justify="left" if head in ("metric", "verdict") else "right", overflow="fold")
    for row in rows:
        entry = entries[row.metric]
        more = entry["more_scenes"]
        verdict = f"{entry['verdict']}, about {more} more scenes" if more else str(entry["verdict"])
        if entry["difference"] == "better":
            verdict += " (better)"
        pairs = f"{entry['n_cells']} in {entry['n_scenes']}"
        cells = [row.metric, row.diff.text, row.interval.text, row.p_value.text, f"{entry['margin']:g}", pairs, verdict]
        table.add_row(*(Text(cell.replace("\u00a0", " ")) for cell in cells))
    return table


def _missing(entries: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Name cells without a pair once, with the metrics that lack them."""
    lacking: dict[tuple[Any, ...], list[str]] = {}
    most = 0
    for metric, entry in entries.items():
        most = max(most, entry["n_missing"])
        for cell in entry["missing"]:
            lacking.setdefault((cell["policy"], cell["scene"], cell["seed"], cell["why"]), []).append(metric)
    lines = []
    for (policy, scene, seed, why), metrics in list(lacking.items())[:SHOWN_MISSING]:
        which = "every metric" if len(metrics) == len(entries) else ", ".join(metrics[:3]) + (", ..." if len(metrics) > 3 else "")
        lines.append(f"no pair: {policy}, {scene}, seed {seed}: {which}: {why}")
    if len(lacking) > SHOWN_MISSING or most > SHOWN_MISSING:
        lines.append("more cells have no pair: --json lists all")
    return lines
