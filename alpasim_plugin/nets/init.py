"""Initial weights for training: truncated normal linears, unit gains, zero last modulation."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from alpasim_plugin.nets.sizes import DiTSizes

CUT = 3.0  # standard deviations


def initial_weights(sizes: DiTSizes, seed: int, zero_velocity: bool = False) -> dict[str, Tensor]:
    """Draw a state dict.

    Every linear is truncated normal with deviation ``1 / sqrt(inputs)``, cut at three deviations; norm gains are one, the bias and the
    final layer's second modulation are zero (the original's initialisation), and so are the embeddings of the opacity (ArtiFixer's).

    Args:
        sizes: The network.
        seed: Of the draw, for example from `alpasim_plugin.core.seeding.derive_seed`.
        zero_velocity: Also zero the output layer: the predicted velocity is then zero, and one step returns its source unchanged.

    Returns:
        Float32 tensors by key, for `CosmosCausalDiT.from_state_dict`.
    """
    generator = torch.Generator().manual_seed(seed % 2**63)
    out = {}
    for key, shape in sizes.shapes().items():
        tensor = torch.zeros(shape)
        if key.endswith("norm.weight"):
            tensor.fill_(1.0)
        elif len(shape) == 2 and key != "final_layer.adaln_modulation.2.weight" and not key.endswith("opacity_embed.weight"):
            std = 1 / math.sqrt(shape[1])
            nn.init.trunc_normal_(tensor, std=std, a=-CUT * std, b=CUT * std, generator=generator)
        out[key] = tensor
    if zero_velocity:
        out["final_layer.linear.weight"].zero_()
    return out
