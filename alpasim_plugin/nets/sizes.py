"""Sizes of the causal transformer, the checkpoint keys and shapes that follow, and reading sizes from a checkpoint."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from alpasim_plugin.errors import InputError
from alpasim_plugin.nets.layers import PATCH

Shape = tuple[int, ...]
AREA = PATCH * PATCH
MASK_CHANNELS = 2  # condition mask, padding mask
ATTENTIONS = ("self_attn", "cross_attn")
SUBLAYERS = (*ATTENTIONS, "mlp")
LISTED = 8  # keys named in one error before the rest is only counted


@dataclass(frozen=True)
class DiTSizes:
    """Every size of a `CosmosCausalDiT`; the defaults are OmniDreams single view (2B)."""

    width: int = 2048
    blocks: int = 28
    head_width: int = 128
    mlp_width: int = 8192
    adaln_rank: int = 256
    text_width: int = 100352
    context_width: int = 1024
    latent_channels: int = 16
    map_channels: int = 16

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
        d, a, x, f, hd = self.width, self.adaln_rank, self.context_width, self.mlp_width, self.head_width
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
                out[f"blocks.{i}.{name}.q_norm.weight"] = out[f"blocks.{i}.{name}.k_norm.weight"] = (hd,)
            out[f"blocks.{i}.mlp.layer1.weight"] = (f, d)
            out[f"blocks.{i}.mlp.layer2.weight"] = (d, f)
            for name in SUBLAYERS:
                out[f"blocks.{i}.adaln_modulation_{name}.1.weight"] = (a, d)
                out[f"blocks.{i}.adaln_modulation_{name}.2.weight"] = (3 * d, a)
        return out


def read_sizes(shapes: Mapping[str, Shape], source: str) -> DiTSizes:
    """Read all sizes from the tensors of a checkpoint and check every key against them.

    Each size is the majority vote of the tensors that depend on it, so that a single wrong tensor is reported, not all others. A
    transposed square matrix cannot be detected.

    Args:
        shapes: Shape of every tensor by key, already cleaned (see `checkpoints.clean`).
        source: Where the tensors come from, for the error.

    Raises:
        InputError: Missing, unexpected or mis-shaped (also transposed) keys, all named.
    """
    depth = 1 + max((int(key.split(".")[1]) for key in shapes if _is_block(key)), default=-1)
    if depth == 0:
        raise _refusal(source, len(shapes), ["no key like blocks.0.self_attn.q_proj.weight"])
    names = set(DiTSizes(blocks=depth).shapes())
    missing, extra = sorted(names - set(shapes)), sorted(set(shapes) - names)
    if missing or extra:
        raise _refusal(source, len(shapes), [_listing("missing", missing), _listing("unexpected", extra)])
    sizes = _vote_sizes(shapes, depth, source)
    wrong = []
    for key, expected in sizes.shapes().items():
        found = shapes[key]
        if found != expected:
            hint = ", transposed" if len(found) == 2 and found == expected[::-1] else ""
            wrong.append(f"{key} is {list(found)} for {list(expected)}{hint}")
    if wrong:
        raise _refusal(source, len(shapes), [_listing("wrong shape", wrong)])
    return sizes


def _vote_sizes(shapes: Mapping[str, Shape], depth: int, source: str) -> DiTSizes:
    blocks = range(depth)

    def dims(*keys: str) -> list[int]:
        return [n for key in keys for n in shapes[key]]

    def votes(keys: list[str], known: int, divisor: int = 1, minus: int = 0) -> list[int]:
        """Return the other side of each matrix, given one."""
        matrices = [shapes[key] for key in keys if len(shapes[key]) == 2 and known in shapes[key]]
        rests = [sum(shape) - known for shape in matrices]
        return [rest // divisor - minus for rest in rests if rest % divisor == 0 and rest // divisor > minus]

    def winner(keys: list[str], cast: list[int], about: str) -> int:
        if not cast:
            shown = "; ".join(f"{key} is {list(shapes[key])}" for key in keys[:LISTED])
            raise _refusal(source, len(shapes), [f"wrong shape: {shown}, where {about}"])
        return Counter(cast).most_common(1)[0][0]

    squares = [f"blocks.{i}.self_attn.{part}_proj.weight" for i in blocks for part in ("q", "k", "v", "output")]
    width = winner(squares, dims("t_embedding_norm.weight", *squares), "[width, width] is due")
    gains = [f"blocks.{i}.{name}.{part}_norm.weight" for i in blocks for name in ATTENTIONS for part in "qk"]
    head_width = winner(gains, dims(*gains), "[head width] is due")
    if width < 2 or head_width < 2 or width % head_width or head_width % 2:
        found = f"width {width} (self_attn) with head width {head_width} (q_norm, k_norm): no whole number of even heads"
        raise _refusal(source, len(shapes), [found])
    contexts = [f"blocks.{i}.cross_attn.{part}_proj.weight" for i in blocks for part in "kv"]
    context_votes = dims("crossattn_proj.0.bias") + [n for n in dims(*contexts) if n != width]
    context_width = winner(["crossattn_proj.0.bias"], context_votes, "[context width] is due")

    def side(keys: list[str], known: int, divisor: int = 1) -> int:
        return winner(keys, votes(keys, known, divisor), f"one side should be {known}")

    latents = ["final_layer.linear.weight", "x_embedder.proj.1.weight"]
    latent_votes = votes(latents[:1], width, AREA) + votes(latents[1:], width, AREA, MASK_CHANNELS)
    ranks = [f"blocks.{i}.adaln_modulation_{name}.1.weight" for i in blocks for name in SUBLAYERS]
    return DiTSizes(
        width=width,
        blocks=depth,
        head_width=head_width,
        mlp_width=side([f"blocks.{i}.mlp.layer{n}.weight" for i in blocks for n in (1, 2)], width),
        adaln_rank=side([*ranks, "final_layer.adaln_modulation.1.weight"], width),
        text_width=side(["crossattn_proj.0.weight"], context_width),
        context_width=context_width,
        latent_channels=winner(latents, latent_votes, f"one side should be {width}"),
        map_channels=side(["additional_patch_embedding.proj.1.weight"], width, AREA),
    )


def _is_block(key: str) -> bool:
    parts = key.split(".")
    return len(parts) > 2 and parts[0] == "blocks" and parts[1].isdigit()


def _listing(what: str, items: list[str]) -> str:
    if not items:
        return ""
    rest = f" and {len(items) - LISTED} more" if len(items) > LISTED else ""
    return f"{what}: {', '.join(items[:LISTED])}{rest}"


def _refusal(source: str, count: int, parts: list[str]) -> InputError:
    found = "; ".join(part for part in parts if part)
    do = "give the weights of a causal single-view network with a semantic-map embedding (docs/nets.md lists keys and shapes)"
    return InputError("loading CosmosCausalDiT weights", f"{source} ({count} tensors)", found, do)
