"""Networks and clips shared by the tests of the video codecs."""

import json

import torch
from safetensors.torch import load_file

from alpasim_plugin.core import seeding

SMALL = 8  # base width


def noise(*shape, seed=0):
    """Return standard normal numbers, the same every time."""
    return torch.from_numpy(
        seeding.stream("tests", seed, f"codec{shape}").standard_normal(shape)
    ).float()


def clip(frames, height, width, batch=1, seed=0):
    """Return a random video in [-1, 1]."""
    return noise(batch, 3, frames, height, width, seed=seed).tanh()


def golden(shared_data, stem):
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

    def __init__(self, step, state=None):
        self.step = step
        self.state = state

    def push(self, x, *args, **options):
        """Return the outputs that the next frames or latents complete."""
        out, self.state = self.step(x, self.state, *args, **options)
        return out

    def fork(self):
        """Return an independent stream at the same point."""
        return Stream(self.step, self.state)


def encoder_stream(codec):
    """Return a stream of frames to latents."""
    return Stream(codec.encode_next)


def decoder_stream(codec):
    """Return a stream of latents to frames."""
    return Stream(codec.decode_next)
