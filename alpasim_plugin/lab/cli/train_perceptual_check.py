"""``simrun train perceptual-check``: validate a perceptual distance on distorted held-out
frames.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
import typer

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, F64, U8
from alpasim_plugin.lab.cli.training_options import AsJson, Debug
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.training.perceptual_check import ArrayDistance, check, check_frames
from alpasim_plugin.lab.video_metrics import ssim
from alpasim_plugin.lab.video_metrics.image_distance import ImageDistance, load_distance
from alpasim_plugin.lab.video_metrics.perceptual import picture_distances
from alpasim_plugin.lab.video_metrics.perceptual_net import load_perceptual

CHECK_EPILOG = (
    "Example: `simrun train perceptual-check perceptual-syn data/pairs --split val --examples DATA/lpips`, "
    "DATA being the folder of third-party data"
)
EXAMPLES = ("ex_ref", "ex_p0", "ex_p1")


def perceptual_check(
    name: Annotated[
        str,
        typer.Argument(
            help="perceptual-syn, lpips_alex, lpips_vgg, ssim (one minus it), or a file of weights."
        ),
    ],
    data: Annotated[Path, typer.Argument(help="Folder of pairs.")],
    split: Annotated[str, typer.Option("--split", help="Split to take frames from.")] = "val",
    frames: Annotated[
        int,
        typer.Option("--frames", min=1, help="Number of clean frames, evenly from all sequences."),
    ] = 12,
    examples: Annotated[
        Path | None,
        typer.Option("--examples", help="Folder with LPIPS's ex_ref.png, ex_p0.png, ex_p1.png."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the distortions.")] = 0,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Validate a distance on distorted frames; prints one JSON document (--json has no effect)."""
    del as_json, debug
    torch.set_num_threads(1)
    distance = named_distance(name)
    sequences = PairDataset(data, split).sequences
    found = {
        "name": name,
        **check(
            distance,
            check_frames(sequences, frames),
            check_frames(sequences, frames, "rgb_input"),
            seed,
        ),
    }
    if examples is not None:
        ref, *others = (_read(examples / f"{one}.png") for one in EXAMPLES)
        found["examples"] = {
            one: float(distance(other, ref)[0])
            for one, other in zip(EXAMPLES[1:], others, strict=True)
        }
    print(json.dumps(found, indent=1))


def named_distance(name: str) -> ArrayDistance:
    """Return a distance on arrays by name, or by a file of weights."""
    if name == "ssim":
        return lambda a, b: 1 - ssim(_u8(a), _u8(b))
    net: ImageDistance = (
        load_perceptual(name) if name.endswith(".safetensors") else load_distance(name)
    )

    def distance(a: F32, b: F32) -> F64:
        return picture_distances(net, _u8(a), _u8(b))

    return distance


def _u8(images: F32) -> U8:
    return np.rint(images * 255).astype(np.uint8)


def _read(path: Path) -> F32:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(
            f"{path}: not an image",
            f"give a folder with {', '.join(EXAMPLES)} as PNG",
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)[None], dtype=np.float32) / np.float32(
        255
    )
