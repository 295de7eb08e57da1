"""``simrun train``: training data and networks."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.block_fixers.codec_weights import LatentStats
from alpasim_plugin.block_fixers.networks import load_tiny_vae
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.lab.cli import train_pairs, train_scenes
from alpasim_plugin.lab.cli.train_arms import EPILOG as ARMS_EXAMPLES
from alpasim_plugin.lab.cli.train_arms import arms
from alpasim_plugin.lab.cli.train_decoder import EPILOG as DECODER_EXAMPLE
from alpasim_plugin.lab.cli.train_decoder import decoder
from alpasim_plugin.lab.cli.train_fixer import (
    memory_command,
    onefixer_settings,
    train_fixer_command,
)
from alpasim_plugin.lab.cli.train_judge import EPILOG as JUDGE_EXAMPLES
from alpasim_plugin.lab.cli.train_judge import judge
from alpasim_plugin.lab.cli.train_per_frame import EPILOG as PER_FRAME_EXAMPLES
from alpasim_plugin.lab.cli.train_per_frame import per_frame
from alpasim_plugin.lab.cli.train_perceptual import EPILOG as PERCEPTUAL_EXAMPLE
from alpasim_plugin.lab.cli.train_perceptual import perceptual
from alpasim_plugin.lab.cli.train_perceptual_check import CHECK_EPILOG, perceptual_check
from alpasim_plugin.lab.cli.train_policy import (
    POLICY_DATA_EPILOG,
    POLICY_EPILOG,
    policy,
    policy_data,
)
from alpasim_plugin.lab.cli.train_splat import EPILOG as SPLAT_EXAMPLE
from alpasim_plugin.lab.cli.train_splat import splat
from alpasim_plugin.lab.cli.train_transfer import (
    PHOTOGRAPHS_EPILOG,
    TRANSFER_EPILOG,
    photographs,
    transfer,
)
from alpasim_plugin.lab.cli.train_video import VIDEO_EPILOG, video
from alpasim_plugin.lab.cli.training_options import AsJson, Debug, Progress, RunFolder, Seed, Steps
from alpasim_plugin.lab.training.clips import read_video, to_tensor
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence
from alpasim_plugin.lab.training.trainer import Schedule, Trainer
from alpasim_plugin.lab.training.vae import VaeRecipe, VaeTask, measure_stats
from alpasim_plugin.lab.training.vae_quality import quality, round_trip

app = typer.Typer(no_args_is_help=True, help="Make training data and train networks.")
WIDTH, HEIGHT = 256, 144

EXAMPLE = "Example: `simrun train fixer data/pairs --size 256x144 --vae vae.safetensors --init runs/base/fixer.safetensors --out runs/v9`"
app.command("per-frame", epilog=PER_FRAME_EXAMPLES)(per_frame)
app.command("fixer", epilog=EXAMPLE)(train_fixer_command)
app.command("arms", epilog=ARMS_EXAMPLES)(arms)
app.command("decoder", epilog=DECODER_EXAMPLE)(decoder)
app.command("memory", epilog="Example: `simrun train memory --latents 12,24 --horizon 1,4`")(
    memory_command
)
app.command("policy-data", epilog=POLICY_DATA_EPILOG)(policy_data)
app.command("policy", epilog=POLICY_EPILOG)(policy)
app.command("perceptual", epilog=PERCEPTUAL_EXAMPLE)(perceptual)
app.command("perceptual-check", epilog=CHECK_EPILOG)(perceptual_check)
app.command("judge", epilog=JUDGE_EXAMPLES)(judge)
app.command("splat", epilog=SPLAT_EXAMPLE)(splat)
app.command("scenes", epilog=train_scenes.SCENES_EPILOG)(train_scenes.scenes)
app.command("check-scenes", epilog=train_scenes.CHECK_EPILOG)(train_scenes.check_frozen)
app.command("reconstructions", epilog=train_pairs.RECONSTRUCTIONS_EPILOG)(
    train_pairs.reconstructions
)
app.command("pairs", epilog=train_pairs.PAIRS_EPILOG)(train_pairs.pairs)
app.command("pairs-sheet", epilog=train_pairs.SHEET_EPILOG)(train_pairs.pairs_sheet)
app.command("transfer", epilog=TRANSFER_EPILOG)(transfer)
app.command("photographs", epilog=PHOTOGRAPHS_EPILOG)(photographs)
app.command("video", epilog=VIDEO_EPILOG)(video)
app.command("import-pairs", epilog=train_pairs.IMPORT_EPILOG)(train_pairs.import_pairs)


@app.callback()
def train() -> None:
    """Make training data and train networks."""


@app.command(
    "vae",
    epilog="Example: `simrun train vae data/pairs --video drive.mp4 --out runs/vae --steps 4000`",
)
def vae(
    data: Annotated[Path, typer.Argument(help="Folder of pairs.")],
    out: RunFolder,
    video: Annotated[
        list[Path] | None, typer.Option("--video", help="Further driving video. Repeatable.")
    ] = None,
    video_share: Annotated[
        float,
        typer.Option(
            "--video-share", min=0.1, max=1.0, help="Use only this first share of every video."
        ),
    ] = 1.0,
    steps: Steps = 4000,
    seed: Seed = 0,
    init: Annotated[
        Path | None,
        typer.Option("--init", help="Initial weights: an autoencoder, or a fixer's bundle."),
    ] = None,
    fixer: Annotated[
        str, typer.Option("--fixer", help="Fixer that gives the autoencoder's sizes.")
    ] = "onefixer-dit-tiny",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Train the tiny video autoencoder; writes OUT/vae.safetensors with averaged weights and
    measured latent statistics.
    """
    del debug
    model = (
        load_tiny_vae(init).requires_grad_(True)
        if init
        else TinyVAE.random(TinySizes(*onefixer_settings(fixer).vae.widths), seed)
    )
    dataset = PairDataset(data, "train")
    videos = [read_video(path, WIDTH, HEIGHT, 0.0, video_share) for path in video or ()]
    task = VaeTask(
        model, dataset.sequences, videos, VaeRecipe(seed=seed, video_clips=1 if videos else 0)
    )
    trainer = Trainer(model, out, Schedule(steps), task.batch, task.loss, task.facts)
    progress = Progress(steps, every=50)
    trainer.run(progress.update)
    model.load_state_dict(trainer.averaged())
    clips = [to_tensor(s.clip.rgb_gt[:97])[None] for s in dataset.sequences]
    mean, std = measure_stats(model, clips)
    model.stats = LatentStats(
        (mean * model.stats.std + model.stats.mean).tolist(),
        (std * model.stats.std).tolist(),
        stored=True,
    )
    model.save(
        out / "vae.safetensors",
        {"made_by": "simrun train vae", "steps": str(steps), "seed": str(seed)},
    )
    progress.wrote(out / "vae.safetensors", as_json)


