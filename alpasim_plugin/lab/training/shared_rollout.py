"""OneFixer's training objectives on one shared rollout (paper, Sec. 3.2 and 3.3).

    rollout         z^i_0 = G(z^i_1 | sg(z^<i_0), c^i)                   the deployed generator, block by block
    flow matching   | v(z^i_t, t | sg(z^<i_0), c^i) - (z^i_1 - z^i_0) |^2   at every position, with the rollout as its history
    perceptual      d( D(z^w_0), D(clean^w) )                            at one sampled position w, through the last k predictions

Names as in the paper: ``z_r`` render, ``z_0`` clean, ``z_1`` source, ``m`` mask, ``eps`` noise,
``sg`` stop-gradient. Latents are ``(B, C, N, H, W)``, normalised. All random numbers are arguments.
A source of noise alone is Eq. 1 with m = 0. The history of a block holds the keys and values of its
clean latents, slightly noised (`sampling.finalise`), as at deployment; their gradient reaches the
weights, not the latents.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.block_fixers.sampling import finalise, flow_step, mixed_source
from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.schedule import interpolant
from alpasim_plugin.lab.training.graph_cache import GraphCache

FlowHistory = Literal["own", "clean", "redenoised"]
Predicted = Literal["own", "redenoised"]
Perceptual = Callable[[Tensor, int], Tensor]  # predictions (B, C, N, H, W), position w -> scalar
T_SOURCE = 1000.0  # time input of the network at t = 1


@dataclass(frozen=True)
class Objectives:
    """Loss terms and the history they are computed on: the axes of the paper's ablation.

    Args:
        flow: History of flow matching: the model's ``own`` predictions, the ``clean`` latents
            (teacher forcing), clean latents that the model noised and denoised again
            (``redenoised``), or None without flow matching.
        horizon: k, number of latent positions ending at w that the perceptual gradient passes
            through; 0 without a perceptual term.
        weight: lambda, of the perceptual term.
        predicted: Predictions that the perceptual term compares: the model's ``own`` rollout, or
            the ``redenoised`` clean latents.
    """

    flow: FlowHistory | None = "own"
    horizon: int = 4
    weight: float = 10.0
    predicted: Predicted = "own"

    def __post_init__(self) -> None:
        if self.flow is None and not self.horizon:
            raise InputError(
                "flow None, horizon 0: nothing to minimise",
                "switch one of them on",
            )
        if self.horizon < 0 or self.weight < 0:
            raise InputError(
                f"the perceptual term: horizon {self.horizon}, weight {self.weight}",
                "give values of at least 0",
            )


@dataclass(frozen=True)
class Sample:
    """A batch of clips as latents, with all noise of the training step.

    Args:
        z_r, z_0: Render and clean frames ``(B, C, N, H, W)``.
        condition: ``(B, channels, N, H, W)`` what the network sees besides its source: the semantic
            map, and what else its sizes name.
        m: ``(B, 1, N, H, W)`` mask of Eq. 1.
        eps: Noise of the source, like ``z_0``.
        eps_context: Noise of the cache write, like ``z_0``.
        t: ``(B, N)`` uniform in 0..1, flow matching's times.
        t_redenoise: ``(B, N)`` uniform in 0..1, the noise levels of re-denoised history.
        w: Position of the perceptual term.
    """

    z_r: Tensor
    z_0: Tensor
    condition: Tensor
    m: Tensor
    eps: Tensor
    eps_context: Tensor
    t: Tensor
    t_redenoise: Tensor
    w: int


@dataclass(frozen=True)
class Losses:
    """Loss terms of one batch.

    Args:
        total: Weighted sum.
        flow: Mean over all elements; None if off.
        perceptual: Unweighted; None if off.
        rollout: ``(B, C, N, H, W)`` the model's predictions, detached: those of the perceptual term
            if it is on; None if no term needs any.
        predictions: The predictions up to w of the perceptual term, block by block, before
            detaching at the horizon.
    """

    total: Tensor
    flow: Tensor | None
    perceptual: Tensor | None
    rollout: Tensor | None
    predictions: tuple[Tensor, ...] = ()


def losses(
    net: CosmosCausalDiT,
    sample: Sample,
    text: Tensor | TextContext,
    objectives: Objectives,
    perceptual: Perceptual | None = None,
    *,
    block_latents: int = 2,
    window: int | None = 12,
    channel_weights: Tensor | None = None,
) -> Losses:
    """Return the objectives of one batch of clips, all on the same rollout.

    Args:
        net: The generator.
        sample: Latents and noise.
        text: Prompt.
        objectives: Loss terms.
        perceptual: Decodes the predictions causally and compares position w with the clean frames;
            required with ``objectives.horizon``.
        block_latents, window: As at deployment, in latents.
        channel_weights: ``(C,)`` of the flow-matching error, mean 1; None for equal weights. The
            minimiser does not depend on them.

    Raises:
        InputError: A perceptual term without a function, or w outside the clip.
    """
    n = sample.z_0.shape[2]
    if objectives.horizon and perceptual is None:
        raise InputError(
            "the perceptual term: no distance function",
            "give one, or horizon=0",
        )
    if not 0 <= sample.w < n:
        raise InputError(
            f"w = {sample.w}: {n} latents",
            "sample w within the clip",
        )
    rollout = _Rollout(net, sample, text, objectives, block_latents, window)
    history = rollout.history()
    flow = None if objectives.flow is None else rollout.flow_matching(history, channel_weights)
    predictions: tuple[Tensor, ...] = ()
    perc = None
    if objectives.horizon:
        assert perceptual is not None
        predictions = rollout.predictions_with_gradient()
        perc = perceptual(
            torch.cat(
                [rollout.cut(z, b) for z, b in zip(predictions, rollout.blocks, strict=False)],
                dim=2,
            ),
            sample.w,
        )
    terms = [
        term
        for term in (flow, None if perc is None else objectives.weight * perc)
        if term is not None
    ]
    return Losses(torch.stack(terms).sum(), flow, perc, rollout.predicted, predictions)


def channel_weighted(squares: Tensor, channel_weights: Tensor | None) -> Tensor:
    """Return squared errors ``(B, C, ...)`` times the weights ``(C,)`` of their channels."""
    return (
        squares
        if channel_weights is None
        else squares
        * upload(channel_weights, squares.device).view(1, -1, *[1] * (squares.ndim - 2))
    )


@torch.no_grad()
def roll_out(
    net: CosmosCausalDiT,
    z_r: Tensor,
    condition: Tensor,
    m: Tensor,
    eps: Tensor,
    eps_context: Tensor,
    text: Tensor | TextContext,
    *,
    block_latents: int = 2,
    window: int | None = 12,
) -> Tensor:
    """Return the generator's own predictions of whole clips ``(B, C, N, H, W)``, as at deployment;
    see `Sample`.
    """
    t = torch.ones(z_r.shape[0], z_r.shape[2])
    sample = Sample(z_r, z_r, condition, m, eps, eps_context, t, t, z_r.shape[2] - 1)
    made = _Rollout(net, sample, text, Objectives("own", 0), block_latents, window).history()
    assert made is not None, "own history"
    return made


class _Rollout:
    """Rollout of one batch through the generator; the methods are the equations."""

    def __init__(
        self,
        net: CosmosCausalDiT,
        s: Sample,
        text: Tensor | TextContext,
        objectives: Objectives,
        block_latents: int,
        window: int | None,
    ) -> None:
        self.net, self.s, self.text, self.objectives = net, s, text, objectives
        n = s.z_0.shape[2]
        self.blocks = [slice(i, min(i + block_latents, n)) for i in range(0, n, block_latents)]
        self.window = window
        self.z_1 = mixed_source(s.z_r, s.m, s.eps)
        self.predict = self.generate if objectives.predicted == "own" else self.denoise_again
        # First position whose prediction keeps its gradient
        self.first = max(s.w - objectives.horizon + 1, 0)
        self.predicted: Tensor | None = None
        self._before: GraphCache | None = (
            None  # the rollout's cache before the block that holds ``first``
        )

    def history(self) -> Tensor | None:
        """Return the history of flow matching ``(B, C, N, H, W)`` without gradients, and compute
        the rollouts that are needed.
        """
        flow = self.objectives.flow
        compared = self.objectives.predicted if self.objectives.horizon else None
        with torch.no_grad():
            if compared is not None:
                self.predicted = self._roll(self.predict, fork_at=self.first)
            if flow is None or flow == "clean":
                return None if flow is None else self.s.z_0
            if flow == compared:
                return self.predicted
            made = self._roll(self.generate if flow == "own" else self.denoise_again)
            if self.predicted is None:
                self.predicted = made
            return made

    def generate(self, b: slice, cache: GraphCache) -> Tensor:
        """Predict a block in one step from its source (Eq. 2); leaves the block open."""
        v = self.net.step(
            self.z_1[:, :, b], T_SOURCE, self.text, self.s.condition[:, :, b], cache, write=False
        )
        return flow_step(self.z_1[:, :, b], v)

    def flow_matching(
        self, history: Tensor | None, channel_weights: Tensor | None = None
    ) -> Tensor:
        """Return the mean error of the velocity over all positions, each at its random time, given
        the history.
        """
        assert history is not None
        s = self.s
        cache = self._new_cache()
        errors = []
        t = s.t[:, None, :, None, None]
        z_t = interpolant(s.z_0, self.z_1, t)
        for b in self.blocks:
            v = self.net.step(
                z_t[:, :, b],
                T_SOURCE * s.t[:, b],
                self.text,
                self.s.condition[:, :, b],
                cache,
                write=False,
            )
            errors.append(
                channel_weighted((v - (self.z_1 - s.z_0)[:, :, b]).square(), channel_weights).mean(
                    dim=(0, 1, 3, 4)
                )
            )
            self._write(history[:, :, b], b, cache)
        return torch.cat(errors).mean()

    def predictions_with_gradient(self) -> tuple[Tensor, ...]:
        """Return the predictions of the blocks up to w's, with gradients from the block of the
        horizon's first position on.

        The values equal the rollout's: same network, sources and history. Predictions before the
        horizon are detached before they enter the history.
        """
        assert self.predicted is not None
        assert self._before is not None
        cache = self._before
        out: list[Tensor] = []
        for b in self.blocks:
            if b.start > self.s.w:
                break
            if b.stop <= self.first:
                out.append(self.predicted[:, :, b])
                continue
            out.append(self.predict(b, cache))
            self._write(self.cut(out[-1], b), b, cache)
        return tuple(out)

    def cut(self, z: Tensor, b: slice) -> Tensor:
        """Return a block's predictions with those before the horizon detached."""
        outside = min(max(self.first - b.start, 0), z.shape[2])
        return torch.cat([z[:, :, :outside].detach(), z[:, :, outside:]], dim=2)

    def _roll(
        self, make: Callable[[slice, GraphCache], Tensor], fork_at: int | None = None
    ) -> Tensor:
        """Predict the blocks in order, each with its predecessors as history; keep a fork of the
        cache before the block of ``fork_at``.
        """
        cache = self._new_cache()
        parts = []
        for b in self.blocks:
            if fork_at is not None and b.start <= fork_at < b.stop:
                self._before = cache.fork()
            parts.append(make(b, cache))
            self._write(parts[-1], b, cache)
        return torch.cat(parts, dim=2)

    def denoise_again(self, b: slice, cache: GraphCache) -> Tensor:
        """Noise the clean latents to a random level and denoise them, given previously denoised
        blocks.
        """
        t = self.s.t_redenoise[:, b]
        z_t = interpolant(self.s.z_0[:, :, b], self.z_1[:, :, b], t[:, None, :, None, None])
        v = self.net.step(
            z_t, T_SOURCE * t, self.text, self.s.condition[:, :, b], cache, write=False
        )
        return flow_step(z_t, v, t[:, None, :, None, None])

    def _write(self, z: Tensor, b: slice, cache: GraphCache) -> None:
        finalise(
            self.net, z, self.s.eps_context[:, :, b], self.text, self.s.condition[:, :, b], cache
        )

    def _new_cache(self) -> GraphCache:
        b, _, _, h, w = self.s.z_0.shape
        return GraphCache.of(self.net, b, h, w, self.window)
