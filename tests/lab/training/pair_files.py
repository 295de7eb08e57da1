"""Small sequences of pairs for tests."""

import numpy as np

from alpasim_plugin.lab.training.pair_store import Pair, PairSequence, write_sequence


def pair(i, height=32, width=48):
    """Return frame ``i`` of a scene that moves to the left by a pixel a frame."""
    x, y = np.meshgrid(np.arange(width) + i, np.arange(height))
    rgb = np.stack([x * 5 % 256, y * 7 % 256, (x + y) * 3 % 256], axis=-1).astype(np.uint8)
    opacity = np.where(y < 4, 0, 255).astype(np.uint8)
    T = np.eye(4)
    T[0, 3] = i
    return Pair(
        (rgb // 2).astype(np.uint8), rgb, opacity, (255 - rgb).astype(np.uint8), T, 100_000 * i
    )


def make(
    root,
    split="train",
    name="a",
    frames=12,
    height=32,
    width=48,
    **more,
):
    """Write one sequence, with ``more`` of sequence.json, and open it."""
    folder = root / split / name
    write_sequence(
        folder,
        (pair(i, height, width) for i in range(frames)),
        frames,
        {"scene_id": name, "split": split, **more},
    )
    return PairSequence(folder)
