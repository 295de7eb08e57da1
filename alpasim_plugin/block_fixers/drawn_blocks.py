"""Blocks of random images through random networks of a fixer's sizes: to be counted, or timed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import GROUP, SIDE
from alpasim_plugin.block_fixers.dit import FLOAT32_KEYS, CosmosCausalDiT
from alpasim_plugin.block_fixers.networks import (
    LATENT,
    TAEHV_WIDTHS,
    Networks,
    at_precision,
    condition_sizes,
)
from alpasim_plugin.block_fixers.pipeline import BlockPipeline
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.taehv import TinyDecoder
from alpasim_plugin.block_fixers.wan_vae import WanVAE
from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.seeding import stream

PROMPT_TOKENS = 512  # of OmniDreams' prompt


def drawn_blocks(
    settings: OneFixerSettings, width: int, height: int, device: str
) -> Callable[[], Tensor]:
    """Return a call that fixes one further block of a rollout of one camera.

    Args:
        settings: Of a fixer with the autoencoder of Wan and the tiny decoder.
        width, height: Pixels, multiples of 16.
        device: A card, or ``meta``, where nothing is computed.

    Returns:
        The call, which returns the block's frames ``(1, 3, T, H, W)``.
    """
    pipeline = BlockPipeline(_networks(settings, device), settings)
    state = pipeline.start(1, height, width)
    rng = stream("drawn-blocks", 0, "images")

    def drawn(*shape: int) -> Tensor:
        return upload(rng.standard_normal((1, *shape), np.float32), device)

    frames = GROUP * settings.block_latents
    render, sdmap = drawn(3, frames, height, width), drawn(3, frames, height, width)
    opacity = drawn(1, frames, height, width)
    latents = settings.block_latents, height // SIDE, width // SIDE
    noise = [drawn(LATENT, *latents) for _ in range(pipeline.draws)]

    def fix() -> Tensor:
        nonlocal state
        shown = slice(0 if state.latent else GROUP - 1, None)  # the first latent is one frame
        video, after = pipeline.run(
            state, render[:, :, shown], opacity[:, :, shown], sdmap[:, :, shown], noise
        )
        state = pipeline.keep(after)
        return video

    return fix


def _networks(settings: OneFixerSettings, device: str) -> Networks:
    """Return networks with the weights that torch's layers begin with."""
    sizes = DiTSizes(**settings.dit.model_dump(), **condition_sizes(settings))
    with torch.device(device), torch.no_grad():
        plain = CosmosCausalDiT(sizes, settings.rope_ratios)
        dit = at_precision(plain, settings.precision, FLOAT32_KEYS)
        vae = at_precision(WanVAE(settings.vae.base), settings.codec_precision)
        tiny = TinyDecoder(LATENT, TAEHV_WIDTHS, settings.decoder.scaled)
        decoder = at_precision(tiny, settings.codec_precision)
        text = dit.encode_text(torch.ones(1, PROMPT_TOKENS, sizes.text_width))
    return Networks(dit, vae.to(device), decoder.to(device), text, False, "random weights")
