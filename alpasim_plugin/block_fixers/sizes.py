"""Sizes of the causal transformer."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.layers import PATCH
from alpasim_plugin.core.errors import InputError

AREA = PATCH * PATCH
MASK_CHANNELS = 2  # condition mask, padding mask
HINT = "give the weights of a causal single-view network with a semantic-map embedding (docs/fixers.md)"


@dataclass(frozen=True)
class DiTSizes:
    """Every size of a `CosmosCausalDiT`; configs/fixers/onefixer-2b.yaml has OmniDreams'.

    ``opacity_channels`` above 0 gives every block an embedding of the render's opacity (ArtiFixer),
    which OmniDreams does not have.
    """

    width: int
    blocks: int
    head_width: int
    mlp_width: int
    adaln_rank: int
    text_width: int
    context_width: int
    latent_channels: int = 16
    map_channels: int = 16
    opacity_channels: int = 0

    @property
    def condition_channels(self) -> int:
        """Channels of the condition: the map's, then the opacity's."""
        return self.map_channels + self.opacity_channels


def read_sizes(tensors: Mapping[str, Tensor], source: str) -> DiTSizes:
    """Read all sizes off the tensors of a checkpoint.

    Raises:
        InputError: A tensor that gives a size is missing, or its sizes are impossible.
    """

    def shape(key: str, axes: int = 2) -> torch.Size:
        if key not in tensors or tensors[key].ndim != axes:
            raise InputError(f"{source}: no tensor {key} of {axes} axes", HINT)
        return tensors[key].shape

    (width,) = shape("t_embedding_norm.weight", 1)
    (head_width,) = shape("blocks.0.self_attn.q_norm.weight", 1)
    (context_width,) = shape("crossattn_proj.0.bias", 1)
    if head_width < 2 or head_width % 2 or width % head_width:
        raise InputError(f"{source}: width {width} with head width {head_width}", HINT)
    opacity = "blocks.0.opacity_embed.weight"
    return DiTSizes(
        width=width,
        blocks=len({key.split(".")[1] for key in tensors if key.startswith("blocks.")}),
        head_width=head_width,
        mlp_width=shape("blocks.0.mlp.layer1.weight")[0],
        adaln_rank=shape("final_layer.adaln_modulation.1.weight")[0],
        text_width=shape("crossattn_proj.0.weight")[1],
        context_width=context_width,
        latent_channels=shape("final_layer.linear.weight")[0] // AREA,
        map_channels=shape("additional_patch_embedding.proj.1.weight")[1] // AREA,
        opacity_channels=shape(opacity)[1] // AREA if opacity in tensors else 0,
    )
