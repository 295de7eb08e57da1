"""``simrun bench loop``: what a frame costs behind each renderer, and what a user waits for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.printing import say_document

EPILOG = (
    "Examples: `simrun bench loop`, `simrun bench loop --renderer 3dgs,onefixer@2 --out loop.json`"
)


def loop(
    renderers: Annotated[
        str, typer.Option("--renderer", help="Renderers to drive behind, comma-separated.")
    ] = "clean,3dgs,onefixer",
    repeats: Annotated[
        int, typer.Option("--repeats", min=1, help="Equal drives and commands; the fastest counts.")
    ] = 3,
    seconds: Annotated[float, typer.Option("--seconds", min=0.5, help="Of each drive.")] = 6.0,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the record, with ratios, to this JSON file.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Time a frame of the closed loop by stage, start, one rollout and report, beside the error and
    a fixed piece of work.
    """
    del debug
    # Imported on use: it loads torch.
    from alpasim_plugin.lab.bench.loop import bench_loop, markdown

    record = bench_loop(renderers.split(","), repeats, seconds)
    if out is not None:
        write_json(out, record)
    if as_json:
        say_document(record)
    else:
        print(markdown(record))
