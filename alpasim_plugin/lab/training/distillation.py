"""The last stage of the distilled systems as a task: the student's rollouts, the scores'
alternation,
and the adversarial head.

Parts: ``dit`` (the student), ``fake`` (the fake score), ``head`` (One-Forcing). The real score is
    frozen. An update trains the fake score;
every fifth one, from the first, also trains the student. Both losses of such an update are at the
weights before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.sampling import mixed_source
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.seeding import derive_seed, stream
from alpasim_plugin.fixers.network.schedule import steps
from alpasim_plugin.lab.training.adversarial import AdversarialHead, AdversarialTerm
from alpasim_plugin.lab.training.causal_rollout import causal_rollout
from alpasim_plugin.lab.training.clip_batches import ClipBatches
from alpasim_plugin.lab.training.dmd import (
    Score,
    critic_loss,
    direction,
    generator_loss,
    noised,
    score_levels,
)
from alpasim_plugin.lab.training.recipes.recipe import StageInputs
from alpasim_plugin.lab.training.recipes.start import channel_weights_of, no_text, transformer_of
from alpasim_plugin.lab.training.shared_rollout import T_SOURCE, Sample
from alpasim_plugin.lab.training.tail_drop import TailDrop
from alpasim_plugin.lab.training.trainer import Loss


@dataclass(frozen=True)
class Distillation:
    """DMD on the student's own rollouts.

    Args:
        steps: Flow steps of the schedule that the student is trained for; a rollout leaves it at a
            random one of them.
        every: Updates of the fake score to one of the student.
        same_rollout: Whether the fake score is trained on the student's rollout in an update of
            both (ArtiFixer), or on one of its own.
        gradient_latents: Latents at the clip's end whose blocks carry gradients; None for all.
        adversarial: One-Forcing's term; None without it.
        tail_drop: Hides renders from a random frame on; None shows them all.
    """

    steps: int = 1
    every: int = 5
    same_rollout: bool = False
    gradient_latents: int | None = 21
    adversarial: AdversarialTerm | None = None
    tail_drop: TailDrop | None = None

    @property
    def perceptual(self) -> bool:
        """It has no perceptual term."""
        return False

    def task(self, inputs: StageInputs) -> DistillationTask:
        """Make the stage's batches and losses."""
        return DistillationTask(self, inputs)


@dataclass(frozen=True)
class RolloutNoise:
    """Noise of a rollout and of its scores.

    Args:
        eps: Of the source of every step up to the exit, each ``(B, C, N, H, W)``.
        context: Of the cache write.
        score: Of the scores' mixed source.
        xi: Of the adversarial regularisers.
        sigma: ``(B,)`` noise levels of the scores.
    """

    eps: tuple[Tensor, ...]
    context: Tensor
    score: Tensor
    xi: Tensor
    sigma: Tensor


@dataclass(frozen=True)
class DistillationBatch:
    """Clips, and the noise of the student's update (None: it has none now) and of the fake
    score's.
    """

    sample: Sample
    student: RolloutNoise | None
    critic: RolloutNoise


