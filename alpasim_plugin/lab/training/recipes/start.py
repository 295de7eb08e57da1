"""Networks at the start of a stage: built from its initial weights, or initialised to return their
source unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, initial_weights
from alpasim_plugin.block_fixers.sampling import OPACITY_CHANNELS
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.lab.image_fixers.pipeline import share_embedding
from alpasim_plugin.lab.training.recipes.recipe import StageInputs
from alpasim_plugin.lab.training.vae import channel_amplitudes

MAP_KEY = "additional_patch_embedding.proj.1.weight"
OPACITY_KEY = "blocks.{}.opacity_embed.weight"
LATENT = 16
AREA = 4  # latents of a token


def transformer_of(inputs: StageInputs, part: str) -> CosmosCausalDiT:
    """Build a part that is a transformer; inputs that its weights do not have yet start at zero, so
    that they change nothing.
    """
    weights = start_weights(inputs, part)
    if inputs.conditioning.source == "noise":
        weights = widen_map(weights, 2 * LATENT)
    if inputs.conditioning.opacity:
        weights = with_opacity(weights)
    return CosmosCausalDiT.from_state_dict(
        weights, inputs.rope_ratios, source=f"initial weights of {part}"
    )


def transformer_with_render(inputs: StageInputs, part: str) -> CosmosCausalDiT:
    """Build a part that is a transformer whose map input takes the render's latents instead; see
    `euler.share_embedding`.
    """
    weights = share_embedding(start_weights(inputs, part))
    return CosmosCausalDiT.from_state_dict(
        weights, inputs.rope_ratios, source=f"initial weights of {part}"
    )


def start_weights(inputs: StageInputs, part: str) -> Mapping[str, Tensor]:
    """Return a part's weights as given, or those of a transformer that returns its source
    unchanged.
    """
    weights = inputs.weights.get(part)
    if weights is not None:
        return weights
    sizes = DiTSizes(**inputs.dit.model_dump())
    return initial_weights(
        sizes, derive_seed("training", inputs.form.seed, "generator"), zero_velocity=True
    )


def channel_weights_of(inputs: StageInputs) -> Tensor | None:
    """Return the weights ``(C,)`` of latent channels in flow matching: by amplitude in pixels, or
    None where all weigh alike.
    """
    return None if inputs.equal_channels else channel_amplitudes(inputs.vae)


def no_text(net: CosmosCausalDiT, like: Tensor) -> Tensor:
    """Return a prompt of one token of zeros ``(1, 1, width)``, on the device of a tensor."""
    return like.new_zeros(1, 1, net.sizes.text_width)


def widen_map(weights: Mapping[str, Tensor], channels: int) -> dict[str, Tensor]:
    """Return weights whose map input has ``channels`` channels; new columns are zero, so outputs do
    not change.

    Raises:
        InputError: The weights have more channels already.
    """
    old = weights[MAP_KEY]
    width = old.shape[0]
    have = old.shape[1] // AREA
    if have > channels:
        raise InputError(
            f"to {channels} channels: they take {have} channels",
            "start from weights that take no more",
        )
    new = torch.zeros(width, channels * AREA)
    # Inputs of a token are channel-major (`embeddings.PatchEmbed`): existing channels come first.
    new[:, : have * AREA] = old
    return {**weights, MAP_KEY: new}


def with_opacity(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return weights with an opacity embedding in every block, zero where there is none yet, so
    that outputs do not change.
    """
    width = weights[MAP_KEY].shape[0]
    depth = 1 + max(int(key.split(".")[1]) for key in weights if key.startswith("blocks."))
    new = {OPACITY_KEY.format(i): torch.zeros(width, OPACITY_CHANNELS * AREA) for i in range(depth)}
    return {**new, **weights}
