"""Distribution matching distillation (DMD) on the student's own rollouts: Self-Forcing, ArtiFixer's
last stage, and One-Forcing.

    x = (1 - sigma) Z + sigma n                                   Z: the student's rollout, n: a freshly mixed source (Eq. 1)
    critic      | F(x, sigma) - (n - Z) |^2                       trains the fake score F on Z, without a gradient to the student
    direction   g = (x0_F - x0_R) / mean |Z - x0_R|               x0 = x - sigma v: what the fake and the real score see behind x
    generator   1/2 mean (Z - sg(Z - g))^2                        its gradient to Z is g, over the number of elements

Sources: Self-Forcing and ArtiFixer (public code). The scores are bidirectional, with one noise
    level a clip. There is no guidance: the
prompt is one zero token, so the unconditional score would be the conditional one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.sampling import flow_step
from alpasim_plugin.fixers.network.schedule import SHIFT, TABLE, interpolant
from alpasim_plugin.lab.training.shared_rollout import channel_weighted

Score = Callable[[Tensor, Tensor], Tensor]  # x (B, C, N, H, W), sigma (B,) -> velocity like x
NORMALISER_FLOOR = 1e-6
LEAST_SIGMA = 0.02
MOST_SIGMA = 0.98


class Direction(NamedTuple):
    """Where the student's latents should move from.

    Attributes:
        g: ``(B, C, N, H, W)`` normalised direction, without gradient.
        normaliser: ``(B,)`` mean absolute error of the real score's prediction, before the floor.
    """

    g: Tensor
    normaliser: Tensor


def score_levels(u: Tensor) -> Tensor:
    """Return noise levels for uniform numbers: the table's entry, warped by the schedule's shift,
    within [0.02, 0.98].

    Args:
        u: ``(B,)`` in [0, 1).
    """
    t = torch.floor(u * TABLE) / TABLE
    return (SHIFT * t / (1 + (SHIFT - 1) * t)).clamp(LEAST_SIGMA, MOST_SIGMA)


def noised(z: Tensor, n: Tensor, sigma: Tensor) -> Tensor:
    """Return ``x = (1 - sigma) z + sigma n`` with ``sigma (B,)``."""
    return interpolant(z, n, _per_clip(sigma))


def critic_loss(
    fake: Score, z: Tensor, n: Tensor, sigma: Tensor, channel_weights: Tensor | None = None
) -> Tensor:
    """Return the flow-matching error of the fake score on the student's latents, which get no
    gradient.

    Args:
        fake: Trained score.
        z: ``(B, C, N, H, W)`` the student's latents.
        n: Source like ``z``.
        sigma: ``(B,)`` noise levels.
        channel_weights: ``(C,)`` of the error, mean 1, as in the training of the scores; None for
            equal weights.
    """
    z = z.detach()
    return channel_weighted(
        (fake(noised(z, n, sigma), sigma) - (n - z)).square(), channel_weights
    ).mean()


@torch.no_grad()
def direction(real: Score, fake: Score, z: Tensor, n: Tensor, sigma: Tensor) -> Direction:
    """Return the normalised difference of the two scores' predictions, both behind the same noised
    latents; float64.

    Args:
        real, fake: Scores.
        z: ``(B, C, N, H, W)`` the student's latents.
        n: Source like ``z``.
        sigma: ``(B,)`` noise levels.
    """
    x = noised(z, n, sigma)
    x0_fake, x0_real = (
        flow_step(x, score(x, sigma), _per_clip(sigma)).double() for score in (fake, real)
    )
    normaliser = (z.double() - x0_real).abs().mean(dim=(1, 2, 3, 4))
    g = (x0_fake - x0_real) / _per_clip(normaliser.clamp(min=NORMALISER_FLOOR))
    return Direction(torch.nan_to_num(g, 0.0, 0.0, 0.0), normaliser)


def generator_loss(z: Tensor, g: Tensor) -> Tensor:
    """Return the loss whose gradient to ``z`` is ``g`` over the number of elements; float64."""
    z = z.double()
    return 0.5 * (z - (z - g).detach()).square().mean()


def _per_clip(values: Tensor) -> Tensor:
    return values[:, None, None, None, None]
