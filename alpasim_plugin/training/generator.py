"""Batches and loss of the generator, for `Trainer`: the shared rollout on latents of clips, for every variant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.errors import InputError
from alpasim_plugin.nets.clips import GROUP, SIDE
from alpasim_plugin.nets.dit import CosmosCausalDiT
from alpasim_plugin.nets.sampling import interpolant, mixed_source
from alpasim_plugin.nets.schedule import context_level
from alpasim_plugin.nets.tiny_vae import TinyVAE
from alpasim_plugin.seeding import stream
from alpasim_plugin.training.latent_clips import LatentClip, LatentClips
from alpasim_plugin.training.perceptual_term import DecodedDistance, Distance
from alpasim_plugin.training.shared_rollout import T_SOURCE, Objectives, Perceptual, Sample, channel_weighted, losses
from alpasim_plugin.training.trainer import Loss
from alpasim_plugin.training.vae import channel_amplitudes
from alpasim_plugin.training.variants import BASE, Variant

MAP_KEY = "additional_patch_embedding.proj.1.weight"
PATCH = 2  # latents along a side of a token; crops consist of whole tokens
AREA = PATCH * PATCH


@dataclass(frozen=True)
class GeneratorRecipe:
    """Batch and sampling of noise levels.

    Args:
        clips: Clips of a batch.
        latents: Latents from a clip's start; None for the whole clip.
        columns: Width of the crop in latents, even; None for the whole image.
        block_latents, window: As at deployment.
        steps: Total updates, which a variant of several stages divides.
        accumulate: Batches an update.
        seed: Of sampling and noise.
        source_share: ``base`` only: share of positions at t = 1, where the deployed generator starts.
        context_share: ``base`` only: share of positions at the noise level of the history.
        channels: Channel weights of the flow-matching loss: ``amplitude`` (`vae.channel_amplitudes`), or ``equal`` as in the paper.
    """

    clips: int = 4
    latents: int | None = None
    columns: int | None = None
    block_latents: int = 2
    window: int = 6
    steps: int = 400
    accumulate: int = 2
    seed: int = 0
    source_share: float = 0.35
    context_share: float = 0.2
    channels: Literal["amplitude", "equal"] = "amplitude"


@dataclass(frozen=True)
class GeneratorBatch:
    """Latents and noise of a batch, and the render for the perceptual term's decoder (None: not needed)."""

    sample: Sample
    render: Tensor | None
    opacity: Tensor | None


