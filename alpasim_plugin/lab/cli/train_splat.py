"""``simrun train splat``: reconstruct a scene with 3D Gaussians from views along its log, or from
given images.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.gaussians.fit import (
    PosedView,
    Reconstruction,
    SplatRecipe,
    Start,
    held_out,
    logged_views,
    start_from_depth,
)
from alpasim_plugin.gaussians.fit.loop import fit
from alpasim_plugin.gaussians.fit.photographs import read_views
from alpasim_plugin.gaussians.fit.quality import Comparison, compare, summary, write_pictures
from alpasim_plugin.gaussians.fit.start import start_in_boxes
from alpasim_plugin.gaussians.raster.rasterize_cpu import thread_count
from alpasim_plugin.gaussians.scene.degrade import log_actors
from alpasim_plugin.lab.cli.training_options import AsJson, Debug
from alpasim_plugin.renderers.gaussian import scene_of
from scenarios.load import load_scenario

EPILOG = "Example: `simrun train splat smoke/curve --out runs/curve-3dgs`"
ASIDE_M, ASIDE_VIEWS = 2.0, 8  # held-out views at a lateral offset from the drive
LINE_EVERY = 50
RECIPES: dict[str, Callable[[], SplatRecipe]] = {
    "full": SplatRecipe.full,
    "under-trained": SplatRecipe.under_trained,
}


def splat(
    scenario: Annotated[str, typer.Argument(help="Scenario: its log, cameras and tracks.")],
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the run; the same command resumes it.")
    ],
    recipe: Annotated[
        Literal["full", "under-trained"],
        typer.Option("--recipe", help="Default amounts and schedule."),
    ] = "full",
    steps: Annotated[
        int | None, typer.Option("--steps", min=1, help="Updates; the schedule scales with them.")
    ] = None,
    gaussians: Annotated[
        int | None,
        typer.Option(
            "--gaussians", min=1, help="Number of Gaussians at which densification stops."
        ),
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(
            "--views", min=1, help="Views rendered along the log, including held-out ones."
        ),
    ] = None,
    width: Annotated[
        int | None, typer.Option("--width", min=16, help="Width of rendered views, pixels.")
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            "--images", help="Folder of posed images (transforms.json) instead of rendered views."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, help="Seed of initialisation, order and splits.")
    ] = 0,
    device: Annotated[
        Literal["cpu", "cuda"], typer.Option("--device", help="cuda needs gsplat.")
    ] = "cpu",
    threads: Annotated[
        int | None,
        typer.Option("--threads", min=1, help="Threads of the rasteriser; by default all cores."),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Fit 3D Gaussians to posed views of a scenario: background, actors as rigid nodes, sky.

    Writes background.ply, actors/*.ply, sky.png, reconstruction.json, metrics.json and images of
    held-out views (ground truth left). --json prints metrics.json.
    """
    del debug
    # Tensors are small: torch threads gain little and mostly wait for each other on shared cores.
    torch.set_num_threads(1)
    chosen = _recipe(recipe, steps, gaussians, views, width, seed)
    loaded = load_scenario(scenario)
    began = time.perf_counter()
    train, kept, start = (
        _given(loaded, images, chosen) if images else _rendered(loaded, chosen, threads)
    )
    prepared_s, cpu_s = time.perf_counter() - began, time.process_time()
    with _progress(chosen.steps) as report:
        model = fit(
            train,
            start,
            chosen,
            scene_id=loaded.scene_id,
            folder=out,
            report=report,
            device=device,
            threads=threads,
        )
    fitted_s, cpu_s = time.perf_counter() - began - prepared_s, time.process_time() - cpu_s
    groups = {"train": train, "held_out": kept} | (
        {} if images else {"aside_2m": _aside(loaded, chosen, threads)}
    )
    facts = {
        "scene_id": loaded.scene_id,
        "recipe": {"name": recipe, **asdict(chosen)},
        "views": str(images or "rendered"),
        "prepare_s": round(prepared_s, 2),
        "fit_s": round(fitted_s, 2),
        "fit_cpu_s": round(cpu_s, 2),
        "threads": thread_count(threads),
        "device": device,
    }
    metrics = _measure(model, groups, out, threads)
    model.save(out, facts)
    write_json(out / "metrics.json", {**facts, "gaussians": len(model), **metrics})
    if as_json:
        print((out / "metrics.json").read_text(encoding="utf-8"), end="")
    _tell(model, metrics, fitted_s, out)


