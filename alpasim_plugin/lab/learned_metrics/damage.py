"""Damage of known strength to a clean clip: a judge that is worth asking gets worse with each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import cv2
import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8

Kind = Literal["blur", "noise", "repeat", "drop"]
KINDS: tuple[Kind, ...] = get_args(Kind)
# Blur: sigma, pixels. Noise: deviation, levels of 255, new in every frame. Repeat: share of frames
# that show the one before. Drop: frames left out after each that stays; the clip is filled up with
# its end played backwards, so that it keeps its length.
STRENGTHS: Mapping[Kind, tuple[float, ...]] = {
    "blur": (0.7, 1.5, 3.0),
    "noise": (6.0, 15.0, 35.0),
    "repeat": (0.15, 0.4, 0.75),
    "drop": (1.0, 2.0, 4.0),
}


def damaged(frames: U8, kind: Kind, strength: float, seed: int = 0) -> U8:
    """Return a damaged clip ``(T, H, W, 3)`` of the same length.

    Raises:
        EvaluatorError: No such kind.
    """
    if kind == "blur":
        return np.stack([cv2.GaussianBlur(np.asarray(frame), (0, 0), strength) for frame in frames])
    if kind == "noise":
        rng = stream("judges", seed, "damage.noise")
        noisy = [
            frame.astype(np.float32) + strength * rng.standard_normal(frame.shape, dtype=np.float32)
            for frame in frames
        ]
        return np.stack([np.clip(np.rint(frame), 0, 255).astype(np.uint8) for frame in noisy])
    if kind == "repeat":
        held = (
            stream("judges", seed, "damage.repeat").random(len(frames)) < strength
        )  # a stronger one repeats these and more
        held[0] = False
        shown = np.maximum.accumulate(np.where(held, 0, np.arange(len(frames))))
        return np.asarray(frames[shown])
    if kind == "drop":
        kept = np.arange(0, len(frames), 1 + round(strength))
        there_and_back = np.concatenate([kept, kept[-2:0:-1]]) if len(kept) > 1 else kept
        return np.asarray(frames[np.resize(there_and_back, len(frames))])
    raise EvaluatorError(f"kind {kind!r}: no such kind", f"choose one of {', '.join(KINDS)}")


def in_order(values: list[float], lower_is_better: bool, slack: float = 0.0) -> bool:
    """Return whether every value is worse than the one before, by more than ``-slack``.

    Example:
        >>> in_order([0.9, 0.7, 0.2], lower_is_better=False)
        True
    """
    steps = np.diff(values) if lower_is_better else -np.diff(values)
    return bool((steps > -slack).all())
