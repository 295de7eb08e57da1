"""Euler's method from noise, with the render as a condition: the sampler of GSFix3D and 3DGS-Enhancer at our scale.

Attention goes over all latents of the clip; the render's latents take the map's place at the input. The path is the straight one of flow
matching, so the velocity is ``v = eps - z_0`` and a step from t to s is ``z_s = z_t - (t - s) v(z_t, t)``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

from torch import Tensor

from alpasim_plugin.nets.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.nets.layers import PATCH
from alpasim_plugin.nets.sampling import flow_step
from alpasim_plugin.nets.schedule import TABLE

LATENT_KEY, CONDITION_KEY = "x_embedder.proj.1.weight", "additional_patch_embedding.proj.1.weight"
AREA = PATCH * PATCH


def euler(net: CosmosCausalDiT, eps: Tensor, z_r: Tensor, times: Sequence[float], text: Tensor | TextContext) -> Tensor:
    """Sample clean latents from noise.

    Args:
        net: The network.
        eps: ``(B, C, T, H, W)`` standard normal, the start at t = 1.
        z_r: Like ``eps``, latents of the render.
        times: Where the network is asked, falling from 1000 (`schedule.names`, without a shift); the last step ends at 0.
        text: Prompt.

    Returns:
        Like ``eps``.
    """
    z = eps
    for t, after in pairwise((*times, 0.0)):
        z = flow_step(z, net(z, t, text, z_r, block_latents=None), (t - after) / TABLE)
    return z


def share_embedding(weights: Mapping[str, Tensor], channels: int = 16) -> dict[str, Tensor]:
    """Return weights whose condition input starts as half of the latent input, which is halved.

    As Marigold and GSFix3D copy the first convolution for the second image: with both inputs equal the tokens are those of before.

    Args:
        weights: State dict of `CosmosCausalDiT`; its condition input is replaced.
        channels: Of a latent.
    """
    latent, columns = weights[LATENT_KEY].clone(), channels * AREA  # the masks' columns, behind the latents', stay as they are
    latent[:, :columns] /= 2
    return {**weights, LATENT_KEY: latent, CONDITION_KEY: latent[:, :columns].clone()}