def _recipe(
    name: str,
    steps: int | None,
    gaussians: int | None,
    views: int | None,
    width: int | None,
    seed: int,
) -> SplatRecipe:
    base = RECIPES[name]()
    changes: dict[str, Any] = {
        key: v
        for key, v in {"steps": steps, "views": views, "width": width}.items()
        if v is not None
    }
    if gaussians is not None:
        changes |= {"cap": gaussians, "points": max(1, round(gaussians * base.points / base.cap))}
    return replace(base, seed=seed, **changes)


def _rendered(
    scenario: Scenario, recipe: SplatRecipe, threads: int | None
) -> tuple[list[PosedView], list[PosedView], Start]:
    views = logged_views(scenario, scene_of(scenario), recipe.views, recipe.width, threads=threads)
    train, kept = held_out(views, recipe.hold_out_every)
    boxes = {actor.actor_id: actor.box for actor in scenario.actors}
    return (
        train,
        kept,
        start_from_depth(
            train,
            boxes,
            recipe.points,
            scenario.scene_id,
            recipe.seed,
            recipe.actor_points,
            recipe.start_size,
        ),
    )


def _given(
    scenario: Scenario, folder: Path, recipe: SplatRecipe
) -> tuple[list[PosedView], list[PosedView], Start]:
    views, start = read_views(folder, partial(log_actors, scenario))
    if start is None:
        raise InputError(
            f"{folder}: no points to start from",
            "name a PLY of points in transforms.json as 'ply_file_path' (structure from motion or LiDAR)",
        )
    train, kept = held_out(views, recipe.hold_out_every)
    seen = {name for view in train for name in view.actors}
    boxes = {actor.actor_id: actor.box for actor in scenario.actors if actor.actor_id in seen}
    return (
        train,
        kept,
        Start(start, start_in_boxes(boxes, recipe.actor_points, scenario.scene_id, recipe.seed)),
    )


def _aside(scenario: Scenario, recipe: SplatRecipe, threads: int | None) -> list[PosedView]:
    return logged_views(
        scenario, scene_of(scenario), ASIDE_VIEWS, recipe.width, aside_m=ASIDE_M, threads=threads
    )


def _measure(
    model: Reconstruction, groups: Mapping[str, Sequence[PosedView]], out: Path, threads: int | None
) -> dict[str, Any]:
    graph, metrics = model.graph(), {}
    for name, views in groups.items():
        if views:
            rows: list[Comparison] = compare(graph, views, threads)
            metrics[name] = summary(rows)
            if name != "train":
                write_pictures(out / name, rows)
    return metrics


def _tell(model: Reconstruction, metrics: Mapping[str, Any], fitted_s: float, out: Path) -> None:
    console = Console(stderr=True)
    for name, m in metrics.items():
        console.print(
            f"{name}: PSNR {m['psnr_db']:.2f} dB, SSIM {m['ssim']:.3f} over {m['views']} views",
            highlight=False,
        )
    console.print(
        f"{len(model)} Gaussians, {len(model.actors)} actors, fitted in {fitted_s:.1f} s -> {out}",
        highlight=False,
    )


@contextmanager
def _progress(steps: int) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """Show a progress bar on a terminal, a line every 50 steps otherwise."""
    if not sys.stderr.isatty():

        def line(step: int, numbers: Mapping[str, float]) -> None:
            if step % LINE_EVERY == 0 or step == steps:
                print(f"{step}/{steps} {_words(numbers)}", file=sys.stderr, flush=True)

        yield line
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("fitting", total=steps)

        def advance(step: int, numbers: Mapping[str, float]) -> None:
            bar.update(task, completed=step, description=_words(numbers))

        yield advance


def _words(numbers: Mapping[str, float]) -> str:
    return f"loss {numbers['loss']:.4f}, {numbers['psnr_db']:.1f} dB, {numbers['gaussians']:.0f} Gaussians"
