"""Euler's method from noise, with the render as a condition: the sampler of GSFix3D and
3DGS-Enhancer at our scale.

Attention goes over all latents of the clip; the render's latents take the map's place at the input.
The path is the straight one of flow matching, so the velocity is ``v = eps - z_0`` and a step from
t to s is ``z_s = z_t - (t - s) v(z_t, t)``.

One deterministic step from a render at a fixed time: the samplers of DiFix3D+ and
DiffusionHarmonizer.

Both take the render for a clean image with noise of a fixed level, ``z_r = alpha z_0 + sigma eps``,
though none is added, and denoise it once. Divided by ``alpha + sigma`` that is a point of the
straight path of flow matching, ``x = (1 - t) z_0 + t eps``, with

    t = sigma / (alpha + sigma),   x = z_r / (alpha + sigma),   z_0 = x - t v(x, t).

DiFix3D+: step 199 of Stable Diffusion's 1000 (scaled linear betas), ``z_0 = (z_r - sigma eps_hat) /
alpha``. DiffusionHarmonizer: ``alpha = 1``, ``sigma = 0.25``, so that ``z_0 = 0.8 z_r - 0.2 v(0.8
z_r, 0.2)``.

Images and windows through the networks of a fixer without map and cache: encode, denoise, decode.
Tensors in, tensors out.

Nothing is remembered between calls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.block_fixers.layers import PATCH
from alpasim_plugin.block_fixers.networks import Networks, decode
from alpasim_plugin.block_fixers.sampling import flow_step
from alpasim_plugin.fixers.network.schedule import TABLE
from alpasim_plugin.lab.image_fixers.settings import (
    NoiseWindowSettings,
    RenderLevel,
    RenderStepSettings,
)

LATENT_KEY = "x_embedder.proj.1.weight"
CONDITION_KEY = "additional_patch_embedding.proj.1.weight"
AREA = PATCH * PATCH


def euler(
    net: CosmosCausalDiT,
    eps: Tensor,
    z_r: Tensor,
    times: Sequence[float],
    text: Tensor | TextContext,
) -> Tensor:
    """Sample clean latents from noise.

    Args:
        net: The network.
        eps: ``(B, C, T, H, W)`` standard normal, the start at t = 1.
        z_r: Like ``eps``, latents of the render.
        times: Where the network is asked, falling from 1000 (`schedule.names`, without a shift);
            the last step ends at 0.
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

    As Marigold and GSFix3D copy the first convolution for the second image: with both inputs equal
    the tokens are those of before.

    Args:
        weights: State dict of `CosmosCausalDiT`; its condition input is replaced.
        channels: Of a latent.
    """
    # The masks' columns, behind the latents', stay as they are
    latent, columns = (
        weights[LATENT_KEY].clone(),
        channels * AREA,
    )
    latent[:, :columns] /= 2
    return {**weights, LATENT_KEY: latent, CONDITION_KEY: latent[:, :columns].clone()}


def fixed_step(
    net: CosmosCausalDiT, z_r: Tensor, level: RenderLevel, text: Tensor | TextContext
) -> Tensor:
    """Predict clean latents from those of a render; attention goes over all latents, and there is
    no map.

    Args:
        net: The network.
        z_r: ``(B, C, T, H, W)``; T is 1 for a single image, 2 for an image with its references.
        level: The render's noise level.
        text: Prompt.

    Returns:
        Like ``z_r``.
    """
    x = level.scale * z_r
    v = net(x, level.network_t, text, torch.zeros_like(x), block_latents=None)
    return flow_step(x, v, level.t)


@torch.inference_mode()
def fix_images(
    networks: Networks,
    settings: RenderStepSettings,
    rgb: Tensor,
    alpha: Tensor | None,
    references: Tensor | None = None,
) -> Tensor:
    """Fix one frame of B cameras in one step from the render.

    With references the frames form a clip whose time runs backwards: the present render, then the
    last outputs, newest first. Its first latent holds the render alone, for the encoder is causal;
    the transformer's attention joins the two. Only the first latent is decoded.

    Args:
        networks: Theirs.
        settings: The render's noise level, and the kind of decoder.
        rgb: ``(B, 3, 1, H, W)`` render in [-1, 1].
        alpha: ``(B, 1, 1, H, W)`` its opacity; None: opaque everywhere.
        references: ``(B, 3, 4, H, W)`` last outputs, newest first; None: none.

    Returns:
        Like ``rgb``, not clipped to [-1, 1].
    """
    z_r = networks.vae.encode(
        rgb if references is None else torch.cat([rgb, references], dim=2)
    ).float()
    z_0 = fixed_step(networks.dit, z_r, settings.level, networks.text)
    return decode(
        networks, settings, z_0[:, :, :1], rgb, alpha if settings.opacity_to_decoder else None
    )[0]


@torch.inference_mode()
def sample_window(
    networks: Networks,
    settings: NoiseWindowSettings,
    rgb: Tensor,
    alpha: Tensor | None,
    eps: Tensor,
) -> Tensor:
    """Sample the frames of a window from noise, with the render as a condition; the window is
    encoded from its own first frame.

    Args:
        networks: Theirs.
        settings: Times of the steps, and the kind of decoder.
        rgb: ``(B, 3, T, H, W)`` render in [-1, 1].
        alpha: ``(B, 1, T, H, W)`` its opacity; None: opaque everywhere.
        eps: ``(B, 16, latents, H / 8, W / 8)`` standard normal.

    Returns:
        Like ``rgb``, not clipped to [-1, 1].
    """
    z_r = networks.vae.encode(rgb).float()
    z_0 = euler(networks.dit, eps, z_r, settings.steps, networks.text)
    return decode(networks, settings, z_0, rgb, alpha if settings.opacity_to_decoder else None)[0]