class DistillationTask:
    """Batches and losses of `Distillation`."""

    def __init__(self, config: Distillation, inputs: StageInputs) -> None:
        self.config, self.inputs, self.attention = config, inputs, inputs.attention
        self.batches = ClipBatches(inputs.clips, inputs.vae, inputs.form, inputs.conditioning)
        self.student, fake, real = (
            transformer_of(inputs, part) for part in ("dit", "fake", "real")
        )
        taps = config.adversarial.taps if config.adversarial else ()
        self.real = ScoreNet(real.requires_grad_(False).to(inputs.device))
        self.fake = ScoreNet(fake, taps)
        parts: dict[str, nn.Module] = {"dit": self.student, "vae": inputs.vae, "fake": fake}
        if config.adversarial is not None:
            a = config.adversarial
            seed = derive_seed("training", inputs.form.seed, "adversarial head")
            parts["head"] = AdversarialHead(
                self.student.sizes.width, len(a.taps), a.heads, a.inner, seed
            )
        self.parts = nn.ModuleDict(parts)
        self.schedule = steps(config.steps)
        self.channel_weights = channel_weights_of(inputs)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the configuration."""
        return {"objective": "distribution matching distillation", **asdict(self.config)}

    def batch(self, index: int) -> DistillationBatch:
        """Make batch ``index``."""
        seed = self.batches.form.seed
        sample = self.batches[index].sample
        if self.config.tail_drop is not None:
            sample = self.config.tail_drop(sample, seed, index)
        exit_step = int(stream("training", seed, "dmd.exit", index).integers(self.config.steps))

        def noise(whose: str) -> RolloutNoise:
            rng = stream("training", seed, f"dmd.{whose}", index)

            def normal() -> Tensor:
                return torch.from_numpy(rng.standard_normal(sample.z_0.shape, dtype=np.float32))

            sigma = score_levels(torch.from_numpy(rng.random(len(sample.z_0), dtype=np.float32)))
            return RolloutNoise(
                tuple(normal() for _ in range(exit_step + 1)), normal(), normal(), normal(), sigma
            )

        trains_student = index // self.inputs.accumulate % self.config.every == 0
        return DistillationBatch(
            sample, noise("student") if trains_student else None, noise("critic")
        )

    def loss(self, batch: DistillationBatch, index: int) -> Loss:
        """Return the fake score's loss, with the student's where it is trained; neither reaches the
        other's weights.
        """
        s = batch.sample
        z = None
        numbers: dict[str, Tensor] = {}
        losses: list[Tensor] = []
        if batch.student is not None:
            z = self.roll_out(s, batch.student)
            loss, parts = self._student_loss(z, s, batch.student)
            losses.append(loss)
            numbers |= parts
        if z is None or not self.config.same_rollout:
            with torch.no_grad():
                z = self.roll_out(s, batch.critic)
        loss, parts = self._critic_loss(z.detach(), s, batch.critic)
        losses.append(loss.double())
        return torch.stack(losses).sum(), numbers | parts

    def roll_out(self, s: Sample, noise: RolloutNoise) -> Tensor:
        """Return the student's clips, with gradients as `causal_rollout` says."""
        sources = [mixed_source(s.z_r, s.m, eps) for eps in noise.eps]
        return causal_rollout(
            self.student,
            sources,
            self.schedule[: len(sources)],
            noise.context,
            no_text(self.student, s.z_0),
            s.condition,
            self.attention,
            self.config.gradient_latents,
        )

    def _student_loss(
        self, z: Tensor, s: Sample, noise: RolloutNoise
    ) -> tuple[Tensor, dict[str, Tensor]]:
        n = mixed_source(s.z_r, s.m, noise.score)
        sigma = noise.sigma
        g, normaliser = direction(
            self.real.given(s.condition), self.fake.given(s.condition), z.detach(), n, sigma
        )
        loss = generator_loss(z, g)
        numbers = {
            "dmd": loss.detach(),
            "direction": g.abs().mean(),
            "normaliser_min": normaliser.min(),
            "rollout": (z.detach() - s.z_0).square().mean(),
            "render": (s.z_r - s.z_0).square().mean(),
        }
        if self.config.adversarial is not None:
            logits = self._logits(noised(z, n, sigma), sigma, s.condition, frozen=True)
            loss = loss + self.config.adversarial.generator(logits)
            numbers["logit_student"] = logits.detach().mean()
        return loss, numbers

    def _critic_loss(
        self, z: Tensor, s: Sample, noise: RolloutNoise
    ) -> tuple[Tensor, dict[str, Tensor]]:
        n = mixed_source(s.z_r, s.m, noise.score)
        sigma = noise.sigma
        term = self.config.adversarial
        loss = critic_loss(self.fake.given(s.condition), z, n, sigma, self.channel_weights)
        numbers = {"critic": loss.detach()}
        if term is None:
            return loss, numbers
        # Of the forward just made, on the noised rollout
        fake = self.parts["head"](self.fake.features)
        x_real = noised(s.z_0, n, sigma)
        x_fake = noised(z, n, sigma)
        adversarial, real = term.critic(
            lambda x: self._logits(x, sigma, s.condition), x_real, x_fake, fake, noise.xi
        )
        numbers |= {
            "logit_real": real.detach().mean(),
            "logit_fake": fake.detach().mean(),
        }
        logit = float(numbers["logit_real"])
        if abs(logit) > term.most:
            raise InfrastructureError(
                f"the adversarial head: real clips have the mean logit {logit:.3g}, beyond {term.most:g}: the head no longer teaches",
                "lower the learning rate, and begin in another folder",
            )
        return loss + adversarial, numbers

    def _logits(self, x: Tensor, sigma: Tensor, condition: Tensor, frozen: bool = False) -> Tensor:
        """Return the head's logits of noised latents; ``frozen`` sends gradients to the latents
        alone.
        """
        self.fake(x, sigma, condition, frozen)
        head = self.parts["head"]
        return (
            functional_call(head, _detached(head), (self.fake.features,))
            if frozen
            else head(self.fake.features)
        )


class ScoreNet:
    """A transformer as a score: the whole clip at once, without window or cache, one noise level a
    clip.

    Args:
        net: The transformer.
        taps: Blocks whose outputs are kept.

    Attributes:
        features: Outputs ``(B, T, N, width)`` of the tapped blocks in the last forward.
    """

    def __init__(self, net: CosmosCausalDiT, taps: Sequence[int] = ()) -> None:
        self.net = net
        self._kept: dict[int, Tensor] = {}
        self._taps = taps
        for tap in taps:
            net.blocks[tap].register_forward_hook(
                lambda _, __, out, tap=tap: self._kept.__setitem__(tap, out)
            )

    @property
    def features(self) -> list[Tensor]:
        """Outputs of the tapped blocks in the last forward, in the order of ``taps``."""
        return [self._kept[tap] for tap in self._taps]

    def __call__(self, x: Tensor, sigma: Tensor, condition: Tensor, frozen: bool = False) -> Tensor:
        """Return the velocity of noised clips ``(B, C, N, H, W)`` at levels ``(B,)``; ``frozen``
        sends no gradient to the weights.
        """
        args = (x, T_SOURCE * sigma[:, None], no_text(self.net, x), condition)
        attention = {"block_latents": None}
        return (
            functional_call(self.net, _detached(self.net), args, attention)
            if frozen
            else self.net(*args, **attention)
        )

    def given(self, condition: Tensor) -> Score:
        """Return the score of clips with this condition."""
        return lambda x, sigma: self(x, sigma, condition)


def _detached(module: nn.Module) -> dict[str, Tensor]:
    return {name: parameter.detach() for name, parameter in module.named_parameters()}
