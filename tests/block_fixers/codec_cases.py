"""Networks and clips shared by the tests of the video codecs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from alpasim_plugin.core import seeding

SMALL = 8  # base width


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Return standard normal numbers, the same every time."""
    return torch.from_numpy(
        seeding.stream("tests", seed, f"codec{shape}").standard_normal(shape)
    ).float()


def clip(frames: int, height: int, width: int, batch: int = 1, seed: int = 0) -> Tensor:
    """Return a random video in [-1, 1]."""
    return noise(batch, 3, frames, height, width, seed=seed).tanh()


def golden(
    shared_data: Path, stem: str
) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
    """Return weights, inputs and outputs, and settings of one network's golden tensors."""
    folder = shared_data / "golden-nets"
    config = json.loads((folder / f"{stem}.config.json").read_text())
    return (
        load_file(folder / f"{stem}.weights.safetensors"),
        load_file(folder / f"{stem}.io.safetensors"),
        config,
    )


class Stream:
    """Feed a codec's pure step block by block."""

    def __init__(self, step: Any, state: Any = None) -> None:
        self.step, self.state = step, state

    def push(self, x: Tensor, *args: Any, **options: Any) -> Tensor:
        """Return the outputs that the next frames or latents complete."""
        out, self.state = self.step(x, self.state, *args, **options)
        return out

    def fork(self) -> Stream:
        """Return an independent stream at the same point."""
        return Stream(self.step, self.state)


def encoder_stream(codec: Any) -> Stream:
    """Return a stream of frames to latents."""
    return Stream(codec.encode_next)


def decoder_stream(codec: Any) -> Stream:
    """Return a stream of latents to frames."""
    return Stream(codec.decode_next)
