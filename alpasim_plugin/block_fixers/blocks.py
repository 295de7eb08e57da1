"""Adaptive layer norm (adaLN) with low-rank modulation, and its exact folding into the weights for
one fixed time step.

A sub-layer ``f`` (self-attention, cross-attention, MLP) acts as ``x + gate * f(LN(x) * (1 + scale)
+ shift)`` where ``(shift, scale, gate) = B A SiLU(e) + lora`` depends on time only. For one fixed
time step the three vectors are constants: with ``W`` the first and ``V`` the last linear of ``f``,

    W (n * (1 + scale) + shift) = (W diag(1 + scale)) n + W shift         and         gate * (V y) = (diag(gate) V) y,

so they are folded into the weights and a plain pre-norm transformer remains.

The transformer block and the final layer, with adaLN modulation or with the modulation folded into
the weights.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.block_fixers.attention import Attend, CrossAttention, RopeTable, SelfAttention
from alpasim_plugin.block_fixers.layers import PATCH, Float32Linear, PatchLinear, layer_norm
from alpasim_plugin.block_fixers.sizes import DiTSizes

Modulation = tuple[Tensor, Tensor, Tensor]  # shift, scale, gate: (B, T, 1, width)
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
        both: Tensor = self(emb) + lora[..., : self.parts * emb.shape[-1]]
        return both[:, :, None].chunk(self.parts, dim=-1)


def residual(x: Tensor, f: Callable[[Tensor], Tensor], modulation: Modulation | None) -> Tensor:
    """Apply one modulated sub-layer with a residual connection; modulation None: it is folded into
    ``f``.

    Args:
        x: ``(B, T, N, width)``.
        f: The sub-layer, same shape out.
        modulation: Shift, scale and gate in float32; cast to the dtype of ``x``.
    """
    if modulation is None:
        return x + f(layer_norm(x))
    shift, scale, gate = (part.to(x.dtype) for part in modulation)
    return x + gate * f(layer_norm(x) * (1 + scale) + shift)


def fold_input(linear: nn.Linear, shift: Tensor, scale: Tensor) -> nn.Linear:
    """Return ``n -> W (n * (1 + scale) + shift) + b`` as one linear; sums in float64, stored in the
    weight's dtype.
    """
    weight, bias = _wide(linear)
    return _linear(
        weight * (1 + scale.double().flatten()),
        bias + weight @ shift.double().flatten(),
        linear.weight,
    )


def fold_output(linear: nn.Linear, gate: Tensor) -> nn.Linear:
    """Return ``y -> gate * (V y + b)`` as one linear."""
    weight, bias = _wide(linear)
    gain = gate.double().flatten()
    return _linear(
        gain[:, None] * weight, gain * bias if linear.bias is not None else None, linear.weight
    )


def stack_rows(linears: list[nn.Linear]) -> nn.Linear:
    """Concatenate linears of one input into a single one."""
    weights, biases = zip(*(_wide(linear) for linear in linears), strict=True)
    return _linear(torch.cat(weights), torch.cat(biases), linears[0].weight)


def _wide(linear: nn.Linear) -> tuple[Tensor, Tensor]:
    weight = linear.weight.detach().double()
    bias = (
        weight.new_zeros(weight.shape[0]) if linear.bias is None else linear.bias.detach().double()
    )
    return weight, bias


def _linear(weight: Tensor, bias: Tensor | None, like: Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None, device="meta")
    layer.weight = nn.Parameter(weight.to(like.dtype), requires_grad=False)
    if bias is not None:
        layer.bias = nn.Parameter(bias.to(like.dtype), requires_grad=False)
    return layer


class Mlp(nn.Module):
    """Linear, exact GELU, linear; without biases unless modulation is folded in."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        self.layer1 = nn.Linear(width, inner, bias=False)
        self.layer2 = nn.Linear(inner, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(..., width)`` to ``(..., width)``."""
        out: Tensor = self.layer2(F.gelu(self.layer1(x)))
        return out


class Block(nn.Module):
    """Self-attention, cross-attention, MLP, in this order, each ``x + gate * f(LN(x) * (1 + scale)
    + shift)``.
    """

    def __init__(self, sizes: DiTSizes) -> None:
        super().__init__()
        self.self_attn = SelfAttention(sizes.width, sizes.head_width)
        self.cross_attn = CrossAttention(sizes.width, sizes.context_width, sizes.head_width)
        self.mlp = Mlp(sizes.width, sizes.mlp_width)
        self.opacity_embed = (
            PatchLinear(sizes.opacity_channels, sizes.width) if sizes.opacity_channels else None
        )
        self.adaln_modulation_self_attn: LowRankModulation | None = LowRankModulation(
            sizes.width, sizes.adaln_rank, 3
        )
        self.adaln_modulation_cross_attn: LowRankModulation | None = LowRankModulation(
            sizes.width, sizes.adaln_rank, 3
        )
        self.adaln_modulation_mlp: LowRankModulation | None = LowRankModulation(
            sizes.width, sizes.adaln_rank, 3
        )

    def forward(
        self,
        x: Tensor,
        time: TimeSignal | None,
        text: KeysValues,
        table: RopeTable,
        attention: Attend,
        opacity: Tensor | None = None,
    ) -> Tensor:
        """Apply the block.

        Args:
            x: ``(B, T, N, width)``.
            time: Time signal; None once folded.
            text: Cross-attention keys and values of this block.
            table: Rotation of the block's tokens.
            attention: Self-attention with the cached past.
            opacity: ``(B, opacity_channels, T, H, W)`` for a block that embeds it: added to the
                modulated input of self-attention.
        """
        seen = (
            None
            if self.opacity_embed is None or opacity is None
            else self.opacity_embed.embed(opacity)
        )
        x = residual(
            x,
            lambda n: self.self_attn(n, table, attention, seen),
            _modulation(self.adaln_modulation_self_attn, time),
        )
        x = residual(
            x,
            lambda n: self.cross_attn(n, text),
            _modulation(self.adaln_modulation_cross_attn, time),
        )
        return residual(x, self.mlp, _modulation(self.adaln_modulation_mlp, time))

    def fold(self, time: TimeSignal) -> None:
        """Fold the modulation of one time step into the weights, in place; queries, keys and values
        become one linear.
        """
        attn = self.self_attn
        cross = self.cross_attn
        mlp = self.mlp
        shift, scale, gate = _require(self.adaln_modulation_self_attn, time)
        qkv = stack_rows([attn.q_proj, attn.k_proj, attn.v_proj])
        if (
            self.opacity_embed is not None
        ):  # added after scale and shift, so it passes the projections as they are
            self.opacity_embed.follow(qkv.weight)
        attn.fuse(fold_input(qkv, shift, scale))
        attn.output_proj = fold_output(attn.output_proj, gate)
        shift, scale, gate = _require(self.adaln_modulation_cross_attn, time)
        cross.q_proj = fold_input(cross.q_proj, shift, scale)
        cross.output_proj = fold_output(cross.output_proj, gate)
        shift, scale, gate = _require(self.adaln_modulation_mlp, time)
        mlp.layer1 = fold_input(mlp.layer1, shift, scale)
        mlp.layer2 = fold_output(mlp.layer2, gate)
        self.adaln_modulation_self_attn = self.adaln_modulation_cross_attn = (
            self.adaln_modulation_mlp
        ) = None


class FinalLayer(nn.Module):
    """Map tokens to patches of velocity: ``Linear(LN(x) * (1 + scale) + shift)``."""

    def __init__(self, sizes: DiTSizes) -> None:
        super().__init__()
        self.linear = nn.Linear(sizes.width, sizes.latent_channels * PATCH * PATCH, bias=False)
        self.adaln_modulation: LowRankModulation | None = LowRankModulation(
            sizes.width, sizes.adaln_rank, 2
        )

    def forward(self, x: Tensor, time: TimeSignal | None) -> Tensor:
        """Map ``(B, T, N, width)`` to ``(B, T, N, 4 * channels)``, ordered (row, column,
        channel).
        """
        if self.adaln_modulation is None:
            return cast(Tensor, self.linear(layer_norm(x)))
        assert time is not None, "a network that is not folded needs its time signal"
        shift, scale = (part.to(x.dtype) for part in self.adaln_modulation.split(*time))
        return cast(Tensor, self.linear(layer_norm(x) * (1 + scale) + shift))

    def fold(self, time: TimeSignal) -> None:
        """Fold the modulation of one time step into the weights, in place."""
        assert self.adaln_modulation is not None, "folded twice"
        shift, scale = self.adaln_modulation.split(*time)
        self.linear = fold_input(self.linear, shift, scale)
        self.adaln_modulation = None


def _modulation(layer: LowRankModulation | None, time: TimeSignal | None) -> Modulation | None:
    return None if layer is None else _require(layer, time)


def _require(layer: LowRankModulation | None, time: TimeSignal | None) -> Modulation:
    assert layer is not None, "folded twice"
    assert time is not None, "a network that is not folded needs its time signal"
    shift, scale, gate = layer.split(*time)
    return shift, scale, gate