@app.command(
    "vae-quality",
    epilog="Example: `simrun train vae-quality runs/vae/vae.safetensors data/pairs --split val --video drive.mp4`",
)
def vae_quality(
    weights: Annotated[
        str, typer.Argument(help="Weights of an autoencoder, a fixer's bundle, or 'untrained'.")
    ],
    data: Annotated[Path, typer.Argument(help="Folder of pairs.")],
    split: Annotated[str, typer.Option("--split", help="Split to measure on.")] = "val",
    video: Annotated[
        list[Path] | None, typer.Option("--video", help="Further driving video. Repeatable.")
    ] = None,
    first_share: Annotated[
        float,
        typer.Option("--first-share", min=0.0, max=0.9, help="Skip this share of every video."),
    ] = 0.0,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Measure a tiny autoencoder on held-out frames; prints one JSON document (--json has no
    effect).
    """
    del as_json, debug
    model = TinyVAE.random() if weights == "untrained" else load_tiny_vae(weights)
    console, rows = Console(stderr=True), []
    clips = [
        partial(_pair_qualities, model, sequence) for sequence in PairDataset(data, split).sequences
    ]
    clips += [partial(_video_qualities, model, path, first_share) for path in video or ()]
    for number, clip in enumerate(clips, start=1):
        found = clip()
        rows += found
        console.print(
            f"[{number}/{len(clips)}] {found[0]['clip']}: {found[0]['psnr_db']:.2f} dB",
            highlight=False,
            markup=False,
        )
    print(json.dumps({"weights": weights, "split": split, "rows": rows}, indent=1))


def _pair_qualities(model: TinyVAE, sequence: PairSequence) -> list[dict[str, object]]:
    clip = sequence.clip
    gt, render = to_tensor(clip.rgb_gt)[None], to_tensor(clip.rgb_input)[None]
    opacity = (to_tensor(clip.opacity[..., None])[None] + 1) / 2
    made = {
        "latent": round_trip(model, gt),
        "latent and render": round_trip(model, gt, render, opacity),
        "render alone": render,
    }
    return [
        {"clip": sequence.name, "from": name, **asdict(quality(video, gt))}
        for name, video in made.items()
    ]


def _video_qualities(model: TinyVAE, path: Path, first_share: float) -> list[dict[str, object]]:
    gt = to_tensor(read_video(path, WIDTH, HEIGHT, first_share))[None]
    return [{"clip": path.stem, "from": "latent", **asdict(quality(round_trip(model, gt), gt))}]
