"""``simrun bench serve``: load on the renderer service."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

import typer

from alpasim_plugin.alpasim.server.assembly import Settings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.serve import bench_serve, soak
from alpasim_plugin.lab.cli.bench_rows import print_rows
from alpasim_plugin.lab.cli.image_sizes import parse_size

SIDE = 16

EPILOG = """
Examples:

- `simrun bench serve --size 512x320 --rollouts 1,4,16`

- `simrun bench serve --soak 10000 --size 128x80 --history-mb 64`: many frames at constant memory

- `simrun bench serve --device cuda --renderer onefixer --size 1920x1080`
"""


def serve(
    renderer: Annotated[
        str, typer.Option("--renderer", help="A fixer of single frames.")
    ] = "onefixer",
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting of the fixer; repeatable."),
    ] = None,
    size: Annotated[
        str, typer.Option("--size", help="Width x height of the frames, multiples of 16.")
    ] = "512x320",
    rollouts: Annotated[
        str, typer.Option("--rollouts", help="Numbers of concurrent rollouts.")
    ] = "1,4,16",
    frames: Annotated[int, typer.Option("--frames", min=2, help="Frames of a rollout.")] = 24,
    soak_frames: Annotated[
        int,
        typer.Option("--soak", min=0, help="Instead: answer so many frames and watch the memory."),
    ] = 0,
    history_mb: Annotated[
        int,
        typer.Option("--history-mb", min=1, help="Most memory of the histories, MiB, in the soak."),
    ] = 256,
    device: Annotated[
        Literal["cpu", "cuda"], typer.Option("--device", help="Where to fix.")
    ] = "cpu",
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Torch threads.")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Measure requests a second, the time that the fixer adds to a request over handing it on, and
    whether answers stay equal.

    A renderer that paints stripes stands behind; all rollouts come over one connection. `unequal`
    counts answers that differ from what the same rollout gets alone: it must be 0.
    """
    del debug
    settings = Settings(
        renderer, tuple(set_ or ()), device=device, threads=threads, history_bytes=history_mb << 20
    )
    shape = parse_size(size, multiple=SIDE)
    if soak_frames:
        rows = [asdict(soak(settings, soak_frames, shape))]
    else:
        rows = [asdict(row) for row in bench_serve(settings, parse_counts(rollouts), frames, shape)]
    print_rows(rows, as_json)


def parse_counts(text: str) -> list[int]:
    """Read ``1,4,16``."""
    parts = text.split(",")
    if not all(part.strip().isdigit() and 0 < int(part) <= 256 for part in parts):
        raise InputError(
            f"--rollouts {text}: no numbers from 1 to 256",
            "write for example 1,4,16",
        )
    return [int(part) for part in parts]
