"""``simrun bench``: speed, never without the error beside it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from alpasim_plugin.lab.bench.raster import bench_raster
from alpasim_plugin.lab.cli import (
    bench_evaluators,
    bench_fixer,
    bench_loop,
    bench_presets,
    bench_profile,
    bench_real,
    bench_roofline,
    bench_serve,
)
from alpasim_plugin.lab.cli.bench_paper import EPILOG as PAPER_EXAMPLES
from alpasim_plugin.lab.cli.bench_paper import paper
from alpasim_plugin.lab.cli.bench_rows import print_rows
from alpasim_plugin.lab.cli.quality import EPILOG as QUALITY_EXAMPLES
from alpasim_plugin.lab.cli.quality import quality

app = typer.Typer(no_args_is_help=True, help="Measure speed and error of parts.")


@app.callback()
def bench() -> None:
    """Measure speed and error of parts."""


app.command("evaluators", epilog=bench_evaluators.EPILOG)(bench_evaluators.evaluators)
app.command("loop", epilog=bench_loop.EPILOG)(bench_loop.loop)
app.command("presets", epilog=bench_presets.EPILOG)(bench_presets.presets)
app.command("fixer", epilog=bench_fixer.EPILOG)(bench_fixer.fixer)
app.command("profile", epilog=bench_profile.EPILOG)(bench_profile.profiles)
app.command("real", epilog=bench_real.EPILOG)(bench_real.real)
app.command("roofline", epilog=bench_roofline.EPILOG)(bench_roofline.roofline)
app.command("serve", epilog=bench_serve.EPILOG)(bench_serve.serve)
app.command("quality", epilog=QUALITY_EXAMPLES)(quality)
app.command("paper", epilog=PAPER_EXAMPLES)(paper)


@app.command(
    "raster",
    epilog="Examples: `simrun bench raster --repeats 20`, `simrun bench raster --gradients`",
)
def raster(
    gradients: Annotated[
        bool,
        typer.Option("--gradients", help="Time the forward and backward pass of training instead."),
    ] = False,
    repeats: Annotated[
        int, typer.Option("--repeats", min=3, help="Frames per row; medians are printed.")
    ] = 15,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Time the CPU rasteriser on a random street and compare its image, or its gradients, with
    float64.
    """
    del debug
    if gradients:
        # Imported on use: it loads torch.
        from alpasim_plugin.lab.bench.raster_gradient import bench_gradients

        rows = [asdict(row) for row in bench_gradients(repeats=repeats)]
    else:
        rows = [asdict(row) for row in bench_raster(repeats=repeats)]
    print_rows(rows, as_json)