class GeneratorTask:
    """Batches and loss of a variant.

    Args:
        net: The generator to train.
        vae: Frozen autoencoder whose decoder is conditioned on the render.
        clips: Training latents.
        variant: Variant to train.
        recipe: Batch and noise levels.
        distance: Frozen perceptual distance with its name; required by variants with a perceptual term.

    Raises:
        InputError: A variant with a perceptual term and no distance, or a crop of half tokens.
    """

    def __init__(
        self,
        net: CosmosCausalDiT,
        vae: TinyVAE,
        clips: LatentClips,
        variant: Variant,
        recipe: GeneratorRecipe,
        distance: tuple[str, Distance] | None = None,
    ) -> None:
        doing = "setting up the generator's training"
        if distance is None and any(stage.horizon for stage in variant.stages):
            raise InputError(doing, f"variant {variant.name}", "a perceptual term without a distance", "give one")
        if recipe.columns is not None and recipe.columns % PATCH:
            raise InputError(doing, f"columns {recipe.columns}", "half a token", "give an even number of latents")
        self.net, self.vae, self.clips, self.variant, self.recipe = net, vae, clips, variant, recipe
        self.distance_name = distance[0] if distance else "none"
        self._distance: Distance | None = distance[1] if distance else None
        self.text = torch.zeros(1, 1, net.sizes.text_width)
        self.block = 1 if not variant.history else recipe.block_latents
        self.channel_weights = channel_amplitudes(vae) if recipe.channels == "amplitude" else None

    @property
    def facts(self) -> dict[str, Any]:
        """Identify data, variant and recipe."""
        return {
            "clips": len(self.clips), "latents": self.clips.digest, "variant": self.variant.name,
            "stages": [asdict(stage) for stage in self.variant.stages], "recipe": asdict(self.recipe), "distance": self.distance_name,
        }  # fmt: skip

    def objectives(self, index: int) -> Objectives:
        """Return the objectives of batch ``index``."""
        return self.variant.objectives(index // self.recipe.accumulate, self.recipe.steps)

    def batch(self, index: int) -> GeneratorBatch:
        """Make batch ``index``: a function of the index and the recipe's seed only."""
        r = self.recipe
        rng = stream("training", r.seed, "generator.clips", index)
        drawn = [self.clips[int(i)] for i in rng.integers(len(self.clips), size=r.clips)]
        z_r, z_0, z_map, m = (torch.stack(z) for z in zip(*(clip.latents for clip in drawn), strict=True))
        columns = self._columns(rng, z_0.shape[-1])
        latents = slice(0, r.latents if self.variant.history else 1)  # without history, every clip is one frame
        w = int(rng.integers(len(range(z_0.shape[2])[latents])))
        z_r, z_0, z_map, m = (z[:, :, latents, :, columns] for z in (z_r, z_0, z_map, m))
        b, n = z_0.shape[0], z_0.shape[2]

        def normal(what: str) -> Tensor:
            noise = stream("training", r.seed, f"generator.{what}", index).standard_normal(z_0.shape, dtype=np.float32)
            return torch.from_numpy(noise)

        def uniform() -> Tensor:
            return torch.from_numpy(rng.random((b, n), dtype=np.float32))

        sample = Sample(z_r, z_0, z_map, m, normal("eps"), normal("context"), uniform(), uniform(), w)
        render = opacity = None
        if self.objectives(index).horizon:
            render, opacity = self._frames(drawn, 1 + GROUP * w, columns)
        return GeneratorBatch(sample, render, opacity)

    def loss(self, batch: GeneratorBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        if self.variant.name == BASE:
            loss = diffusion_forcing(self.net, batch.sample, self.text, self.recipe, index, self.channel_weights)
            return loss, {"flow": float(loss.detach())}
        perceptual: Perceptual | None = None
        if self._distance is not None and batch.render is not None:
            perceptual = DecodedDistance(self.vae, self._distance, batch.sample.z_0, batch.render, batch.opacity)
        objectives = self.objectives(index)
        made = losses(
            self.net, batch.sample, self.text, objectives, perceptual,
            block_latents=self.block, window=self.recipe.window, channel_weights=self.channel_weights,
        )  # fmt: skip
        parts = {"flow": made.flow, "perceptual": made.perceptual}
        numbers = {name: float(value.detach()) for name, value in parts.items() if value is not None}
        if made.rollout is not None:
            numbers["rollout"] = float((made.rollout - batch.sample.z_0).square().mean())
        numbers["render"] = float((batch.sample.z_r - batch.sample.z_0).square().mean())
        return made.total, numbers

    def _columns(self, rng: np.random.Generator, width: int) -> slice:
        wanted = self.recipe.columns
        if wanted is None or wanted >= width:
            return slice(0, width)
        left = PATCH * int(rng.integers((width - wanted) // PATCH + 1))
        return slice(left, left + wanted)

    def _frames(self, drawn: list[LatentClip], end: int, columns: slice) -> tuple[Tensor, Tensor]:
        pixels = slice(columns.start * SIDE, columns.stop * SIDE)
        both = [clip.frames(end) for clip in drawn]
        return torch.stack([render[..., pixels] for render, _ in both]), torch.stack([opacity[..., pixels] for _, opacity in both])


def diffusion_forcing(
    net: CosmosCausalDiT, s: Sample, text: Tensor, recipe: GeneratorRecipe, index: int, channel_weights: Tensor | None = None
) -> Tensor:
    """Return the diffusion-forcing loss: every position has its own noise level and is history of later positions.

    Levels are those of a deployed generator: the source (t = 1), the level of the cache write, and uniform between. In three of four clips
    the source is mixed (Eq. 1), in the fourth it is noise.
    """
    rng = stream("training", recipe.seed, "generator.levels", index)
    kind = torch.from_numpy(rng.random(tuple(s.t.shape)))
    t = torch.where(kind < recipe.source_share, torch.ones_like(s.t), s.t)
    t = torch.where(kind > 1 - recipe.context_share, torch.full_like(s.t, context_level().sigma), t)
    from_noise = torch.from_numpy(rng.random(len(s.t)) < 0.25)[:, None, None, None, None]
    z_1 = torch.where(from_noise, s.eps, mixed_source(s.z_r, s.m, s.eps))
    z_t = interpolant(s.z_0, z_1, t[:, None, :, None, None])
    v = net(z_t, T_SOURCE * t, text, s.z_map, block_latents=recipe.block_latents, window=recipe.window)
    error: Tensor = v - (z_1 - s.z_0)
    return channel_weighted(error.square(), channel_weights).mean()


def widen_map(weights: Mapping[str, Tensor], channels: int, latent_channels: int = 16) -> dict[str, Tensor]:
    """Return weights whose map input has ``channels`` channels; new columns are zero, so outputs do not change.

    Raises:
        InputError: The weights have more channels already.
    """
    old = weights[MAP_KEY]
    width, have = old.shape[0], old.shape[1] // AREA
    if have > channels:
        found = f"they take {have} channels"
        raise InputError("widening a map input", f"to {channels} channels", found, "start from weights that take no more")
    new = torch.zeros(width, channels * AREA)
    # Inputs of a token are channel-major (`embeddings.PatchEmbed`): existing channels come first.
    new[:, : have * AREA] = old
    return {**weights, MAP_KEY: new}
