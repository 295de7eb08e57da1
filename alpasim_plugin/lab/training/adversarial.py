"""One-Forcing's adversarial head on the fake score's trunk: does a noised clip look real?

One learned token a tapped block attends to that block's output, and their concatenation gives one
logit a clip. The head sees clips at the noise levels of the critic. Losses are the chunk-wise ones,
with both regularisers:

    generator   w softplus(-D(x_fake))
    critic      w [softplus(-D(x_real)) + softplus(D(x_fake))]
                + mean (D(x_real + .1 xi) - D(x_real))^2                        R1, approximate
                + .0005 mean ((D(x_fake + .01 xi) - D(x_fake)) / .01)^2         R2, approximate

Source: One-Forcing (public code). x_real and x_fake share source and noise level.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.block_fixers.attention import attend
from alpasim_plugin.block_fixers.layers import RMSNorm
from alpasim_plugin.core.errors import InputError

TOKEN_STD = 0.02
Logits = Callable[[Tensor], Tensor]  # noised latents (B, C, N, H, W) -> (B,)


@dataclass(frozen=True)
class AdversarialTerm:
    """Weights of the adversarial losses, and the size of the head.

    Args:
        weight: Of the adversarial terms of generator and critic.
        taps: Blocks of the trunk that the head sees, counted from the end.
        heads, inner: Attention heads and inner channels of the head.
        r1, r1_step, r2, r2_step: Weights and steps of the regularisers.
        most: Largest mean logit of real clips, in size, before a run is stopped.
    """

    weight: float = 0.03
    taps: tuple[int, ...] = (-1,)
    heads: int = 4
    inner: int = 64
    r1: float = 1.0
    r1_step: float = 0.1
    r2: float = 0.0005
    r2_step: float = 0.01
    most: float = 10.0

    def generator(self, fake: Tensor) -> Tensor:
        """Return the generator's loss for the logits ``(B,)`` of its clips."""
        return self.weight * F.softplus(-fake).mean()

    def critic(
        self, logits: Logits, x_real: Tensor, x_fake: Tensor, fake: Tensor, xi: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the critic's loss and the logits of the real clips.

        Args:
            logits: The head on the trunk.
            x_real, x_fake: ``(B, C, N, H, W)`` noised alike.
            fake: Logits of ``x_fake``.
            xi: Standard normal noise like ``x_real``.
        """
        real = logits(x_real)
        loss = self.weight * (F.softplus(-real).mean() + F.softplus(fake).mean())
        loss = loss + self.r1 * (logits(x_real + self.r1_step * xi) - real).square().mean()
        return loss + self.r2 * (
            (logits(x_fake + self.r2_step * xi) - fake) / self.r2_step
        ).square().mean(), real


class AdversarialHead(nn.Module):
    """Map the outputs of tapped blocks to one logit a clip.

    Args:
        width: Channels of the trunk.
        taps: Number of tapped blocks.
        heads, inner: See `AdversarialTerm`.
        seed: Of the initial weights.

    Raises:
        InputError: A width that the heads do not divide.
    """

    def __init__(self, width: int, taps: int, heads: int, inner: int, seed: int) -> None:
        super().__init__()
        if width % heads:
            raise InputError(
                f"{heads} heads: width {width}",
                "choose heads that divide it",
            )
        with torch.device("meta"):  # layers would draw initial values from the global generator
            self.readers = nn.ModuleList(_Reader(width, heads, inner) for _ in range(taps))
            self.verdict = nn.Sequential(
                nn.LayerNorm(taps * width),
                nn.Linear(taps * width, inner),
                nn.SiLU(),
                nn.Linear(inner, 1),
            )
        self.to_empty(device="cpu")
        generator = torch.Generator().manual_seed(seed % 2**63)
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                if name.endswith("token"):
                    parameter.normal_(std=TOKEN_STD, generator=generator)
                elif parameter.ndim == 2:
                    parameter.normal_(std=parameter.shape[1] ** -0.5, generator=generator)
                else:
                    parameter.fill_(0.0 if name.endswith("bias") else 1.0)

    def forward(self, features: Sequence[Tensor]) -> Tensor:
        """Map the features ``(B, T, N, width)`` of every tapped block to logits ``(B,)``."""
        tokens = [reader(x.flatten(1, 2)) for reader, x in zip(self.readers, features, strict=True)]
        logit: Tensor = self.verdict(torch.cat(tokens, dim=-1))
        return logit[:, 0]


class _Reader(nn.Module):
    """A learned token that attends to one block's features."""

    def __init__(self, width: int, heads: int, inner: int) -> None:
        super().__init__()
        self.heads = heads
        self.token = nn.Parameter(torch.zeros(width))
        self.token_norm, self.features_norm, self.inner_norm = (
            RMSNorm(width),
            nn.LayerNorm(width),
            nn.LayerNorm(width),
        )
        self.q, self.k, self.v, self.out = (nn.Linear(width, width, bias=False) for _ in range(4))
        self.q_norm = RMSNorm(width // heads)
        self.k_norm = RMSNorm(width // heads)
        self.ffn = nn.Sequential(nn.Linear(width, inner), nn.GELU("tanh"), nn.Linear(inner, width))

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, L, width)`` to the token's ``(B, width)``."""
        token = self.token_norm(self.token).expand(len(x), 1, -1)
        features = self.features_norm(x)
        q, k, v = (
            layer(y).unflatten(-1, (self.heads, -1))
            for layer, y in ((self.q, token), (self.k, features), (self.v, features))
        )
        token = token + self.out(attend(self.q_norm(q), self.k_norm(k), v))
        out: Tensor = token + self.ffn(self.inner_norm(token))
        return out[:, 0]
