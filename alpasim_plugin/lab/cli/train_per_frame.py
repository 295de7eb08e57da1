"""``simrun train per-frame``: train the per-frame generator from streams of pairs and video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import torch
import typer

from alpasim_plugin.cli.options import fixer_overrides
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.cli import training_options as options
from alpasim_plugin.lab.cli.image_sizes import parse_size
from alpasim_plugin.lab.training.pair_pack import pairs_folder
from alpasim_plugin.lab.training.pixel_run import PixelRun, train_per_frame
from alpasim_plugin.lab.training.pixel_variants import DEPLOYED, PIXEL_VARIANTS, pixel_variant
from alpasim_plugin.lab.training.streams import StreamShares, TrainingStreams
from alpasim_plugin.lab.training.trainer import Schedule

WITHOUT_VIDEO = StreamShares(pairs=0.93, identity=0.07, video=0.0, damaged_video=0.0)
EPILOG = """
Examples:

- `simrun train per-frame data/pairs --video data/video --out runs/s --steps 20000 --decay-from 16000`

- `simrun train per-frame data/pairs --out runs/s2 --init runs/s/state.safetensors --warmup 0`: further, on other data
"""


Video = Annotated[
    Path | None, typer.Option("--video", help="Folder of driving video (docs/lab/training.md).")
]
Sequences = Annotated[
    int | None,
    typer.Option("--sequences", min=1, help="Only the first N sequences, in order of generation."),
]
DecayFrom = Annotated[
    int | None,
    typer.Option(
        "--decay-from",
        min=1,
        help="Update at which the learning rate begins to fall; by default at 4/5.",
    ),
]
StopAt = Annotated[
    int | None,
    typer.Option("--stop-at", min=1, help="Stop after this update and write the weights."),
]
Warmup = Annotated[
    int,
    typer.Option("--warmup", min=0, help="Updates of rising learning rate; 0 where a run goes on."),
]
Ema = Annotated[
    float,
    typer.Option("--ema", min=0.0, max=0.99999, help="Decay of the averaged (EMA) weights."),
]
Streams = Annotated[int, typer.Option("--streams", min=1, help="Streams of frames in a batch.")]
Frames = Annotated[
    int,
    typer.Option("--frames", min=2, help="Frames of an update: k, that gradients pass through."),
]
Episode = Annotated[
    int, typer.Option("--episode", min=1, help="Updates that a stream stays with a sequence.")
]
Crop = Annotated[str, typer.Option("--crop", help="WIDTHxHEIGHT of a crop, multiples of 16.")]
Perceptual = Annotated[
    float, typer.Option("--perceptual", min=0.0, help="Weight of the perceptual term.")
]
Temporal = Annotated[
    float, typer.Option("--temporal", min=0.0, help="Weight of the frames' differences.")
]
Flow = Annotated[
    float, typer.Option("--flow", min=0.0, help="Weight of flow matching below t = 1.")
]
Grid = Annotated[
    float,
    typer.Option(
        "--grid", min=0.0, help="Weight of the term against patterns of the network's grid."
    ),
]
Variant = Annotated[
    str,
    typer.Option("--variant", help=f"Row of the paper's ablation: {', '.join(PIXEL_VARIANTS)}."),
]
Init = Annotated[
    Path | None, typer.Option("--init", help="Another run's state.safetensors, or a bundle.")
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="A setting of that fixer: fixer.key=value.")
]
SaveEvery = Annotated[int, typer.Option("--save-every", min=1, help="Updates between checkpoints.")]
KeepEvery = Annotated[
    int,
    typer.Option("--keep-every", min=0, help="Updates between bundles that are kept; 0: the last."),
]
Precision = Annotated[
    Literal["fp32", "bf16"], typer.Option("--precision", help="Of the forward passes.")
]


def per_frame(
    data: options.Pairs,
    out: options.RunFolder,
    video: Video = None,
    sequences: Sequences = None,
    steps: options.Steps = 20_000,
    decay_from: DecayFrom = None,
    stop_at: StopAt = None,
    lr: options.PeakLr = 1e-3,
    warmup: Warmup = 100,
    ema: Ema = 0.998,
    streams: Streams = 6,
    frames: Frames = 4,
    episode: Episode = 12,
    crop: Crop = "128x96",
    perceptual: Perceptual = 0.1,
    temporal: Temporal = 0.25,
    flow: Flow = 0.25,
    grid: Grid = 0.01,
    variant: Variant = DEPLOYED,
    init: Init = None,
    fixer: Annotated[str, typer.Option("--fixer", help="Fixer that gives the sizes.")] = "onefixer",
    overrides: Overrides = None,
    save_every: SaveEvery = 200,
    keep_every: KeepEvery = 1000,
    precision: Precision = "fp32",
    device: options.Device = "cpu",
    threads: options.Threads = None,
    seed: options.Seed = 0,
    metric_weights: options.MetricWeights = None,
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Train the per-frame generator; writes OUT/fixer.safetensors (averaged weights, float16) and
    its card.

    The learning rate is constant until --decay-from; until then --steps and --decay-from may be
    changed, so that a run can be prolonged.
    """
    del debug
    options.use_threads(threads)
    progress = options.Progress(steps, interval=25)
    width, height = parse_size(crop, "--crop", 16)
    shares = StreamShares() if video is not None else WITHOUT_VIDEO
    source = TrainingStreams(
        pairs_folder(data, out),
        None if video is None else pairs_folder(video, out),
        seed=seed,
        batch=streams,
        frames=frames,
        crop=(height, width),
        episode=episode,
        shares=shares,
        count=sequences,
    )
    schedule = Schedule(
        steps,
        peak_lr=lr,
        warmup=warmup,
        clip=0.5,
        ema=ema,
        save_every=save_every,
        decay_from=decay_from or max(4 * steps // 5, 1),
    )
    chosen_variant = pixel_variant(variant).weighted(
        perceptual, temporal, flow, grid, horizon=frames
    )
    needs_distance = any(stage.perceptual for stage in chosen_variant.stages)
    distance = progress.perceptual_term(metric_weights, device) if needs_distance else None
    dtype = torch.bfloat16 if precision == "bf16" else None
    run = PixelRun(
        pixel_settings(fixer, overrides or []),
        source,
        chosen_variant,
        schedule,
        init,
        seed,
        dtype,
        keep_every,
        device,
    )
    progress.wrote(train_per_frame(run, out, distance, stop_at, progress.update), as_json)


def pixel_settings(fixer: str, overrides: Sequence[str]) -> PixelFixerSettings:
    """Return the settings of a generator in pixels, without the weights that it ships with.

    Raises:
        InputError: Unknown, or another kind of fixer.
    """
    settings = fixer_settings(fixer, ["weights.bundle=null", *fixer_overrides(overrides)])
    if not isinstance(settings, PixelFixerSettings):
        raise InputError(
            f"--fixer {fixer}: it is no generator in pixels",
            "choose onefixer; 'simrun train fixer' trains the block generators",
        )
    return settings
