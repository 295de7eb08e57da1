"""``simrun bench fixer``: time and error of a fixer, setting by setting."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table

from alpasim_plugin.cli.options import fixer_overrides
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.fixer import bench_fixer
from alpasim_plugin.lab.bench.fixer_rows import Bench, BenchOptions, Row
from alpasim_plugin.lab.bench.fixer_table import (
    HEAD,
    MARKERS,
    cells,
    markdown,
    plot,
    put_between_marks,
)
from alpasim_plugin.lab.cli.image_sizes import parse_size

PAGE, PICTURE = Path("docs/experiments/speed.md"), Path("docs/img") / "speed.png"
EPILOG = """
Examples:

- `simrun bench fixer --quick`

- `simrun bench fixer --set fixer.weights.bundle=trained.safetensors --sizes 256x144,480x272 --out bench`
"""


def fixer(
    name: Annotated[
        str, typer.Option("--fixer", help="A fixer of the onefixer family, or NAME@STEPS.")
    ] = "onefixer",
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="A setting in force for every row: fixer.key=value."),
    ] = None,
    sizes: Annotated[
        str, typer.Option("--sizes", help="Image sizes, comma-separated.")
    ] = "256x144",
    frames: Annotated[
        int,
        typer.Option("--frames", min=13, help="Least length of the drive; blocks are completed."),
    ] = 69,
    passes: Annotated[
        int, typer.Option("--passes", min=1, help="Runs over the drive per row.")
    ] = 3,
    quick: Annotated[
        bool, typer.Option("--quick", help="21 frames, one pass, without the slow networks.")
    ] = False,
    only: Annotated[
        str,
        typer.Option("--only", help=f"Groups of settings, comma-separated: {', '.join(MARKERS)}."),
    ] = "",
    seed: Annotated[
        int,
        typer.Option("--seed", min=0, help="Seed of the drive, the noise and stand-in weights."),
    ] = 0,
    device: Annotated[
        Literal["cpu", "cuda"], typer.Option("--device", help="Where the fixer computes.")
    ] = "cpu",
    threads: Annotated[
        int | None, typer.Option("--threads", min=1, help="Torch threads; by default one per core.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for table.md, rows.json and plot.png.")
    ] = None,
    docs: Annotated[
        bool,
        typer.Option(
            "--docs", help=f"Also write the table into {PAGE} and the plot into {PICTURE}."
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Time a fixer's stages setting by setting, with the error of the same images beside it.

    Rounding is the error against the same setting in float32 over the whole clip at once; model is
    the error against the base setting with a window over the whole clip.
    """
    del debug
    if docs and not PAGE.is_file():
        raise InputError(
            f"{PAGE}: no such file",
            "run it at the root of the repository",
        )
    own = tuple(fixer_overrides(overrides or []))
    options = BenchOptions(
        name, own, device, threads, 1 if quick else passes, quick, parse_groups(only), seed
    )
    measured_sizes = [parse_size(size, "--sizes") for size in sizes.split(",")]
    bench = bench_fixer(
        options,
        measured_sizes,
        21 if quick else frames,
        (lambda row: None) if as_json else _print_row,
    )
    document = as_document(bench)
    if out is not None:
        write_results(bench, out)
    if docs:
        page = put_between_marks(
            PAGE.read_text(), "table", f"{markdown(bench.rows)}\n{machine_line(bench.facts)}"
        )
        PAGE.write_text(page)
        plot(bench.rows, PICTURE)
    if as_json:
        print(json.dumps(document))
        return
    table = Table(box=None, header_style="bold")
    for title in HEAD:
        table.add_column(title, justify="left" if title in HEAD[:2] else "right", no_wrap=True)
    for row in bench.rows:
        table.add_row(*cells(row))
    console = Console()
    # Cells that are cut off cannot be read; a line that is too long for a terminal can be scrolled
    # to, or read in --out.
    console.width = max(console.width, Console(width=1000).measure(table).maximum)
    console.print(table)
    print(machine_line(bench.facts))


def parse_groups(text: str) -> tuple[str, ...]:
    """Return the groups of settings that are named; none for all.

    Raises:
        InputError: A group that is not known.
    """
    groups = tuple(part.strip() for part in text.split(",") if part.strip())
    unknown = [group for group in groups if group not in MARKERS]
    if unknown:
        raise InputError(
            f"--only {text}: no group {unknown[0]!r}",
            f"known: {', '.join(MARKERS)}",
        )
    return groups


def as_document(bench: Bench) -> dict[str, Any]:
    """Return everything measured, for JSON."""
    return {"facts": bench.facts, "rows": [asdict(row) for row in bench.rows]}


def write_results(bench: Bench, folder: Path) -> None:
    """Write ``table.md``, ``rows.json`` and ``plot.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "table.md").write_text(f"{markdown(bench.rows)}\n{machine_line(bench.facts)}\n")
    (folder / "rows.json").write_text(json.dumps(as_document(bench), indent=1))
    plot(bench.rows, folder / "plot.png")


def machine_line(facts: dict[str, Any]) -> str:
    """Return one line on the fixer, the machine and its load."""
    where = (
        facts.get("accelerator")
        or f"{facts['hardware']['cpu']}, {facts['threads']} thread(s) on {facts['hardware']['cores']} cores"
    )
    before, after = facts["load_before_after"]
    chosen = f" with {', '.join(facts['overrides'])}" if facts["overrides"] else ""
    return (
        f"{facts['fixer']}{chosen}, {facts['scene']}, torch {facts['versions']['torch']}, {where}; "
        f"load average of the machine {before} before and {after} after."
    )


def _print_row(row: Row) -> None:
    """Report a finished row on standard error."""
    ms = "not measured" if row.problem else f"{row.ms['all-in'][0]:.1f} ms a frame"
    print(f"{row.size[0]}x{row.size[1]} {row.group}: {row.name}, {ms}", file=sys.stderr, flush=True)
