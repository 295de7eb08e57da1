"""Sizes of the causal transformer, the checkpoint keys and shapes that follow, and initial weights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.layers import PATCH
from alpasim_plugin.core.errors import InputError

Shape = tuple[int, ...]
AREA = PATCH * PATCH
MASK_CHANNELS = 2  # condition mask, padding mask
ATTENTIONS = ("self_attn", "cross_attn")
SUBLAYERS = (*ATTENTIONS, "mlp")
CUT = 3.0  # standard deviations
HINT = "give the weights of a causal single-view network with a semantic-map embedding (docs/fixers.md)"


@dataclass(frozen=True)
class DiTSizes:
    """Every size of a `CosmosCausalDiT`; the defaults are OmniDreams single view (2B).

    ``opacity_channels`` above 0 gives every block an embedding of the render's opacity (ArtiFixer),
    which OmniDreams does not have.
    """

    width: int = 2048
    blocks: int = 28
    head_width: int = 128
    mlp_width: int = 8192
    adaln_rank: int = 256
    text_width: int = 100352
    context_width: int = 1024
    latent_channels: int = 16
    map_channels: int = 16
    opacity_channels: int = 0

    @property
    def condition_channels(self) -> int:
        """Channels of the condition: the map's, then the opacity's."""
        return self.map_channels + self.opacity_channels

    @property
    def heads(self) -> int:
        """Attention heads."""
        return self.width // self.head_width

    @property
    def parameters(self) -> int:
        """Number of weights."""
        return sum(math.prod(shape) for shape in self.shapes().values())

    def shapes(self) -> dict[str, Shape]:
        """Return the shape of every tensor of a checkpoint, by key."""
        d = self.width
        a = self.adaln_rank
        x = self.context_width
        f = self.mlp_width
        hd = self.head_width
        out: dict[str, Shape] = {
            "x_embedder.proj.1.weight": (d, (self.latent_channels + MASK_CHANNELS) * AREA),
            "additional_patch_embedding.proj.1.weight": (d, self.map_channels * AREA),
            "t_embedder.1.linear_1.weight": (d, d),
            "t_embedder.1.linear_2.weight": (3 * d, d),
            "t_embedding_norm.weight": (d,),
            "crossattn_proj.0.weight": (x, self.text_width),
            "crossattn_proj.0.bias": (x,),
            "final_layer.linear.weight": (self.latent_channels * AREA, d),
            "final_layer.adaln_modulation.1.weight": (a, d),
            "final_layer.adaln_modulation.2.weight": (2 * d, a),
        }
        for i in range(self.blocks):
            for name, context in zip(ATTENTIONS, (d, x), strict=True):
                for part, columns in (("q", d), ("k", context), ("v", context), ("output", d)):
                    out[f"blocks.{i}.{name}.{part}_proj.weight"] = (d, columns)
                out[f"blocks.{i}.{name}.q_norm.weight"] = out[
                    f"blocks.{i}.{name}.k_norm.weight"
                ] = (hd,)
            if self.opacity_channels:
                out[f"blocks.{i}.opacity_embed.weight"] = (d, self.opacity_channels * AREA)
            out[f"blocks.{i}.mlp.layer1.weight"] = (f, d)
            out[f"blocks.{i}.mlp.layer2.weight"] = (d, f)
            for name in SUBLAYERS:
                out[f"blocks.{i}.adaln_modulation_{name}.1.weight"] = (a, d)
                out[f"blocks.{i}.adaln_modulation_{name}.2.weight"] = (3 * d, a)
        return out


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


def initial_weights(sizes: DiTSizes, seed: int, zero_velocity: bool = False) -> dict[str, Tensor]:
    """Draw a state dict.

    Every linear is truncated normal with deviation ``1 / sqrt(inputs)``, cut at three deviations;
    norm gains are one, the bias and the final layer's second modulation are zero (the original's
    initialisation), and so are the embeddings of the opacity (ArtiFixer's).

    Args:
        sizes: The network.
        seed: Of the draw, for example from `alpasim_plugin.core.seeding.derive_seed`.
        zero_velocity: Also zero the output layer: the predicted velocity is then zero, and one step
            returns its source unchanged.

    Returns:
        Float32 tensors by key, for `CosmosCausalDiT.from_state_dict`.
    """
    generator = torch.Generator().manual_seed(seed % 2**63)
    out = {}
    for key, shape in sizes.shapes().items():
        tensor = torch.zeros(shape)
        if key.endswith("norm.weight"):
            tensor.fill_(1.0)
        elif (
            len(shape) == 2
            and key != "final_layer.adaln_modulation.2.weight"
            and not key.endswith("opacity_embed.weight")
        ):
            std = 1 / math.sqrt(shape[1])
            nn.init.trunc_normal_(tensor, std=std, a=-CUT * std, b=CUT * std, generator=generator)
        out[key] = tensor
    if zero_velocity:
        out["final_layer.linear.weight"].zero_()
    return out
