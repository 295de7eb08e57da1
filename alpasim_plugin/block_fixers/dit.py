"""The causal one-step generator: a diffusion transformer (DiT) over latents with block-causal
attention.

One set of weights, two entry points. ``net(...)`` takes a whole clip with a block-causal mask
(training, reference); ``net.step(...)`` takes one block and a KV cache (streaming). They agree
where the window covers the history.

Conventions: ``x`` and ``hdmap`` are ``(B, C, T, H, W)`` normalised latents, time steps run from 0
    to 1000, the output is the velocity
``noise - clean`` (source minus target) in the shape and dtype of ``x``. Keys, shapes and order of
operations are those of OmniDreams single view (the causal student of Cosmos-Predict2.5), so its
checkpoints load; docs/fixers.md lists them.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Self, cast

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.attention import (
    Attend,
    Rope3D,
    RopeTable,
    block_causal_attention,
)
from alpasim_plugin.block_fixers.blocks import Block, FinalLayer, KeysValues
from alpasim_plugin.block_fixers.clips import check_video
from alpasim_plugin.block_fixers.kv_cache import BlockCache, RollingCache
from alpasim_plugin.block_fixers.layers import (
    PATCH,
    PatchEmbed,
    RMSNorm,
    TimeMap,
    sinusoid,
    unpatchify,
)
from alpasim_plugin.block_fixers.sizes import HINT, MASK_CHANNELS, DiTSizes, read_sizes
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network import checkpoints

# Height, width, time, as all released single-view experiments set them
RELEASED_ROPE_RATIOS = (
    3.0,
    3.0,
    1.0,
)
CUT = 3.0  # standard deviations of initial weights
FLOAT32_KEYS = ("t_embedder.", "t_embedding_norm.", "adaln_modulation")

# Cross-attention keys and values of a prompt for every block (B or 1, tokens, heads, head_width):
# computed once by `CosmosCausalDiT.encode_text`, passed in place of the text.
TextContext = tuple[KeysValues, ...]


class CosmosCausalDiT(nn.Module):
    """Predict the velocity of latents from their causal history, text and semantic map.

    Args:
        sizes: All sizes.
        rope_ratios: NTK stretch of the rotary positions: height, width, time.
    """

    def __init__(
        self,
        sizes: DiTSizes,
        rope_ratios: tuple[float, float, float] = RELEASED_ROPE_RATIOS,
    ) -> None:
        super().__init__()
        self.sizes = sizes
        self.rope = Rope3D(sizes.head_width, rope_ratios)
        self.x_embedder = PatchEmbed(sizes.latent_channels + MASK_CHANNELS, sizes.width)
        self.additional_patch_embedding = PatchEmbed(sizes.map_channels, sizes.width)
        self.t_embedder = nn.ModuleList([nn.Identity(), TimeMap(sizes.width)])
        self.t_embedding_norm = RMSNorm(sizes.width)
        self.crossattn_proj = nn.Sequential(
            nn.Linear(sizes.text_width, sizes.context_width), nn.GELU()
        )
        self.blocks = nn.ModuleList(Block(sizes) for _ in range(sizes.blocks))
        self.final_layer = FinalLayer(sizes)

    @classmethod
    def from_state_dict(
        cls,
        sd: Mapping[str, Tensor],
        rope_ratios: tuple[float, float, float] = RELEASED_ROPE_RATIOS,
        *,
        source: str = "state dict",
    ) -> Self:
        """Build a network with sizes read from the tensors, and copy them.

        Args:
            sd: Tensors under the original's keys (docs/fixers.md), with or without the prefix
                ``net.`` and an outer ``model`` or ``state_dict``.
            rope_ratios: Height, width, time; not stored in checkpoints.
            source: Name for error messages.

        Raises:
            InputError: Missing, unexpected, mis-shaped or transposed, non-floating or non-finite
                tensors, all listed.
        """
        tensors = checkpoints.clean(checkpoints.unwrap(sd, source))
        sizes = read_sizes(tensors, source)
        with torch.device("meta"):
            net = cls(sizes, rope_ratios)
        checkpoints.load_checked(net, tensors, source, HINT)
        return net

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the layers that are not pinned to float32."""
        return self.x_embedder.linear.weight.dtype

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.x_embedder.linear.weight.device

    def forward(
        self,
        x: Tensor,
        t: Tensor | float,
        text: Tensor | TextContext,
        hdmap: Tensor,
        condition_mask: Tensor | None = None,
        block_latents: int | None = 2,
        *,
        window: int | None = None,
        sink: int = 0,
        start: int = 0,
    ) -> Tensor:
        """Predict the velocity of a whole clip; block ``i`` attends to itself and earlier blocks.

        Args:
            x: ``(B, C, T, H, W)`` noised latents, H and W even.
            t: ``(B, T)`` time steps, 0 to 1000, or ``(B, 1)``, or one number for all.
            text: ``(B or 1, tokens, text_width)`` features, or a `TextContext`.
            hdmap: ``(B, condition_channels, T, H, W)`` latents of the semantic map; a network that
                embeds opacity takes its channels after the map's.
            condition_mask: ``(B, 1, T, H, W)`` or what broadcasts to it, 1 where the latent is
                given; None is 0 everywhere.
            block_latents: Latents of a causal block (the last may be shorter); None for
                bidirectional attention, as in the teacher.
            window, sink: Sliding window and attention sink in latents, as in a cache; None for the
                whole past, as in training.
            start: Absolute latent index of the first frame.

        Returns:
            ``(B, C, T, H, W)`` velocity.
        """
        self._check(x, hdmap)
        frames = x.shape[2]
        rows = x.shape[3] // 2
        columns = x.shape[4] // 2
        table = self.rope.table(start, frames, rows, columns, x.device)
        attention = functools.partial(
            block_causal_attention,
            tokens=rows * columns,
            block_latents=block_latents or frames,
            window=window,
            sink=sink,
        )
        return self._run(x, t, text, hdmap, condition_mask, table, lambda layer: attention)

    def step(
        self,
        x_block: Tensor,
        t_block: Tensor | float,
        text: Tensor | TextContext,
        hdmap_block: Tensor,
        cache: BlockCache,
        write: bool = True,
        condition_mask: Tensor | None = None,
    ) -> Tensor:
        """Predict the velocity of one block from its cached past.

        A block may take several forwards (denoising steps, then the cache write): all but the last
        with ``write=False``. They use the same cache slots, and the last one's keys and values are
        kept.

        Args:
            x_block, t_block, text, hdmap_block, condition_mask: As in `forward`, for
                the T latents of the block.
            cache: From `new_cache`; one per rollout.
            write: Keep this forward's keys and values and advance to the next block.

        Returns:
            ``(B, C, T, H, W)`` velocity; without gradients unless the cache keeps them.
        """
        self._check(x_block, hdmap_block)
        cache_sizes = [cache.batch, cache.height, cache.width, cache.rope]
        if cache_sizes != [x_block.shape[0], x_block.shape[3], x_block.shape[4], self.rope]:
            raise InputError(
                f"a cache for batch and sizes {cache_sizes[:3]}: another is needed",
                "make it with this network's new_cache for this batch and latent size",
            )
        with torch.set_grad_enabled(torch.is_grad_enabled() and cache.keeps_graph):
            table = cache.begin(x_block.shape[2])
            v = self._run(
                x_block,
                t_block,
                text,
                hdmap_block,
                condition_mask,
                table,
                lambda layer: functools.partial(cache.attend, layer),
            )
        if write:
            cache.commit()
        return v

    def new_cache(
        self,
        batch: int,
        height: int,
        width: int,
        window: int = 6,
        sink: int = 0,
    ) -> RollingCache:
        """Make an empty cache for inference.

        Args:
            batch: Sequences (or camera views) side by side.
            height, width: Latent size, even.
            window: Latents that a token attends to, own block and sink included.
            sink: First latents of the rollout that stay visible (attention sink).
        """
        return RollingCache(self.rope, batch, height, width, window, sink, self.device)

    def encode_text(self, text: Tensor) -> TextContext:
        """Project a prompt ``(B or 1, tokens, text_width)`` to the cross-attention keys and values
        of every block.
        """
        context = self.crossattn_proj(text.to(self.dtype))
        return tuple(cast(Block, block).cross_attn.keys_values(context) for block in self.blocks)

    def _run(
        self,
        x: Tensor,
        t: Tensor | float,
        text: Tensor | TextContext,
        hdmap: Tensor,
        condition_mask: Tensor | None,
        table: RopeTable,
        attention: Callable[[int], Attend],
    ) -> Tensor:
        steps = t if isinstance(t, Tensor) else torch.full((1, 1), float(t), device=self.device)
        s = sinusoid(steps, self.sizes.width)
        time = self.t_embedding_norm(s), self.t_embedder[1](s)
        text = self.encode_text(text) if isinstance(text, Tensor) else text
        masks = torch.zeros_like(x[:, :MASK_CHANNELS])  # that of padding is zero
        if condition_mask is not None:
            masks[:, :1] = condition_mask
        tokens = self.x_embedder.linear.embed(torch.cat([x, masks], dim=1).to(self.dtype))
        condition = hdmap.to(self.dtype)
        tokens = tokens + self.additional_patch_embedding.linear.embed(
            condition[:, : self.sizes.map_channels]
        )
        opacity = condition[:, self.sizes.map_channels :] if self.sizes.opacity_channels else None
        for layer, block in enumerate(self.blocks):
            tokens = block(tokens, time, text[layer], table, attention(layer), opacity)
        return unpatchify(self.final_layer(tokens, time), x.shape[3], x.shape[4]).to(x.dtype)

    def _check(self, x: Tensor, hdmap: Tensor) -> None:
        check_video("x", x, self.sizes.latent_channels, PATCH)
        expected = [x.shape[0], self.sizes.condition_channels, *x.shape[2:]]
        if list(hdmap.shape) != expected:
            raise InputError(f"hdmap: shape {list(hdmap.shape)}", f"give {expected}")


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
    with torch.device("meta"):
        net = CosmosCausalDiT(sizes)
    out = {}
    for key, value in net.state_dict().items():
        tensor = torch.zeros(value.shape)
        if key.endswith("norm.weight"):
            tensor.fill_(1.0)
        elif (
            tensor.ndim == 2
            and key != "final_layer.adaln_modulation.2.weight"
            and not key.endswith("opacity_embed.weight")
        ):
            std = 1 / math.sqrt(tensor.shape[1])
            nn.init.trunc_normal_(tensor, std=std, a=-CUT * std, b=CUT * std, generator=generator)
        out[key] = tensor
    if zero_velocity:
        out["final_layer.linear.weight"].zero_()
    return out
