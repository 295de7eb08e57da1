"""Blocks through random networks of a fixer's sizes: to be counted, or timed."""

from collections.abc import Callable

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

PROMPT_TOKENS = 512  # of OmniDreams' prompt


@torch.no_grad()
def drawn_blocks(
    settings: OneFixerSettings, width: int, height: int, device: str
) -> Callable[[], Tensor]:
    """Return a call that fixes one further block of one camera: frames ``(1, 3, T, H, W)``.

    Args:
        settings: Of a fixer with the autoencoder of Wan and the tiny decoder.
        width, height: Pixels, multiples of 16.
        device: A card, or ``meta``, where nothing is computed.
    """
    sizes = DiTSizes(**settings.dit.model_dump(), **condition_sizes(settings))
    frames = GROUP * settings.block_latents
    latents = settings.block_latents
    with torch.device(device):  # weights are those that torch's layers begin with
        plain = CosmosCausalDiT(sizes, settings.rope_ratios)
        dit = at_precision(plain, settings.precision, FLOAT32_KEYS)
        vae = at_precision(WanVAE(settings.vae.base), settings.codec_precision)
        tiny = TinyDecoder(LATENT, TAEHV_WIDTHS, settings.decoder.scaled)
        decoder = at_precision(tiny, settings.codec_precision)
        text = dit.encode_text(torch.ones(1, PROMPT_TOKENS, sizes.text_width))
        image = torch.full((1, 3, frames, height, width), 0.5)
        noise = torch.ones(1, LATENT, latents, height // SIDE, width // SIDE)
    parts = Networks(dit, vae.to(device), decoder.to(device), text, False, "random weights")
    pipeline = BlockPipeline(parts, settings)
    state = pipeline.start(1, height, width)

    def fix() -> Tensor:
        nonlocal state
        # A rollout's first latent holds one frame.
        render = image if state.latent else image[:, :, GROUP - 1 :]
        video, after = pipeline.run(state, render, render[:, :1], render, [noise] * pipeline.draws)
        state = pipeline.keep(after)
        return video

    return fix
