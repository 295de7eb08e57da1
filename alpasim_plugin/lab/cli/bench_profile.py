"""``simrun bench profile``: where the next millisecond is."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

import typer

from alpasim_plugin.lab.bench.profile import PARTS, profile
from alpasim_plugin.lab.cli.bench_rows import print_rows

EPILOG = "Examples: `simrun bench profile`, `simrun bench profile raster --passes 20`."


def profiles(
    part: Annotated[
        Literal["all", "raster", "loop", "evaluators", "aggregation"],
        typer.Argument(help="Which hot part; all four by default."),
    ] = "all",
    passes: Annotated[
        int,
        typer.Option(
            "--passes", min=1, help="Frames, rollouts, scorings, tables; their mean is printed."
        ),
    ] = 3,
    top: Annotated[int, typer.Option("--top", min=1, help="Functions per part.")] = 10,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Print the functions that take most processor time in the rasteriser, the loop, the evaluators
    and the aggregation.

    Time in libraries counts for the function of ours that called them.
    """
    del debug
    wanted = PARTS if part == "all" else (part,)
    print_rows([asdict(row) for name in wanted for row in profile(name, passes)[:top]], as_json)
