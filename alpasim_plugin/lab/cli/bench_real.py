"""``simrun bench real``: renderers and fixers measured by the photographs of imported drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.parts import RendererSpec, resolve_renderer, split_names
from alpasim_plugin.core.printing import say_document
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.lab.bench.colour_video_vdp import load_metric
from alpasim_plugin.lab.bench.real import (
    Judges,
    Row,
    intervals,
    measure_drive,
    unseen_cameras,
)
from alpasim_plugin.lab.cli.bench_rows import print_rows
from alpasim_plugin.lab.video_metrics.image_distance import load_distance
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME
from alpasim_plugin.runs.renderer import make_renderer
from scenarios.load import load_scenario

EPILOG = """
Examples:

- `simrun bench real runs/street --renderer 3dgs,onefixer`

- `simrun bench real runs/street runs/avenue --renderer 3dgs,onefixer --json`: with intervals over the drives
"""
EVERY = 10  # frames between lines of progress


def real(
    drives: Annotated[
        list[Path], typer.Argument(help="Folders of imported drives, or their scenario files.")
    ],
    renderers: Annotated[
        str, typer.Option("--renderer", help="Comma-separated renderers and fixers.")
    ] = "3dgs,onefixer",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the fixers' noise.")] = 0,
    device: Annotated[
        Literal["cpu", "cuda"], typer.Option("--device", help="Where to render and to fix.")
    ] = "cpu",
    threads: Annotated[
        int | None,
        typer.Option("--threads", min=1, help="Threads of the rasteriser; by default all cores."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Compare renderers with photographs that no fit saw: on the recorded path, and beside it with
    a second camera.

    PSNR, SSIM, perceptual-syn, ColorVideoVDP (where cvvdp is installed), Warp L1, and precision and
    recall of lane markings.
    """
    del debug
    specs = {name: resolve_renderer(name) for name in _names(renderers)}
    scenarios = _loaded(drives)
    for scenario in scenarios.values():
        unseen_cameras(scenario)  # what cannot be measured is refused before anything is rendered
    vdp, why_not = load_metric()
    judges = Judges(load_distance(NAME), vdp)
    console = Console(stderr=True)
    if why_not:
        console.print(why_not, highlight=False)
    rows: list[Row] = []
    for name, scenario in scenarios.items():
        makers = {
            part: _maker(spec, scenario, seed, device, threads) for part, spec in specs.items()
        }
        rows += measure_drive(name, scenario, makers, judges, partial(_tell, console, name))
    over = intervals(rows)
    if len(scenarios) == 1:
        console.print(
            "one drive: no interval; how these numbers vary from drive to drive is not known",
            highlight=False,
        )
    if as_json:
        say_document({"rows": rows, **({"intervals": over} if over else {})})
        return
    print_rows(rows, False)
    if over:
        print_rows([{**row, "median_ci95": _range_text(row["median_ci95"])} for row in over], False)


def _range_text(bounds: Sequence[float] | None) -> str | None:
    return None if bounds is None else "{:.3g} to {:.3g}".format(*bounds)


def _loaded(drives: Sequence[Path]) -> dict[str, Scenario]:
    out: dict[str, Scenario] = {}
    for drive in drives:
        file = drive / "scenario.yaml" if drive.is_dir() else drive
        name = file.parent.name
        if name in out:
            raise InputError(
                f"{drive}: two drives called {name!r}",
                "name each folder once, and give folders different names",
            )
        out[name] = load_scenario(str(file))
    return out


def _names(text: str) -> list[str]:
    names = split_names(text)
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"--renderer {text}: no renderer, or one twice",
            "write for example 3dgs,onefixer",
        )
    return names


def _maker(
    spec: RendererSpec, scenario: Scenario, seed: int, device: str, threads: int | None
) -> Callable[[], Renderer]:
    return lambda: make_renderer(spec, scenario, seed, device, threads)


def _tell(console: Console, drive: str, subject: str, done: int, all: int) -> None:
    if done % EVERY == 0 or done == all:
        console.print(f"{drive}: {subject}: {done}/{all}", highlight=False)
