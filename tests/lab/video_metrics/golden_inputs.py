"""Inputs and weights of the golden numbers, from keyed random streams: the reference
implementations were given the same.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from alpasim_plugin.core.seeding import stream

GOLDEN = Path(__file__).parent / "golden.json"
CLIPS = 20
CLOSE = 1e-4  # relative


def golden(name):
    """Return the numbers of one reference implementation."""
    return json.loads(GOLDEN.read_text())[name]


def clip(index, frames=2, height=32, width=48):
    """Return clip ``index`` and its damaged copy, ``(T, H, W, 3)`` uint8 each: a smooth texture that
    moves by two pixels a frame; blur and noise.
    """
    rng = stream("golden", index, "clip")
    noise = rng.standard_normal((height, width + 2 * frames, 3))
    texture = cv2.GaussianBlur(noise, (0, 0), 2.0)
    wide = 127 + (20 + 2 * index) * texture / texture.std()
    truth = np.stack([wide[:, 2 * i : 2 * i + width] for i in range(frames)])
    blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), 0.5 + 0.1 * index) for frame in truth])
    made = blurred + rng.normal(0, 1 + index, truth.shape)
    return tuple(np.clip(np.rint(x), 0, 255).astype(np.uint8) for x in (truth, made))


def images(frames):
    """Return frames ``(T, H, W, 3)`` as a tensor ``(T, 3, H, W)`` in [-1, 1]."""
    return torch.from_numpy(frames).permute(0, 3, 1, 2).float() / 127.5 - 1


def seeded_state(shapes):
    """Return random tensors by key: kernels of He's size, so that activations neither die nor
    explode; small biases; heads, scales and variances from 0.5 to 1.5.
    """
    state = {}
    for key, shape in shapes.items():
        rng = stream("golden", 0, key)
        values = rng.standard_normal(shape).astype(np.float32)
        if len(shape) > 1:
            values *= np.float32(np.sqrt(2 / np.prod(shape[1:])))
        elif key.endswith("bias") or key.endswith("running_mean"):
            values *= np.float32(0.1)
        else:
            values = rng.uniform(0.5, 1.5, shape).astype(np.float32)
        state[key] = torch.from_numpy(values)
    return state


def seed_network(net, names=lambda key: key):
    """Give a network seeded weights, each keyed by ``names`` of its key."""
    own = {key: value for key, value in net.state_dict().items() if value.is_floating_point()}
    seeded = {key: names(key) for key in own if names(key) is not None}
    states = seeded_state({name: tuple(own[key].shape) for key, name in seeded.items()})
    net.load_state_dict({key: states[name] for key, name in seeded.items()}, strict=False)
    return net.requires_grad_(False).eval()
