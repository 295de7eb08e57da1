"""Flow matching on a noisy history: every clip, block or latent at its own noise level (diffusion
forcing), or the whole clip at one.

    z_t = (1 - t) z_0 + t z_1          | v(z_t, t | z_t of earlier blocks, c) - (z_1 - z_0) |^2

Names as in `shared_rollout`. The history of a block is noised as the block's own training is, not
the clean or predicted one of the shared rollout; the attention alone says which latents are
history: with one block a clip the network is bidirectional.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.sampling import context_level, mixed_source
from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.fixers.network.schedule import TABLE, interpolant, shifted
from alpasim_plugin.lab.training.clip_batches import ClipBatches, Drawn
from alpasim_plugin.lab.training.recipes.recipe import Attention, StageInputs
from alpasim_plugin.lab.training.recipes.start import channel_weights_of, no_text, transformer_of
from alpasim_plugin.lab.training.shared_rollout import T_SOURCE, Sample, channel_weighted
from alpasim_plugin.lab.training.tail_drop import TailDrop
from alpasim_plugin.lab.training.trainer import Loss


@dataclass(frozen=True)
class FlowMatching:
    """Noise levels of flow matching on a noisy history.

    Args:
        times: What has one time t ~ U(0, 1) of its own: every latent, block or clip.
        window: Whether history ends at the attention's window; otherwise a block sees the whole
            past, as the paper's backbone is trained.
        source_share: Share of latents at t = 1, where the deployed generator starts.
        context_share: Share of latents at the level of the cache write.
        noise_share: Share of clips whose source is noise alone.
        shift: Warp of the times towards the source, ``t <- s t / (1 + (s - 1) t)``; 1 for none.
        bell: Whether errors are weighted by `bell_weight` (ArtiFixer).
        tail_drop: Hides renders from a random frame on; None shows them all.
    """

    times: Literal["latent", "block", "clip"] = "block"
    window: bool = False
    source_share: float = 0.0
    context_share: float = 0.0
    noise_share: float = 0.0
    shift: float = 1.0
    bell: bool = False
    tail_drop: TailDrop | None = None

    @property
    def perceptual(self) -> bool:
        """It has no perceptual term."""
        return False

    def task(self, inputs: StageInputs) -> FlowMatchingTask:
        """Make the stage's batches and loss."""
        return FlowMatchingTask(self, inputs)


class FlowMatchingTask:
    """Batches and loss of `FlowMatching`."""

    def __init__(self, config: FlowMatching, inputs: StageInputs) -> None:
        self.config = config
        self.attention = inputs.attention
        self.batches = ClipBatches(inputs.clips, inputs.vae, inputs.form, inputs.conditioning)
        self.net = transformer_of(inputs, "dit")
        self.parts = nn.ModuleDict({"dit": self.net, "vae": inputs.vae})
        self.channel_weights = channel_weights_of(inputs)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the configuration."""
        return {"objective": "flow matching on a noisy history", **asdict(self.config)}

    def batch(self, index: int) -> Sample:
        """Make batch ``index``."""
        draw: Drawn = self.batches[index]
        return (
            draw.sample
            if self.config.tail_drop is None
            else self.config.tail_drop(draw.sample, self.batches.form.seed, index)
        )

    def loss(self, batch: Sample, index: int) -> Loss:
        """Return the loss of a batch."""
        s, (t, from_noise) = (
            batch,
            noise_levels(self.config, batch, self.attention, self.batches.form.seed, index),
        )
        z_1 = torch.where(from_noise, s.eps, mixed_source(s.z_r, s.m, s.eps))
        weights = bell_weight(t) if self.config.bell else None
        loss = flow_matching(
            self.net,
            s.z_0,
            z_1,
            t,
            no_text(self.net, s.z_0),
            s.condition,
            self.attention,
            window=self.config.window,
            channel_weights=self.channel_weights,
            weights=weights,
        )
        return loss, {"flow": loss.detach()}


def flow_matching(
    net: CosmosCausalDiT,
    z_0: Tensor,
    z_1: Tensor,
    t: Tensor,
    text: Tensor,
    condition: Tensor,
    attention: Attention,
    *,
    window: bool = True,
    channel_weights: Tensor | None = None,
    weights: Tensor | None = None,
) -> Tensor:
    """Return the mean squared error of the velocity between clean latents and source.

    Args:
        net: The network.
        z_0, z_1: ``(B, C, N, H, W)`` clean latents and source.
        t: ``(B, N)`` noise levels.
        text, condition: As the network takes them.
        attention: Blocks, and window if ``window``.
        channel_weights: ``(C,)``, mean 1; None for equal weights.
        weights: ``(B, N)`` of the noise levels, mean 1; None for equal weights.
    """
    z_t = interpolant(z_0, z_1, t[:, None, :, None, None])
    limits = {"window": attention.window, "sink": attention.sink} if window else {}
    v = net(z_t, T_SOURCE * t, text, condition, block_latents=attention.block_latents, **limits)
    errors = channel_weighted((v - (z_1 - z_0)).square(), channel_weights)
    return errors.mean() if weights is None else (errors.mean(dim=(1, 3, 4)) * weights).mean()


def noise_levels(
    config: FlowMatching, s: Sample, attention: Attention, seed: int, index: int
) -> tuple[Tensor, Tensor]:
    """Return the noise level of every latent ``(B, N)``, and which clips start from noise ``(B, 1,
    1, 1, 1)``.
    """
    n = s.t.shape[1]
    size = {"latent": 1, "block": attention.block_latents, "clip": n}[config.times]
    device = s.t.device
    # Latents of a block or clip share the draw of its first
    first = torch.arange(n, device=device) // size * size
    t = s.t[:, first]
    t = config.shift * t / (1 + (config.shift - 1) * t) if config.shift != 1 else t
    rng = stream("training", seed, "generator.levels", index)
    kind = upload(rng.random(tuple(s.t.shape)), device)[:, first]
    t = torch.where(kind < config.source_share, torch.ones_like(t), t)
    t = torch.where(kind > 1 - config.context_share, torch.full_like(t, context_level().sigma), t)
    from_noise = upload(rng.random(len(s.t)) < config.noise_share, device)[
        :, None, None, None, None
    ]
    return t, from_noise


def bell_weight(sigma: Tensor) -> Tensor:
    """Return ArtiFixer's weight of noise levels: ``exp(-2 (sigma - 1/2)^2)`` above its least value,
    with mean 1 over the shifted table.
    """
    table = [math.exp(-2 * (shifted(1 - i / TABLE) - 0.5) ** 2) for i in range(TABLE)]
    least = min(table)
    return (torch.exp(-2 * (sigma - 0.5).square()) - least) / (sum(table) / TABLE - least)
