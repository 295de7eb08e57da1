"""Networks of a fixer's sizes with random weights: as shapes alone for counting, or drawn on a
device for timing.

The transformer is made at its final precision from the start, so that the largest size needs no
more memory than it runs in.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.block_fixers.networks import Networks, Parts, build_networks
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.fixers.settings import WeightsSettings


class _RandomParts(Parts):
    """Untrained codecs, and a transformer and a prompt on the ``meta`` device; files of weights are
    not read.
    """

    def __init__(self, settings: OneFixerSettings, text_tokens: int) -> None:
        super().__init__(
            settings.model_copy(update={"weights": WeightsSettings(), "untrained": "random"})
        )
        self.text_tokens = text_tokens

    def dit(self) -> CosmosCausalDiT:
        sizes = DiTSizes(**self.settings.dit.model_dump())
        shapes = {key: torch.empty(shape, device="meta") for key, shape in sizes.shapes().items()}
        return CosmosCausalDiT.from_state_dict(shapes, self.settings.rope_ratios).requires_grad_(
            False
        )

    def prompt(self, sizes: DiTSizes) -> Tensor:
        return torch.empty(1, self.text_tokens, sizes.text_width, device="meta")


def random_networks(
    settings: OneFixerSettings, device: str, text_tokens: int, seed: int = 0
) -> Networks:
    """Build networks of the settings' sizes; files of weights that the settings name are not read.

    Args:
        settings: Sizes, precision, folding.
        device: ``meta`` makes shapes without numbers.
        text_tokens: Of the prompt: 512 as the original's.
        seed: Of the transformer's weights and the prompt.
    """
    networks = build_networks(_RandomParts(settings, text_tokens), "meta", device)
    if device == "meta":
        return networks
    generator = torch.Generator(device).manual_seed(seed)

    def normal(like: Tensor) -> Tensor:
        return torch.randn(like.shape, dtype=like.dtype, device=device, generator=generator)

    for net in {id(net): net for net in (networks.dit, networks.finalise_dit)}.values():
        net.to_empty(device=device)
        for name, value in (*net.named_parameters(), *net.named_buffers()):
            if value.ndim < 2:
                value.fill_(1.0 if name.endswith("norm.weight") else 0.0)
            else:
                value.normal_(0.0, 1 / math.sqrt(value.shape[-1]), generator=generator)
    return replace(
        networks,
        text=TextContext(tuple((normal(k), normal(v)) for k, v in networks.text.keys_values)),
    )
