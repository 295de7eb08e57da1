"""Images and windows through the networks of a fixer without map and cache: encode, denoise, decode. Tensors in, tensors out.

Nothing is remembered between calls.
"""

from __future__ import annotations

import torch
from torch import Tensor

from alpasim_plugin.fixers.image_settings import NoiseWindowSettings, RenderStepSettings
from alpasim_plugin.fixers.networks import Networks, decode
from alpasim_plugin.fixers.pipeline import Stage, no_clock
from alpasim_plugin.nets.euler import euler
from alpasim_plugin.nets.fixed_step import fixed_step


@torch.inference_mode()
def fix_images(
    networks: Networks,
    settings: RenderStepSettings,
    rgb: Tensor,
    alpha: Tensor | None,
    references: Tensor | None = None,
    stage: Stage = no_clock,
) -> Tensor:
    """Fix one frame of B cameras in one step from the render.

    With references the frames form a clip whose time runs backwards: the present render, then the last outputs, newest first. Its first
    latent holds the render alone, for the encoder is causal; the transformer's attention joins the two. Only the first latent is decoded.

    Args:
        networks: Theirs.
        settings: The render's noise level, and the kind of decoder.
        rgb: ``(B, 3, 1, H, W)`` render in [-1, 1].
        alpha: ``(B, 1, 1, H, W)`` its opacity; None: opaque everywhere.
        references: ``(B, 3, 4, H, W)`` last outputs, newest first; None: none.
        stage: See `BlockPipeline`.

    Returns:
        Like ``rgb``, not clipped to [-1, 1].
    """
    with stage("encode"):
        z_r = networks.vae.encode(rgb if references is None else torch.cat([rgb, references], dim=2)).float()
    with stage("dit"):
        z_0 = fixed_step(networks.dit, z_r, settings.level, networks.text)
    with stage("decode"):
        return decode(networks, settings, z_0[:, :, :1], rgb, alpha if settings.opacity_to_decoder else None)[0]


@torch.inference_mode()
def sample_window(
    networks: Networks, settings: NoiseWindowSettings, rgb: Tensor, alpha: Tensor | None, eps: Tensor, stage: Stage = no_clock
) -> Tensor:
    """Sample the frames of a window from noise, with the render as a condition; the window is encoded from its own first frame.

    Args:
        networks: Theirs.
        settings: Times of the steps, and the kind of decoder.
        rgb: ``(B, 3, T, H, W)`` render in [-1, 1].
        alpha: ``(B, 1, T, H, W)`` its opacity; None: opaque everywhere.
        eps: ``(B, 16, latents, H / 8, W / 8)`` standard normal.
        stage: See `BlockPipeline`.

    Returns:
        Like ``rgb``, not clipped to [-1, 1].
    """
    with stage("encode"):
        z_r = networks.vae.encode(rgb).float()
    with stage("dit"):
        z_0 = euler(networks.dit, eps, z_r, settings.steps, networks.text)
    with stage("decode"):
        return decode(networks, settings, z_0, rgb, alpha if settings.opacity_to_decoder else None)[0]
