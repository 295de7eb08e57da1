"""The paper's appearance experiment: one generator that renders a clear input in the style that its
prompt asks for.

Input as for every other recipe: the clear render, its opacity, the map. The target of a clip is its
clean latents in a style drawn for it (`styled_latents`), and the prompt is the style's learned
embedding: one token in the text slot. The clear style's starts at zero, which is the prompt of all
other recipes, so that the clear style starts as they do; the others start apart, at unit variance.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.clips import GROUP
from alpasim_plugin.block_fixers.settings import CLEAR, STYLES
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.appearance import VERSION
from alpasim_plugin.lab.training.clip_batches import ClipBatches
from alpasim_plugin.lab.training.generator import logged
from alpasim_plugin.lab.training.perceptual_term import DecodedDistance, Distance
from alpasim_plugin.lab.training.recipes.recipe import StageInputs
from alpasim_plugin.lab.training.recipes.start import channel_weights_of, transformer_of
from alpasim_plugin.lab.training.shared_rollout import Objectives, Perceptual, Sample, losses
from alpasim_plugin.lab.training.styled_latents import StyledLatents
from alpasim_plugin.lab.training.trainer import Loss


@dataclass(frozen=True)
class StyledRollout:
    """Objectives on the shared rollout towards targets in several styles, drawn with equal
    probability.

    Args:
        objectives: OneFixer's by default.
    """

    objectives: Objectives = Objectives("own", 4)

    @property
    def perceptual(self) -> bool:
        """Whether there is a perceptual term."""
        return self.objectives.horizon > 0

    def weighted(self, perceptual: float) -> StyledRollout:
        """Return the same with another weight lambda of the perceptual term.

        Raises:
            InputError: A negative weight.
        """
        return replace(self, objectives=replace(self.objectives, weight=perceptual))

    def task(self, inputs: StageInputs) -> StyledRolloutTask:
        """Make the stage's batches and loss.

        Raises:
            InputError: No folder of scenes.
        """
        return StyledRolloutTask(self, inputs)


class StylePrompts(nn.Module):
    """A learned embedding for every style: parameters by its name, each ``(tokens, text_width)``,
    as a bundle holds them.

    Args:
        text_width: Of the transformer.
        seed: Of the initial embeddings.
        tokens: Of a prompt.
    """

    def __init__(self, text_width: int, seed: int, tokens: int = 1) -> None:
        super().__init__()
        for style in STYLES:
            drawn = stream("training", seed, f"prompt.{style}").standard_normal(
                (tokens, text_width), dtype=np.float32
            )
            self.register_parameter(
                style,
                nn.Parameter(
                    torch.zeros(tokens, text_width) if style == CLEAR else torch.from_numpy(drawn)
                ),
            )

    def forward(self, styles: tuple[str, ...]) -> Tensor:
        """Return the prompts ``(B, tokens, text_width)`` of B clips."""
        return torch.stack([self.get_parameter(style) for style in styles])


class StyledBatch(NamedTuple):
    """A batch whose ``z_0`` are styled targets, their styles, and the clear clips' render for the
    perceptual term's decoder.
    """

    sample: Sample
    styles: tuple[str, ...]
    render: Tensor
    opacity: Tensor


@dataclass(frozen=True)
class StyledDistance:
    """The perceptual term of a batch in several styles: the mean over clips.

    Clear clips are decoded with the render, as at deployment. In another style the render's detail
    is of other weather, so the decoder does not see it (`OneFixerSettings.shows_render`).
    """

    decoder: TinyVAE
    distance: Distance
    batch: StyledBatch

    def __call__(self, predicted: Tensor, w: int) -> Tensor:
        """Return the mean distance of position ``w``'s frames; ``predicted`` includes position
        w.
        """
        b, parts = self.batch, []
        for shows_render in (True, False):
            rows = [i for i, style in enumerate(b.styles) if (style == CLEAR) == shows_render]
            if rows:
                shown = (b.render[rows], b.opacity[rows]) if shows_render else (None, None)
                part = DecodedDistance(self.decoder, self.distance, b.sample.z_0[rows], *shown)
                parts.append(part(predicted[rows], w) * (len(rows) / len(b.styles)))
        return torch.stack(parts).sum()


class StyledRolloutTask:
    """Batches and loss of `StyledRollout`.

    Raises:
        InputError: No folder of scenes.
    """

    def __init__(self, config: StyledRollout, inputs: StageInputs) -> None:
        self.config, self.inputs, self.vae = config, inputs, inputs.vae
        self.batches = ClipBatches(inputs.clips, inputs.vae, inputs.form, inputs.seen)
        self.targets = StyledLatents(inputs.clips, inputs.vae, inputs.scenes)
        self.net = transformer_of(inputs, "dit")
        self.prompts = StylePrompts(self.net.sizes.text_width, inputs.form.seed)
        self.parts = nn.ModuleDict({"dit": self.net, "vae": self.vae, "prompt": self.prompts})
        self.channel_weights = channel_weights_of(inputs)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the configuration."""
        return {
            "objective": "styled rollout",
            **asdict(self.config),
            "styles": STYLES,
            "formulas": VERSION,
        }

    def batch(self, index: int) -> StyledBatch:
        """Make batch ``index``: the clips, crops and noise of every other recipe, and a style for
        each clip.
        """
        drawn = self.batches[index]
        rng = stream("training", self.inputs.form.seed, "generator.styles", index)
        styles = tuple(STYLES[int(i)] for i in rng.integers(len(STYLES), size=len(drawn.clips)))
        latents = slice(0, drawn.sample.z_0.shape[2])
        z_0 = [
            self.targets.target(clip, style)[:, latents, :, drawn.columns]
            for clip, style in zip(drawn.clips, styles, strict=True)
        ]
        render, opacity = drawn.frames(1 + GROUP * drawn.sample.w)
        return StyledBatch(replace(drawn.sample, z_0=torch.stack(z_0)), styles, render, opacity)

    def loss(self, batch: StyledBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        del index
        perceptual: Perceptual | None = None
        if self.inputs.distance is not None:
            perceptual = StyledDistance(self.vae, self.inputs.distance[1], batch)
        attention = self.inputs.attention
        made = losses(
            self.net,
            batch.sample,
            self.prompts(batch.styles),
            self.config.objectives,
            perceptual,
            block_latents=attention.block_latents,
            window=attention.window,
            channel_weights=self.channel_weights,
        )
        return made.total, logged(made, batch.sample)
