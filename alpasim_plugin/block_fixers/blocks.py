"""The transformer block and the final layer, with adaptive layer norm (adaLN) of low rank.

A sub-layer ``f`` (self-attention, cross-attention, MLP) acts as ``x + gate * f(LN(x) * (1 + scale)
+ shift)`` where ``(shift, scale, gate) = B A SiLU(e) + lora`` depends on time only.
"""

from collections.abc import Callable

import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.block_fixers.attention import (
    Attend,
    CrossAttention,
    RopeTable,
    SelfAttention,
)
from alpasim_plugin.block_fixers.layers import (
    PATCH,
    Float32Linear,
    PatchLinear,
    layer_norm,
)
from alpasim_plugin.block_fixers.sizes import DiTSizes

TimeSignal = tuple[Tensor, Tensor]  # emb (B, T, width), lora (B, T, 3 * width), both float32
KeysValues = tuple[Tensor, Tensor]


class LowRankModulation(nn.Sequential):
    """Compute shift, scale (and gate) from the time embedding; keys ``1.weight`` and
    ``2.weight``.
    """

    def __init__(self, width: int, rank: int, parts: int) -> None:
        super().__init__(nn.SiLU(), Float32Linear(width, rank), Float32Linear(rank, parts * width))
        self.parts = parts

    def split(self, emb: Tensor, lora: Tensor) -> tuple[Tensor, ...]:
        """Return ``parts`` tensors ``(B, T, 1, width)`` float32.

        Args:
            emb: ``(B, T, width)``, the normalised sinusoid.
            lora: ``(B, T, 3 * width)``, of which the first ``parts * width`` are added.
        """
        modulation = self(emb) + lora[..., : self.parts * emb.shape[-1]]
        return modulation[:, :, None].chunk(self.parts, dim=-1)


def residual(
    x: Tensor, f: Callable[[Tensor], Tensor], modulation: LowRankModulation, time: TimeSignal
) -> Tensor:
    """Apply one modulated sub-layer with a residual connection.

    Args:
        x: ``(B, T, N, width)``.
        f: The sub-layer, same shape out.
        modulation: Gives shift, scale and gate in float32; cast to the dtype of ``x``.
        time: Time signal.
    """
    shift, scale, gate = (part.to(x.dtype) for part in modulation.split(*time))
    return x + gate * f(layer_norm(x) * (1 + scale) + shift)


class Mlp(nn.Module):
    """Linear, exact GELU, linear; without biases."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        self.layer1 = nn.Linear(width, inner, bias=False)
        self.layer2 = nn.Linear(inner, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(..., width)`` to ``(..., width)``."""
        return self.layer2(F.gelu(self.layer1(x)))


class Block(nn.Module):
    """Self-attention, cross-attention, MLP, in this order, each ``x + gate * f(LN(x) * (1 + scale)
    + shift)``.
    """

    def __init__(self, sizes: DiTSizes) -> None:
        super().__init__()
        self.self_attn = SelfAttention(sizes.width, sizes.width, sizes.head_width)
        self.cross_attn = CrossAttention(sizes.width, sizes.context_width, sizes.head_width)
        self.mlp = Mlp(sizes.width, sizes.mlp_width)
        self.opacity_embed = (
            PatchLinear(sizes.opacity_channels, sizes.width) if sizes.opacity_channels else None
        )
        self.adaln_modulation_self_attn = LowRankModulation(sizes.width, sizes.adaln_rank, 3)
        self.adaln_modulation_cross_attn = LowRankModulation(sizes.width, sizes.adaln_rank, 3)
        self.adaln_modulation_mlp = LowRankModulation(sizes.width, sizes.adaln_rank, 3)

    def forward(
        self,
        x: Tensor,
        time: TimeSignal,
        text: KeysValues,
        table: RopeTable,
        attention: Attend,
        opacity: Tensor | None = None,
    ) -> Tensor:
        """Apply the block.

        Args:
            x: ``(B, T, N, width)``.
            time: Time signal.
            text: Cross-attention keys and values of this block.
            table: Rotation of the block's tokens.
            attention: Self-attention with the cached past.
            opacity: ``(B, opacity_channels, T, H, W)`` for a block that embeds it: added to the
                modulated input of self-attention.
        """
        opacity_embedding = None
        if self.opacity_embed is not None and opacity is not None:
            opacity_embedding = self.opacity_embed.embed(opacity)
        x = residual(
            x,
            lambda n: self.self_attn(n, table, attention, opacity_embedding),
            self.adaln_modulation_self_attn,
            time,
        )
        x = residual(x, lambda n: self.cross_attn(n, text), self.adaln_modulation_cross_attn, time)
        return residual(x, self.mlp, self.adaln_modulation_mlp, time)


class FinalLayer(nn.Module):
    """Map tokens to patches of velocity: ``Linear(LN(x) * (1 + scale) + shift)``."""

    def __init__(self, sizes: DiTSizes) -> None:
        super().__init__()
        self.linear = nn.Linear(sizes.width, sizes.latent_channels * PATCH * PATCH, bias=False)
        self.adaln_modulation = LowRankModulation(sizes.width, sizes.adaln_rank, 2)

    def forward(self, x: Tensor, time: TimeSignal) -> Tensor:
        """Map ``(B, T, N, width)`` to ``(B, T, N, 4 * channels)``, ordered (row, column,
        channel).
        """
        shift, scale = (part.to(x.dtype) for part in self.adaln_modulation.split(*time))
        return self.linear(layer_norm(x) * (1 + scale) + shift)
