"""A stage of DiFix3D+ or DiffusionHarmonizer: configuration, batches and loss
(`training.render_step` has the equations).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.image_fixers.settings import RenderStepSettings
from alpasim_plugin.lab.training.perceptual_term import Distance
from alpasim_plugin.lab.training.picture_batches import PictureBatches, Pictures
from alpasim_plugin.lab.training.recipes.recipe import StageInputs
from alpasim_plugin.lab.training.recipes.start import transformer_of
from alpasim_plugin.lab.training.render_step import (
    REFERENCES,
    RenderStep,
    newest_first,
    picture_losses,
    warp_term,
)
from alpasim_plugin.lab.training.trainer import Loss

ROLLOUT = (
    8  # frames of a temporal clip; the loss is on one of those that have four outputs before them
)
MEASURED = 64  # images that the clamp is measured on


@dataclass(frozen=True)
class RenderStepLoss:
    """Losses on the deployed step's image.

    Args:
        weight: lambda, of the perceptual distance.
        clamp: Share of the training images' distances, render against clean frame, that the
            largest distance that counts is above; None: all distances count whole. The published .3
            is a value of LPIPS, and other distances have other values.
        references: The last four outputs that the network looks at: its ``own``, the ``clean``
            frames in their place (teacher forcing), or none.
        single: Share of batches without references, where there are any: a rollout begins with four
            frames without.
        warp: Weight of `warp-farneback`. The published one is not known; this one makes its
            gradient about half as long as the picture term's (docs/lab/arms.md).
    """

    weight: float = 1.0
    clamp: float | None = None
    references: Literal["own", "clean"] | None = None
    single: float = 0.5
    warp: float = 0.1
    perceptual: bool = True

    def task(self, inputs: StageInputs) -> RenderStepTask:
        """Make the stage's batches and loss."""
        return RenderStepTask(self, inputs)


class RenderStepBatch(NamedTuple):
    """Frames, the one that the loss is on, and whether it has references."""

    pictures: Pictures
    frame: int
    joined: bool


class RenderStepTask:
    """Batches and loss of `RenderStepLoss`.

    Raises:
        InputError: No distance, or a fixer that takes no step from the render.
    """

    def __init__(self, config: RenderStepLoss, inputs: StageInputs) -> None:
        if not isinstance(inputs.settings, RenderStepSettings):
            raise InputError(
                f"--fixer: {'a fixer' if inputs.settings is None else inputs.settings.name} that takes no step from the render",
                "leave it out, or name difix, harmonizer or harmonizer-temporal",
            )
        if inputs.distance is None:
            raise InputError(f"{config}: a perceptual term without a distance", "give one")
        self.config = config
        self.distance = inputs.distance[1]
        self.batches = PictureBatches(inputs, 1 if config.references is None else ROLLOUT)
        net = transformer_of(inputs, "dit")
        self.step = RenderStep(
            net, inputs.vae, inputs.settings.level, inputs.settings.decoder.kind == "render"
        )
        self.parts = nn.ModuleDict({"dit": net, "vae": inputs.vae})
        self.largest = (
            None
            if config.clamp is None
            else largest_distance(self.batches, self.distance, config.clamp, inputs.device)
        )

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the configuration, with the largest distance that counts."""
        level = asdict(self.step.level)
        return {
            "objective": "a step from the render",
            **asdict(self.config),
            "largest_distance": self.largest,
            "render_level": level,
        }

    def batch(self, index: int) -> RenderStepBatch:
        """Make batch ``index``."""
        if self.config.references is None:
            return RenderStepBatch(self.batches[index], 0, False)
        rng = stream("training", self.batches.seed, "render_step.frame", index)
        return RenderStepBatch(
            self.batches[index],
            int(rng.integers(REFERENCES, ROLLOUT)),
            bool(rng.random() >= self.config.single),
        )

    def loss(self, batch: RenderStepBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        (render, clean), w = batch.pictures, batch.frame
        references: Tensor | None = None
        if batch.joined:
            displayed = (
                clean[:, :, :w]
                if self.config.references == "clean"
                else self.step.outputs(render[:, :, :w])
            )
            references = newest_first(displayed)
        made = self.step(render[:, :, w : w + 1], references)
        wanted = clean[:, :, w : w + 1]
        parts = picture_losses(made, wanted, self.distance, self.config.weight, self.largest)
        if batch.joined and self.config.warp:
            parts |= warp_term(made, clean[:, :, : w + 1], self.config.warp)
        numbers: dict[str, Tensor | float] = {name: value.detach() for name, value in parts.items()}
        if self.largest is not None:
            numbers["largest_distance"] = self.largest
        numbers["render"] = (render[:, :, w : w + 1] - wanted).square().mean()
        return torch.stack(list(parts.values())).sum(), numbers


@torch.no_grad()
def largest_distance(
    batches: PictureBatches, distance: Distance, share: float, device: str
) -> float:
    """Return the quantile ``share`` of the distances between renders and clean frames in the first
    training batches, to three digits.
    """
    distances: list[float] = []
    while len(distances) < MEASURED:
        # Any batches will do, as long as they are always the same
        render, clean = batches[len(distances)]
        image_pair = (upload(images[:, :, -1], device) for images in (render, clean))
        distances += distance(*image_pair).tolist()
    return float(f"{np.quantile(distances, share):.3g}")
