"""Batches in pixels: consecutive frames of the clips that the latents' batches draw, for objectives
that encode them anew.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.clip_batches import ClipBatches
from alpasim_plugin.lab.training.recipes.recipe import StageInputs


class Pictures(NamedTuple):
    """Frames ``(B, 3, T, H, W)`` in [-1, 1]."""

    render: Tensor
    clean: Tensor


class PictureBatches:
    """Draws of consecutive frames: clips and crops as `ClipBatches` draws them, from a random frame
    of the clips on.

    Args:
        inputs: Clips and form of the batches.
        frames: T.

    Raises:
        InputError: Clips with fewer frames.
    """

    def __init__(self, inputs: StageInputs, frames: int) -> None:
        have = inputs.clips.form.frames
        if have < frames:
            raise InputError(
                f"{frames} frames of a clip: clips of {have} frames",
                f"train on clips of at least {1 + -(-(frames - 1) // 4)} latents (--latents)",
            )
        self.frames = frames
        self._latest = have - frames
        self._clips = ClipBatches(inputs.clips, inputs.vae, inputs.form, inputs.conditioning)
        self.seed = inputs.form.seed

    def __getitem__(self, index: int) -> Pictures:
        """Draw batch ``index``: a function of the index and the seed only."""
        begin = int(
            stream("training", self.seed, "pictures.begin", index).integers(self._latest + 1)
        )
        draw = self._clips[index]
        end = begin + self.frames
        return Pictures(draw.frames(end, begin)[0], draw.clean(end, begin))
