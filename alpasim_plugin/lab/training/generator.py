"""The objectives on the shared rollout as a stage's task: the paper's ablation, one or several
objectives in turn.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from typing import Any

from torch import Tensor, nn

from alpasim_plugin.block_fixers.clips import GROUP
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.clip_batches import ClipBatches
from alpasim_plugin.lab.training.perceptual_term import DecodedDistance
from alpasim_plugin.lab.training.recipes.recipe import StageInputs
from alpasim_plugin.lab.training.recipes.start import channel_weights_of, no_text, transformer_of
from alpasim_plugin.lab.training.shared_rollout import (
    Losses,
    Objectives,
    Perceptual,
    Sample,
    losses,
)
from alpasim_plugin.lab.training.trainer import Loss


@dataclass(frozen=True)
class SharedRollout:
    """Objectives on the shared rollout, in sequence; the optimiser's state is kept across their
    borders.

    Args:
        objectives: In sequence.
        shares: Parts of the updates that they take; they sum to 1.
    """

    objectives: tuple[Objectives, ...]
    shares: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        if len(self.shares) != len(self.objectives) or abs(sum(self.shares) - 1) > 1e-9:
            raise InputError(
                f"their shares: shares {self.shares} of {len(self.objectives)} objectives",
                "give one a stage, with sum 1",
            )

    @property
    def perceptual(self) -> bool:
        """Whether any objective has a perceptual term."""
        return any(objectives.horizon for objectives in self.objectives)

    def at(self, update: int, updates: int) -> Objectives:
        """Return the objectives of an update, counted from 0."""
        ends = accumulate(self.shares)
        return next(
            (o for o, end in zip(self.objectives, ends, strict=True) if update < end * updates),
            self.objectives[-1],
        )

    def weighted(self, perceptual: float) -> SharedRollout:
        """Return the same with another weight lambda of the perceptual term.

        Raises:
            InputError: A negative weight.
        """
        return replace(
            self, objectives=tuple(replace(o, weight=perceptual) for o in self.objectives)
        )

    def task(self, inputs: StageInputs) -> SharedRolloutTask:
        """Make the stage's batches and loss."""
        return SharedRolloutTask(self, inputs)


@dataclass(frozen=True)
class RolloutBatch:
    """Latents and noise of a batch, and the render for the perceptual term's decoder (None: not
    needed).
    """

    sample: Sample
    render: Tensor | None
    opacity: Tensor | None


class SharedRolloutTask:
    """Batches and loss of `SharedRollout`.

    Raises:
        InputError: A perceptual term and no distance.
    """

    def __init__(self, config: SharedRollout, inputs: StageInputs) -> None:
        if inputs.distance is None and config.perceptual:
            raise InputError(
                f"{config}: a perceptual term without a distance",
                "give one",
            )
        self.config, self.inputs, self.vae = config, inputs, inputs.vae
        self.batches = ClipBatches(inputs.clips, inputs.vae, inputs.form, inputs.conditioning)
        self.net = transformer_of(inputs, "dit")
        self.parts = nn.ModuleDict({"dit": self.net, "vae": self.vae})
        self.channel_weights = channel_weights_of(inputs)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the configuration; the updates matter only where they move a border between
        objectives.
        """
        updates = {"updates": self.inputs.updates} if len(self.config.objectives) > 1 else {}
        return {"objective": "shared rollout", **asdict(self.config), **updates}

    def objectives(self, index: int) -> Objectives:
        """Return the objectives of batch ``index``."""
        return self.config.at(index // self.inputs.accumulate, self.inputs.updates)

    def batch(self, index: int) -> RolloutBatch:
        """Make batch ``index``."""
        draw = self.batches[index]
        render = opacity = None
        if self.objectives(index).horizon:
            render, opacity = draw.frames(1 + GROUP * draw.sample.w)
        return RolloutBatch(draw.sample, render, opacity)

    def loss(self, batch: RolloutBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        s = batch.sample
        perceptual = None
        attention = self.inputs.attention
        if self.inputs.distance is not None and batch.render is not None:
            distance: Perceptual = DecodedDistance(
                self.vae, self.inputs.distance[1], s.z_0, batch.render, batch.opacity
            )
            perceptual = distance
        made = losses(
            self.net,
            s,
            no_text(self.net, s.z_0),
            self.objectives(index),
            perceptual,
            block_latents=attention.block_latents,
            window=attention.window,
            channel_weights=self.channel_weights,
        )
        return made.total, logged(made, s)


def logged(made: Losses, s: Sample) -> dict[str, Tensor]:
    """Return what the log holds of a batch: its terms, and the mean squared errors of rollout and
    render.
    """
    parts = {"flow": made.flow, "perceptual": made.perceptual}
    numbers = {name: value.detach() for name, value in parts.items() if value is not None}
    if made.rollout is not None:
        numbers["rollout"] = (made.rollout.detach() - s.z_0).square().mean()
    return numbers | {"render": (s.z_r - s.z_0).square().mean()}
