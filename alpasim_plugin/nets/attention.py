"""Attention over latents: block-causal over a whole clip, over a cache, and over the text.

Block-causal mask: a token attends to every token of its own block and of earlier blocks. A sliding window restricts this to the last
``window - sink`` latents up to the end of the own block, plus the first ``sink`` latents of the rollout (attention sink); the own block
is always visible, even when the window is smaller.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.nets.layers import RMSNorm
from alpasim_plugin.nets.rope import RopeTable, rotate

Attend = Callable[[Tensor, Tensor, Tensor], Tensor]  # q, k, v (B, L, heads, head_width) -> (B, L, heads * head_width)


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Attend from every query to every key, without a mask.

    Args:
        q: ``(B, Lq, heads, head_width)``.
        k, v: ``(B, Lk, heads, head_width)``.

    Returns:
        ``(B, Lq, heads * head_width)``.
    """
    out = F.scaled_dot_product_attention(q.transpose(1, 2), k.transpose(1, 2), v.transpose(1, 2))
    return out.transpose(1, 2).flatten(2)


def visible_latents(start: int, end: int, window: int | None, sink: int) -> list[int]:
    """Return the latents that are visible to the block ``[start, end)``, oldest first.

    Example:
        >>> visible_latents(8, 10, 6, 2)
        [0, 1, 6, 7, 8, 9]
        >>> visible_latents(8, 10, 1, 0)
        [8, 9]
    """
    if window is None:
        return list(range(end))
    oldest = min(start, end - (window - sink))
    return [i for i in range(end) if i < sink or i >= oldest]


def block_causal_attention(
    q: Tensor, k: Tensor, v: Tensor, tokens: int, block_latents: int, window: int | None = None, sink: int = 0
) -> Tensor:
    """Attend block by block without building a mask.

    Args:
        q, k, v: ``(B, T * tokens, heads, head_width)``.
        tokens: Tokens of one latent.
        block_latents: Latents of a block; the last block may be shorter.
        window, sink: See the module text; None for the whole past.

    Returns:
        ``(B, T * tokens, heads * head_width)``.
    """
    frames = q.shape[1] // tokens
    out = []
    for start in range(0, frames, block_latents):
        end = min(start + block_latents, frames)
        first = 0 if window is None else max(0, min(start, end - (window - sink)))
        keys, values = (part[:, first * tokens : end * tokens] for part in (k, v))
        kept = min(sink, first) if window is not None else 0  # sink latents outside the contiguous range
        if kept:
            keys, values = (torch.cat([part[:, : kept * tokens], run], dim=1) for part, run in ((k, keys), (v, values)))
        out.append(attend(q[:, start * tokens : end * tokens], keys, values))
    return torch.cat(out, dim=1)


class SelfAttention(nn.Module):
    """Attention of latent tokens on latent tokens, with RMS-normed and rotated queries and keys.

    After folding (`fuse`) the three projections are one linear with bias.
    """

    def __init__(self, width: int, head_width: int) -> None:
        super().__init__()
        self.head_width = head_width
        self.q_proj = nn.Linear(width, width, bias=False)
        self.k_proj = nn.Linear(width, width, bias=False)
        self.v_proj = nn.Linear(width, width, bias=False)
        self.output_proj = nn.Linear(width, width, bias=False)
        self.q_norm = RMSNorm(head_width)
        self.k_norm = RMSNorm(head_width)
        self.qkv_proj: nn.Linear | None = None

    def fuse(self, qkv: nn.Linear) -> None:
        """Replace the three projections by one."""
        self.qkv_proj = qkv
        del self.q_proj, self.k_proj, self.v_proj

    def project(self, x: Tensor, added: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Map tokens ``(B, L, width)`` to normed queries and keys, and values, each ``(B, L, heads, head_width)``.

        ``added (B, L, width)`` is added to the tokens; once the projections are fused it is ``(B, L, 3 * width)``, already projected.
        """
        if self.qkv_proj is None:
            x = x if added is None else x + added
            parts = self.q_proj(x), self.k_proj(x), self.v_proj(x)
        else:
            qkv = self.qkv_proj(x)
            parts = (qkv if added is None else qkv + added).chunk(3, dim=-1)
        q, k, v = (part.unflatten(-1, (-1, self.head_width)) for part in parts)
        return self.q_norm(q), self.k_norm(k), v

    def forward(self, x: Tensor, table: RopeTable, attention: Attend, added: Tensor | None = None) -> Tensor:
        """Apply self-attention.

        Args:
            x: ``(B, T, N, width)``.
            table: Rotation of the ``T * N`` tokens.
            attention: Attention of the block's q, k, v and the cached past.
            added: See `project`, ``(B, T, N, ...)``.
        """
        q, k, v = self.project(x.flatten(1, 2), None if added is None else added.flatten(1, 2))
        out: Tensor = self.output_proj(attention(rotate(q, table), rotate(k, table), v))
        return out.view(x.shape)


class CrossAttention(nn.Module):
    """Attention of latent tokens on text tokens; no positions, no mask."""

    def __init__(self, width: int, context_width: int, head_width: int) -> None:
        super().__init__()
        self.head_width = head_width
        self.q_proj = nn.Linear(width, width, bias=False)
        self.k_proj = nn.Linear(context_width, width, bias=False)
        self.v_proj = nn.Linear(context_width, width, bias=False)
        self.output_proj = nn.Linear(width, width, bias=False)
        self.q_norm = RMSNorm(head_width)
        self.k_norm = RMSNorm(head_width)

    def keys_values(self, context: Tensor) -> tuple[Tensor, Tensor]:
        """Map the context ``(B, tokens, context_width)`` to keys and values ``(B, tokens, heads, head_width)``; once per prompt."""
        k, v = (part.unflatten(-1, (-1, self.head_width)) for part in (self.k_proj(context), self.v_proj(context)))
        return self.k_norm(k), v

    def forward(self, x: Tensor, keys_values: tuple[Tensor, Tensor]) -> Tensor:
        """Attend from ``x (B, T, N, width)`` to the text.

        With a single text token the softmax is 1, so the output is that token's value for every query.
        """
        k, v = (part.expand(x.shape[0], *part.shape[1:]) for part in keys_values)
        if k.shape[1] == 1:
            value: Tensor = self.output_proj(v.flatten(2))
            return value[:, :, None].expand(x.shape)
        q = self.q_norm(self.q_proj(x.flatten(1, 2)).unflatten(-1, (-1, self.head_width)))
        out: Tensor = self.output_proj(attend(q, k, v))
        return out.view(x.shape)
