"""One deterministic step from a render at a fixed time: the samplers of DiFix3D+ and DiffusionHarmonizer.

Both take the render for a clean image with noise of a fixed level, ``z_r = alpha z_0 + sigma eps``, though none is added, and denoise it
once. Divided by ``alpha + sigma`` that is a point of the straight path of flow matching, ``x = (1 - t) z_0 + t eps``, with

    t = sigma / (alpha + sigma),   x = z_r / (alpha + sigma),   z_0 = x - t v(x, t).

DiFix3D+: step 199 of Stable Diffusion's 1000 (scaled linear betas), ``z_0 = (z_r - sigma eps_hat) / alpha``. DiffusionHarmonizer:
``alpha = 1``, ``sigma = 0.25``, so that ``z_0 = 0.8 z_r - 0.2 v(0.8 z_r, 0.2)``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from alpasim_plugin.nets.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.nets.sampling import flow_step
from alpasim_plugin.nets.schedule import RenderLevel


def fixed_step(net: CosmosCausalDiT, z_r: Tensor, level: RenderLevel, text: Tensor | TextContext) -> Tensor:
    """Predict clean latents from those of a render; attention goes over all latents, and there is no map.

    Args:
        net: The network, or a copy folded at ``level.network_t``.
        z_r: ``(B, C, T, H, W)``; T is 1 for a single image, 2 for an image with its references.
        level: The render's noise level.
        text: Prompt.

    Returns:
        Like ``z_r``.
    """
    x = level.scale * z_r
    v = net(x, level.network_t, text, torch.zeros_like(x), block_latents=None)
    return flow_step(x, v, level.t)
