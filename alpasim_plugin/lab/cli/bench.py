"""``simrun bench``: quality of fixers and renderers, the time of a frame of the loop, and the paper's
comparison.
"""

from __future__ import annotations

import typer

from alpasim_plugin.lab.cli import bench_loop, bench_paper, bench_quality, bench_real

app = typer.Typer(no_args_is_help=True, help="Measure quality and speed of fixers and renderers.")


@app.callback()
def bench() -> None:
    """Measure quality and speed of fixers and renderers."""


app.command("quality", epilog=bench_quality.EPILOG)(bench_quality.quality)
app.command("real", epilog=bench_real.EPILOG)(bench_real.real)
app.command("loop", epilog=bench_loop.EPILOG)(bench_loop.loop)
app.command("paper", epilog=bench_paper.EPILOG)(bench_paper.paper)
