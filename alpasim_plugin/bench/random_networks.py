"""Networks of a fixer's sizes with weights that mean nothing: as shapes alone for counting, or drawn on a device for timing.

Made at the final precision from the start, so that the largest size needs no more memory than it runs in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

from alpasim_plugin.fixers.networks import LATENT, TAEHV_WIDTHS, Codec, Networks
from alpasim_plugin.fixers.settings import OneFixerSettings
from alpasim_plugin.nets import CosmosCausalDiT, DiTSizes, TextContext, TinyDecoder, TinyVAE, WanVAE
from alpasim_plugin.nets.precision import at_precision, codec_at_precision, text_at_precision
from alpasim_plugin.nets.schedule import CONTEXT_STEP, from_names
from alpasim_plugin.nets.wan_vae_layout import WanLayout

NOTE = "random weights"
Net = TypeVar("Net", bound=nn.Module)


def random_networks(settings: OneFixerSettings, device: torch.device | str, text_tokens: int, seed: int = 0) -> Networks:
    """Build networks of the settings' sizes; files of weights that the settings name are not read.

    Args:
        settings: Sizes, precision, folding.
        device: Where; ``meta`` makes shapes without numbers.
        text_tokens: Of the prompt: 512 as the original's.
        seed: Of the draw.
    """
    device, precision = torch.device(device), settings.precision
    sizes = DiTSizes(**settings.dit.model_dump())
    shapes = {key: torch.empty(shape, device="meta") for key, shape in sizes.shapes().items()}
    plain = CosmosCausalDiT.from_state_dict(shapes, settings.rope_ratios).requires_grad_(False)
    text = text_at_precision(plain.encode_text(torch.empty(1, text_tokens, sizes.text_width, device="meta")), precision)
    fold = settings.fold and len(settings.steps) == 1
    dit = at_precision(plain.folded(from_names(settings.steps)[0].t) if fold else plain, precision)
    apart = fold and settings.history == "finalise"
    finalise = at_precision(plain.folded(CONTEXT_STEP), precision) if apart else dit
    if device.type != "meta":
        generator = torch.Generator(device).manual_seed(seed)
        for net in {id(net): net for net in (dit, finalise)}.values():
            _draw_weights(net, device, generator)
        text = TextContext(tuple((_normal(k, device, generator), _normal(v, device, generator)) for k, v in text.keys_values))
    vae = _codec(settings, device, seed)
    decoder: Codec | TinyDecoder = vae
    if settings.decoder.kind == "taehv":
        decoder = _placed(
            lambda: TinyDecoder(LATENT, TAEHV_WIDTHS, settings.decoder.scaled),
            lambda: TinyDecoder.random(LATENT, TAEHV_WIDTHS, settings.decoder.scaled, seed),
            settings, device,
        )  # fmt: skip
    return Networks(dit, finalise, vae, decoder, text, False, NOTE)


def _codec(settings: OneFixerSettings, device: torch.device, seed: int) -> Codec:
    if settings.vae.kind == "tiny":
        return _placed(TinyVAE, lambda: TinyVAE.random(seed=seed), settings, device)
    layout = WanLayout.of_base(settings.vae.base)
    return _placed(lambda: WanVAE(layout), lambda: WanVAE.random(layout, seed), settings, device)


def _placed(shapes: Callable[[], Net], drawn: Callable[[], Net], settings: OneFixerSettings, device: torch.device) -> Net:
    if device.type == "meta":
        with device:
            net = shapes().requires_grad_(False)
        return codec_at_precision(net, settings.codec_precision).to(device)
    return codec_at_precision(drawn(), settings.codec_precision).to(device)


def _draw_weights(net: CosmosCausalDiT, device: torch.device, generator: torch.Generator) -> None:
    """Give a network of shapes numbers of a trained network's size."""
    net.to_empty(device=device)
    for name, value in (*net.named_parameters(), *net.named_buffers()):
        if not value.is_floating_point():
            value.copy_(torch.randint(-63, 64, value.shape, dtype=value.dtype, device=device, generator=generator))
        elif name.endswith("scale"):  # of int8 weights
            value.fill_(0.03 / math.sqrt(net.sizes.width))
        elif value.ndim < 2:
            value.fill_(1.0 if name.endswith("norm.weight") else 0.0)
        else:
            value.normal_(0.0, 1 / math.sqrt(value.shape[-1]), generator=generator)


def _normal(like: Tensor, device: torch.device, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, dtype=like.dtype, device=device, generator=generator)
