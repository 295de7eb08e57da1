"""3D rotary position embedding (RoPE) over (time, height, width), with NTK-scaled frequencies and rotate-half pairing.

Each head's channels are split ``h = w = 2 * (head_width // 6)``, ``t = rest``. An axis of width ``d`` has the frequencies ``theta **
(-2k / d)`` for ``k < d / 2`` with ``theta = 10000 * ratio ** (d / (d - 2))``. The angles of a token are concatenated in the order t, h,
w and repeated twice; channel ``j`` is rotated together with channel ``j + head_width / 2``.

Source: Cosmos-Predict2 rotary embedding as released with OmniDreams. The released table has 128 latents; here positions are
unbounded. Tables are computed on the CPU, also under a default device of ``meta``, and then moved. Angles are float64: at position 10,000
float32 has an error of 6e-4 rad.
"""

from __future__ import annotations

import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError

BASE = 10000.0
RopeTable = tuple[Tensor, Tensor]  # cos, sin: (L, head_width / 2) float32


def axis_widths(head_width: int) -> tuple[int, int, int]:
    """Return the number of a head's channels for time, height and width.

    Example:
        >>> axis_widths(128)
        (44, 42, 42)
    """
    if head_width < 2 or head_width % 2:
        raise InputError("splitting a head for rotary positions", "head width", str(head_width), "use an even head width")
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
    # With two channels the only exponent is zero, so the base (whose NTK power is singular) has no effect.
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
        self.head_width, self.ratios = head_width, ratios
        self.freq_t, self.freq_h, self.freq_w = (frequencies(width, ratio) for width, ratio in pairs)

    def angles(self, start: int, frames: int, rows: int, columns: int) -> Tensor:
        """Return the angle of every token and channel.

        Args:
            start: Absolute latent index of the first frame in its rollout.
            frames, rows, columns: Token grid of the block.

        Returns:
            ``(frames, rows, columns, head_width)`` float64 radians, the second half repeating the first.
        """
        half = self._half(start, frames, rows, columns)
        return torch.cat([half, half], dim=-1)

    def table(self, start: int, frames: int, rows: int, columns: int, device: torch.device | str = "cpu") -> RopeTable:
        """Return ``cos`` and ``sin`` of a block's tokens in (t, h, w) order, each ``(frames * rows * columns, head_width / 2)`` float32."""
        half = self._half(start, frames, rows, columns).reshape(-1, self.head_width // 2)
        return half.cos().float().to(device), half.sin().float().to(device)

    def move(self, table: RopeTable, start: int, frames: int) -> None:
        """Update a table of `table` to another start, in place: only the time columns change.

        Bit-identical to a new table, with less arithmetic and less data moved to the device.
        """
        angle = torch.arange(start, start + frames, dtype=torch.float64, device="cpu")[:, None] * self.freq_t
        for kept, new in zip(table, (angle.cos(), angle.sin()), strict=True):
            columns = kept.view(frames, -1, self.head_width // 2)[..., : len(self.freq_t)]
            columns.copy_(new.float().to(kept.device)[:, None].expand(columns.shape))

    def _half(self, start: int, frames: int, rows: int, columns: int) -> Tensor:
        t = torch.arange(start, start + frames, dtype=torch.float64, device="cpu")[:, None] * self.freq_t
        h = torch.arange(rows, dtype=torch.float64, device="cpu")[:, None] * self.freq_h
        w = torch.arange(columns, dtype=torch.float64, device="cpu")[:, None] * self.freq_w
        shape = (frames, rows, columns, -1)
        return torch.cat([t[:, None, None].expand(shape), h[None, :, None].expand(shape), w[None, None].expand(shape)], dim=-1)


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
