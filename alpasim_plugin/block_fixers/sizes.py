"""Sizes of the causal transformer, the checkpoint keys and shapes that follow, and reading sizes
from a checkpoint.

Initial weights for training: truncated normal linears, unit gains, zero last modulation.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.layers import PATCH
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import listed

Shape = tuple[int, ...]
AREA = PATCH * PATCH
MASK_CHANNELS = 2  # condition mask, padding mask
ATTENTIONS = ("self_attn", "cross_attn")
SUBLAYERS = (*ATTENTIONS, "mlp")
CUT = 3.0  # standard deviations


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


def read_sizes(shapes: Mapping[str, Shape], source: str) -> DiTSizes:
    """Read all sizes from the tensors of a checkpoint and check every key against them.

    Each size is the majority vote of the tensors that depend on it, so that a single wrong tensor
    is reported, not all others. A transposed square matrix cannot be detected.

    Args:
        shapes: Shape of every tensor by key, already cleaned (see `checkpoints.clean`).
        source: Where the tensors come from, for the error.

    Raises:
        InputError: Missing, unexpected or mis-shaped (also transposed) keys, all named.
    """
    depth = 1 + max((int(key.split(".")[1]) for key in shapes if _is_block(key)), default=-1)
    if depth == 0:
        raise _refusal(source, len(shapes), ["no key like blocks.0.self_attn.q_proj.weight"])
    embeds = [key for key in shapes if key.endswith("opacity_embed.weight")]
    names = set(DiTSizes(blocks=depth, opacity_channels=bool(embeds)).shapes())
    missing, extra = sorted(names - set(shapes)), sorted(set(shapes) - names)
    if missing or extra:
        raise _refusal(
            source, len(shapes), [listed("missing", missing), listed("unexpected", extra)]
        )
    sizes = _vote_sizes(shapes, depth, source)
    wrong = []
    for key, expected in sizes.shapes().items():
        found = shapes[key]
        if found != expected:
            hint = ", transposed" if len(found) == 2 and found == expected[::-1] else ""
            wrong.append(f"{key} is {list(found)} for {list(expected)}{hint}")
    if wrong:
        raise _refusal(source, len(shapes), [listed("wrong shape", wrong)])
    return sizes


def _vote_sizes(shapes: Mapping[str, Shape], depth: int, source: str) -> DiTSizes:
    blocks = range(depth)

    def mode(values: Iterable[int]) -> int:
        return Counter(values).most_common(1)[0][0]

    def other_side(keys: Iterable[str], known: int) -> list[int]:
        """Return the second side of matrices of which one side is known; transposition does not
        matter.
        """
        return [math.prod(shapes[key]) // known for key in keys]

    squares = [
        f"blocks.{i}.self_attn.{part}_proj.weight"
        for i in blocks
        for part in ("q", "k", "v", "output")
    ]
    width = mode(n for key in ("t_embedding_norm.weight", *squares) for n in shapes[key])
    gains = [
        f"blocks.{i}.{name}.{part}_norm.weight"
        for i in blocks
        for name in ATTENTIONS
        for part in "qk"
    ]
    head_width = mode(n for key in gains for n in shapes[key])
    if width < 2 or head_width < 2 or width % head_width or head_width % 2:
        found = f"width {width} (self_attn) with head width {head_width} (q_norm, k_norm): no whole number of even heads"
        raise _refusal(source, len(shapes), [found])
    contexts = [f"blocks.{i}.cross_attn.{part}_proj.weight" for i in blocks for part in "kv"]
    context_width = max(mode([*shapes["crossattn_proj.0.bias"], *other_side(contexts, width)]), 1)
    ranks = [f"blocks.{i}.adaln_modulation_{name}.1.weight" for i in blocks for name in SUBLAYERS]
    opacities = [key for key in shapes if key.endswith("opacity_embed.weight")]
    (of_output,) = other_side(["final_layer.linear.weight"], width * AREA)
    (of_input,) = other_side(["x_embedder.proj.1.weight"], width * AREA)
    return DiTSizes(
        width=width,
        blocks=depth,
        head_width=head_width,
        mlp_width=mode(
            other_side([f"blocks.{i}.mlp.layer{n}.weight" for i in blocks for n in (1, 2)], width)
        ),
        adaln_rank=mode(other_side([*ranks, "final_layer.adaln_modulation.1.weight"], width)),
        text_width=mode(other_side(["crossattn_proj.0.weight"], context_width)),
        context_width=context_width,
        latent_channels=mode([of_output, of_input - MASK_CHANNELS]),
        map_channels=mode(other_side(["additional_patch_embedding.proj.1.weight"], width * AREA)),
        opacity_channels=mode(other_side(opacities, width * AREA)) if opacities else 0,
    )


def _is_block(key: str) -> bool:
    parts = key.split(".")
    return len(parts) > 2 and parts[0] == "blocks" and parts[1].isdigit()


def _refusal(source: str, count: int, parts: list[str]) -> InputError:
    found = "; ".join(part for part in parts if part)
    do = "give the weights of a causal single-view network with a semantic-map embedding (docs/block-fixers.md lists keys and shapes)"
    return InputError(f"{source} ({count} tensors): {found}", do)


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
