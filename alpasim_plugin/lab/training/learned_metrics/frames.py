"""Clean frames with their truth, drawn for a detector's training: example i is a function of the
data, the seed and i.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import U8
from alpasim_plugin.lab.training.learned_metrics.labels import Labels, for_training
from alpasim_plugin.lab.training.pair_store import PairSequence, pairs_digest

WIDTH_PX = 256


@dataclass(frozen=True)
class LabelledFrames:
    """Sequences of the training splits with the truth of some of their frames.

    Raises:
        InputError: A sequence of a test split, or of another number of labels.
    """

    sequences: tuple[PairSequence, ...]
    labels: tuple[Labels, ...]

    def __post_init__(self) -> None:
        for_training(self.sequences)
        if len(self.sequences) != len(self.labels) or not self.sequences:
            raise InputError(
                f"a judge's training data: {len(self.sequences)} sequences, {len(self.labels)} labels",
                "label every sequence, and give at least one",
            )

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the data."""
        return {
            "sequences": len(self.sequences),
            "pairs": pairs_digest(self.sequences),
            "labelled_frames": int(sum(len(one.frames) for one in self.labels)),
        }

    def draw(self, rng: np.random.Generator) -> tuple[U8, Labels, int]:
        """Return a random clean frame ``(H, W, 3)``, the labels of its sequence and its row in
        them.
        """
        which = int(rng.integers(len(self.sequences)))
        labels = self.labels[which]
        row = int(rng.integers(len(labels.frames)))
        return np.array(self.sequences[which].clip.rgb_gt[labels.frames[row]]), labels, row


def jitter_colours(rng: np.random.Generator, image: U8) -> U8:
    """Return an image of another exposure, contrast and white balance."""
    gamma, gains = (
        float(rng.uniform(0.75, 1.35)),
        rng.uniform(0.85, 1.15) * rng.uniform(0.94, 1.06, 3),
    )
    curve = (np.arange(256) / 255.0) ** gamma
    table = np.clip(np.rint(255 * curve[:, None] * gains), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(image, table[None]))


def chosen(
    sequences: Sequence[PairSequence], count: int | None = None, training: bool = True
) -> tuple[PairSequence, ...]:
    """Return the sequences 256 pixels wide, as all test clips are, in order of number, so that the
    first few cover all families.

    Raises:
        InputError: There are none, or one is of a test split although they are for training.
    """
    fitting = [
        s
        for s in (for_training(sequences) if training else sequences)
        if int(s.info.get("camera", {}).get("width", 0)) == WIDTH_PX
    ]
    if not fitting:
        raise InputError(
            f"pairs: no sequence {WIDTH_PX} pixels wide among {len(sequences)}",
            "render pairs with the default camera (docs/lab/pairs.md)",
        )
    return tuple(sorted(fitting, key=lambda s: (s.name.rsplit("_", 1)[-1], s.name))[:count])
