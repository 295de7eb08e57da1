"""``simrun bench evaluators``: time of the evaluators beside their disagreement with two slower
ways.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.aggregation import TableRow, bench_table
from alpasim_plugin.lab.bench.evaluators import BenchRow, bench_evaluators

EPILOG = "Example: `simrun bench evaluators --actors 10,40 --steps 200`"


def evaluators(
    actors: Annotated[
        str, typer.Option("--actors", help="Numbers of other road users, comma-separated.")
    ] = "10,40,200",
    steps: Annotated[
        str, typer.Option("--steps", help="Numbers of logged steps, comma-separated.")
    ] = "200,900",
    repeats: Annotated[
        int, typer.Option("--repeats", min=1, help="Runs of ours per row; the least is printed.")
    ] = 5,
    reference: Annotated[
        bool,
        typer.Option(
            "--reference/--no-reference",
            help="Also run the exact reference, which takes most of the time.",
        ),
    ] = True,
    rollouts: Annotated[
        int,
        typer.Option("--rollouts", min=0, help="Rows of the table to aggregate; 0 leaves it out."),
    ] = 100_000,
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Scenes in that table.")] = 1_000,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown table.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Time contact and lane keeping against a search step by step and the exact reference, and
    count disagreements; time a large table.

    Times are CPU times. "reference steps" is how many of the steps the exact reference looked at,
    "reference ms" its time for these.
    """
    del debug
    rows = bench_evaluators(
        _counts("--actors", actors), _counts("--steps", steps), repeats, reference
    )
    tables = [bench_table(rollouts, scenes)] if rollouts else []
    if as_json:
        print(
            json.dumps(
                {
                    "evaluators": [asdict(row) for row in rows],
                    "aggregate": [asdict(row) for row in tables],
                }
            )
        )
        return
    for heads, lines in ((HEADS, rows), (TABLE_HEADS, tables)):
        if lines:
            _print(heads, [_cells(row) for row in lines], markdown)


HEADS = (
    *(
        "part",
        "actors",
        "steps",
        "hits",
        "ours ms",
        "per step ms",
        "ratio",
        "reference steps",
        "reference ms",
        "differ: per step",
        "differ: reference",
        "gap error m",
    ),
    *("same scene again ms", "between steps ms", "score ms"),
)


TABLE_HEADS = (
    "rollouts",
    "scenes",
    "metrics",
    "read s",
    "aggregate s",
    "by rows s",
    "peak MB",
    "mean error",
    "wrong counts",
)


def _print(heads: tuple[str, ...], lines: list[list[str]], markdown: bool) -> None:
    if markdown:
        print(
            "\n".join(
                "| " + " | ".join(line) + " |" for line in (heads, ["---"] * len(heads), *lines)
            ),
            end="\n\n",
        )
        return
    table = Table(box=None, header_style="bold")
    for head in heads:
        table.add_column(head, justify="right")
    for line in lines:
        table.add_row(*line)
    Console().print(table)


def _cells(row: BenchRow | TableRow) -> list[str]:
    return [
        "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
        for value in asdict(row).values()
    ]


def _counts(option: str, text: str) -> list[int]:
    try:
        values = [int(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not values or min(values) < 1:
        raise InputError(
            f"{option} {text}: not a list of positive numbers",
            "write for example 10,40,200",
        )
    return values
