"""``simrun train adapt``: train a fixer a little further on one recorded street's own photographs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.printing import say_document
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.cli import training_options as options
from alpasim_plugin.lab.training.adapt import adapt as adapt_to
from scenarios.load import load_scenario

EPILOG = """
Examples:

- `simrun train adapt street --out street/onefixer.safetensors`

- `simrun --renderer "onefixer[weights.bundle=street/onefixer.safetensors]" street/scenario.yaml`
"""


def adapt(
    drive: Annotated[
        Path, typer.Argument(help="Folder of an imported drive, or its scenario file.")
    ],
    out: Annotated[
        Path,
        typer.Option("--out", help="File for the new weights; written only where they are better."),
    ],
    weights: Annotated[
        Path | None, typer.Option("--weights", help="Bundle to begin with; what ships by default.")
    ] = None,
    updates: Annotated[
        int, typer.Option("--updates", min=1, help="Updates of the training, about a second each.")
    ] = 60,
    seed: options.Seed = 0,
    metric_weights: options.MetricWeights = None,
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Train the fixer a little further on a recorded street, and keep the weights only where
    held-out photographs gain.
    """
    del debug
    if out.exists():
        raise InputError(f"--out {out}: it exists", "name another file, or remove it")
    progress = options.Progress(updates, interval=10)
    scenario = load_scenario(str(drive / "scenario.yaml" if drive.is_dir() else drive))
    begin = weights or _shipped()
    done = adapt_to(
        scenario,
        begin,
        out,
        updates=updates,
        distance=progress.perceptual_term(metric_weights),
        seed=seed,
        report=progress.update,
    )
    gain_text = (
        f"{done.gain_db:+.2f} dB in the mean of {len(done.after)} held-out photographs, "
        f"{done.n_better} of which gain"
    )
    verdict = (
        f"accepted: {gain_text}; wrote {out}"
        if done.accepted
        else f"not accepted: {gain_text}; nothing is written, what you had is kept"
    )
    if as_json:
        say_document({**asdict(done), "weights": str(out) if done.accepted else None})
    else:
        Console().print(verdict, highlight=False, markup=False, soft_wrap=True)


def _shipped() -> Path:
    settings = fixer_settings("onefixer", [])
    assert isinstance(settings, PixelFixerSettings)
    assert settings.weights.bundle is not None
    return Path(settings.weights.bundle)
