"""Adaptive layer norm (adaLN) with low-rank modulation, and its exact folding into the weights for one fixed time step.

A sub-layer ``f`` (self-attention, cross-attention, MLP) acts as ``x + gate * f(LN(x) * (1 + scale) + shift)`` where ``(shift, scale,
gate) = B A SiLU(e) + lora`` depends on time only. For one fixed time step the three vectors are constants: with ``W`` the first and
``V`` the last linear of ``f``,

    W (n * (1 + scale) + shift) = (W diag(1 + scale)) n + W shift         and         gate * (V y) = (diag(gate) V) y,

so they are folded into the weights and a plain pre-norm transformer remains.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from alpasim_plugin.nets.layers import Float32Linear, layer_norm

Modulation = tuple[Tensor, Tensor, Tensor]  # shift, scale, gate: (B, T, 1, width)


class LowRankModulation(nn.Sequential):
    """Compute shift, scale (and gate) from the time embedding; keys ``1.weight`` and ``2.weight``."""

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
    """Apply one modulated sub-layer with a residual connection; modulation None: it is folded into ``f``.

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
    """Return ``n -> W (n * (1 + scale) + shift) + b`` as one linear; sums in float64, stored in the weight's dtype."""
    weight, bias = _wide(linear)
    return _linear(weight * (1 + scale.double().flatten()), bias + weight @ shift.double().flatten(), linear.weight)


def fold_output(linear: nn.Linear, gate: Tensor) -> nn.Linear:
    """Return ``y -> gate * (V y + b)`` as one linear."""
    weight, bias = _wide(linear)
    gain = gate.double().flatten()
    return _linear(gain[:, None] * weight, gain * bias if linear.bias is not None else None, linear.weight)


def stack_rows(linears: list[nn.Linear]) -> nn.Linear:
    """Concatenate linears of one input into a single one."""
    weights, biases = zip(*(_wide(linear) for linear in linears), strict=True)
    return _linear(torch.cat(weights), torch.cat(biases), linears[0].weight)


def _wide(linear: nn.Linear) -> tuple[Tensor, Tensor]:
    weight = linear.weight.detach().double()
    bias = weight.new_zeros(weight.shape[0]) if linear.bias is None else linear.bias.detach().double()
    return weight, bias


def _linear(weight: Tensor, bias: Tensor | None, like: Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None, device="meta")
    layer.weight = nn.Parameter(weight.to(like.dtype), requires_grad=False)
    if bias is not None:
        layer.bias = nn.Parameter(bias.to(like.dtype), requires_grad=False)
    return layer
