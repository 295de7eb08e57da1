"""3D rotary position embedding (RoPE) over (time, height, width), with NTK-scaled frequencies and
rotate-half pairing.

Each head's channels are split ``h = w = 2 * (head_width // 6)``, ``t = rest``. An axis of width
``d`` has the frequencies ``theta ** (-2k / d)`` for ``k < d / 2`` with ``theta = 10000 * ratio **
(d / (d - 2))``. The angles of a token are concatenated in the order t, h, w and repeated twice;
channel ``j`` is rotated together with channel ``j + head_width / 2``.

Source: Cosmos-Predict2 rotary embedding as released with OmniDreams. The released table has 128
    latents; here positions are
unbounded. Tables are computed on the CPU, also under a default device of ``meta``, and then moved.
Angles are float64: at position 10,000 float32 has an error of 6e-4 rad.

Attention over latents: block-causal over a whole clip, over a cache, and over the text.

Block-causal mask: a token attends to every token of its own block and of earlier blocks. A sliding
window restricts this to the last ``window - sink`` latents up to the end of the own block, plus the
first ``sink`` latents of the rollout (attention sink); the own block is always visible, even when
the window is smaller.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.block_fixers.layers import RMSNorm
from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.errors import InputError

BASE = 10000.0
RopeTable = tuple[Tensor, Tensor]  # cos, sin: (L, head_width / 2) float32
# q, k, v (B, L, heads, head_width) -> (B, L, heads * head_width)
Attend = Callable[[Tensor, Tensor, Tensor], Tensor]


def axis_widths(head_width: int) -> tuple[int, int, int]:
    """Return the number of a head's channels for time, height and width.

    Example:
        >>> axis_widths(128)
        (44, 42, 42)
    """
    if head_width < 2 or head_width % 2:
        raise InputError(
            f"head width: {head_width}",
            "use an even head width",
        )
    spatial = 2 * (head_width // 6)
    return head_width - 2 * spatial, spatial, spatial


def frequencies(width: int, ratio: float) -> Tensor:
    """Return one axis' angular frequencies.

    Args:
        width: Channels of the axis, even.
        ratio: NTK scaling; 1 leaves the base at 10000.

    Returns:
        ``(width / 2,)`` float64, radians per position.
    """
    exponent = torch.arange(0, width, 2, dtype=torch.float64, device="cpu") / max(width, 1)
    # With two channels the only exponent is zero, so the base (whose NTK power is singular) has no
    # effect.
    theta = BASE * ratio ** (width / (width - 2)) if width > 2 else BASE
    return torch.pow(torch.tensor(theta, dtype=torch.float64, device="cpu"), -exponent)


class Rope3D:
    """Compute rotary tables for blocks of latents.

    Args:
        head_width: Channels of one attention head, even.
        ratios: NTK ratios in the order height, width, time.
    """

    def __init__(self, head_width: int, ratios: tuple[float, float, float]) -> None:
        widths = axis_widths(head_width)
        height_ratio, width_ratio, time_ratio = ratios
        pairs = zip(widths, (time_ratio, height_ratio, width_ratio), strict=True)
        self.head_width = head_width
        self.freq_t, self.freq_h, self.freq_w = (
            frequencies(width, ratio) for width, ratio in pairs
        )

    def table(
        self, start: int, frames: int, rows: int, columns: int, device: torch.device | str = "cpu"
    ) -> RopeTable:
        """Return ``cos`` and ``sin`` of a block's tokens in (t, h, w) order, each ``(frames * rows
        * columns, head_width / 2)`` float32.
        """
        t = (
            torch.arange(start, start + frames, dtype=torch.float64, device="cpu")[:, None]
            * self.freq_t
        )
        h = torch.arange(rows, dtype=torch.float64, device="cpu")[:, None] * self.freq_h
        w = torch.arange(columns, dtype=torch.float64, device="cpu")[:, None] * self.freq_w
        shape = (frames, rows, columns, -1)
        half = torch.cat(
            [
                t[:, None, None].expand(shape),
                h[None, :, None].expand(shape),
                w[None, None].expand(shape),
            ],
            dim=-1,
        ).reshape(-1, self.head_width // 2)
        return upload(half.cos().float(), device), upload(half.sin().float(), device)


def rotate(x: Tensor, table: RopeTable) -> Tensor:
    """Apply the rotary embedding to queries or keys, in float32.

    Args:
        x: ``(B, L, heads, head_width)``.
        table: From `Rope3D.table`, ``L`` rows.

    Returns:
        Same shape and dtype as ``x``.
    """
    cos, sin = (part[:, None, :] for part in table)  # (L, 1, head_width / 2)
    first, second = x.float().chunk(2, dim=-1)
    return torch.cat([first * cos - second * sin, second * cos + first * sin], dim=-1).to(x.dtype)


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


def block_causal_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    tokens: int,
    block_latents: int,
    window: int | None = None,
    sink: int = 0,
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
        sinks = slice(0, min(sink, first) * tokens)  # those before the contiguous range
        visible = slice(first * tokens, end * tokens)
        keys, values = (torch.cat([part[:, sinks], part[:, visible]], dim=1) for part in (k, v))
        out.append(attend(q[:, start * tokens : end * tokens], keys, values))
    return torch.cat(out, dim=1)


class Attention(nn.Module):
    """Projections to heads: RMS-normed queries and keys, values, and the way back.

    Args:
        width: Channels of the queries, and of the result.
        context_width: Channels of what is attended to.
        head_width: Channels of a head.
    """

    def __init__(self, width: int, context_width: int, head_width: int) -> None:
        super().__init__()
        self.head_width = head_width
        self.q_proj = nn.Linear(width, width, bias=False)
        self.k_proj = nn.Linear(context_width, width, bias=False)
        self.v_proj = nn.Linear(context_width, width, bias=False)
        self.output_proj = nn.Linear(width, width, bias=False)
        self.q_norm = RMSNorm(head_width)
        self.k_norm = RMSNorm(head_width)

    def queries(self, x: Tensor) -> Tensor:
        """Map tokens ``(B, L, width)`` to queries ``(B, L, heads, head_width)``."""
        return self.q_norm(self.q_proj(x).unflatten(-1, (-1, self.head_width)))

    def keys_values(self, context: Tensor) -> tuple[Tensor, Tensor]:
        """Map ``(B, L, context_width)`` to keys and values ``(B, L, heads, head_width)``."""
        keys = self.k_proj(context).unflatten(-1, (-1, self.head_width))
        values = self.v_proj(context).unflatten(-1, (-1, self.head_width))
        return self.k_norm(keys), values


class SelfAttention(Attention):
    """Attention of latent tokens on latent tokens, with rotated queries and keys."""

    def forward(
        self, x: Tensor, table: RopeTable, attention: Attend, added: Tensor | None = None
    ) -> Tensor:
        """Apply self-attention.

        Args:
            x: ``(B, T, N, width)``.
            table: Rotation of the ``T * N`` tokens.
            attention: Attention of the block's q, k, v and the cached past.
            added: ``(B, T, N, width)`` that is added to the tokens.
        """
        tokens = (x if added is None else x + added).flatten(1, 2)
        keys, values = self.keys_values(tokens)
        attended = attention(rotate(self.queries(tokens), table), rotate(keys, table), values)
        return self.output_proj(attended).view(x.shape)


class CrossAttention(Attention):
    """Attention of latent tokens on text tokens; no positions, no mask."""

    def forward(self, x: Tensor, keys_values: tuple[Tensor, Tensor]) -> Tensor:
        """Attend from ``x (B, T, N, width)`` to the text.

        With a single text token the softmax is 1, so the output is that token's value for every
        query.
        """
        k, v = (part.expand(x.shape[0], *part.shape[1:]) for part in keys_values)
        if k.shape[1] == 1:
            return self.output_proj(v.flatten(2))[:, :, None].expand(x.shape)
        return self.output_proj(attend(self.queries(x.flatten(1, 2)), k, v)).view(x.shape)
