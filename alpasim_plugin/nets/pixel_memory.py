"""Causal attention over past frames at 1/16 of the resolution: an option of the generator in pixels.

Every `STRIDE`-th frame leaves the keys and values of its cells; a later frame attends to those of the last ``slots`` such frames. Keys and
values are kept as they were made, so a frame is never computed again.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

STRIDE = 4  # frames from one that is kept to the next
HEADS, WAVES = 2, 4


class MemoryState(NamedTuple):
    """Keys and values of past frames, newest first."""

    kept: Tensor  # (B, slots, cells, 2 width), zero where nothing is kept yet
    frames: Tensor  # (B, 1, 1, 1) float32, frames seen so far


class FrameMemory(nn.Module):
    """Attention from the cells of a frame to those of past frames.

    Args:
        channels: Of the features at 1/16.
        slots: Frames that are kept.
        width: Channels of keys and of values.
    """

    def __init__(self, channels: int, slots: int, width: int = 64) -> None:
        super().__init__()
        self.slots, self.width = slots, width
        self.query, self.key_value = nn.Linear(channels, width), nn.Linear(channels, 2 * width)
        self.place = nn.Linear(4 * WAVES, width, bias=False)  # where a cell is, added to queries and keys
        self.age = nn.Parameter(torch.zeros(slots, width))  # how long ago, added to keys
        self.out = nn.Linear(width, channels)
        nn.init.zeros_(self.out.weight)  # the network begins as the one without a memory
        nn.init.zeros_(self.out.bias)

    def start(self, like: Tensor, cells: int) -> MemoryState:
        """Return the state before a rollout; ``like`` gives the batch and the device."""
        b = len(like)
        return MemoryState(like.new_zeros(b, self.slots, cells, 2 * self.width), like.new_zeros(b, 1, 1, 1))

    def forward(self, x: Tensor, state: MemoryState) -> tuple[Tensor, MemoryState]:
        """Add to ``x`` ``(B, h, w, channels)`` what past frames hold; return it and the state after the frame."""
        b, h, w, _ = x.shape
        place = self.place(_waves(h, w, x))  # (h w, width)
        flat = x.flatten(1, 2)
        key, value = self.key_value(flat).chunk(2, dim=-1)
        count = torch.div(state.frames + STRIDE - 1, STRIDE, rounding_mode="floor")  # frames that are kept so far
        slot = torch.arange(self.slots, device=x.device, dtype=count.dtype)
        known = (slot < count[:, 0, 0]).repeat_interleave(h * w, dim=1)  # (B, slots cells)
        past = state.kept.to(x.dtype)
        keys = (past[..., : self.width] + self.age[:, None]).flatten(1, 2)
        values = past[..., self.width :].flatten(1, 2)
        q, k, v = (_heads(part) for part in (self.query(flat) + place, torch.cat([keys, key + place], 1), torch.cat([values, value], 1)))
        mask = torch.cat([known, known.new_ones(b, h * w)], dim=1)[:, None, None]
        found = F.scaled_dot_product_attention(q, k, v, attn_mask=mask).transpose(1, 2).flatten(2)
        out = x + self.out(found).view_as(x)
        entry = torch.cat([key + place, value], dim=-1)[:, None].float()
        pushed = torch.cat([entry, state.kept[:, :-1]], dim=1)
        kept = torch.where(torch.remainder(state.frames, STRIDE) == 0, pushed, state.kept)
        return out, MemoryState(kept, state.frames + 1)


def _heads(x: Tensor) -> Tensor:
    """Split ``(B, N, width)`` to ``(B, heads, N, width / heads)``."""
    return x.view(*x.shape[:2], HEADS, x.shape[2] // HEADS).transpose(1, 2)


def _waves(h: int, w: int, like: Tensor) -> Tensor:
    """Return sines and cosines of the cells' places ``(h w, 4 WAVES)``; places are shares of the picture."""
    rows = (torch.arange(h, device=like.device) + 0.5) / h
    columns = (torch.arange(w, device=like.device) + 0.5) / w
    rates = math.pi * 2.0 ** torch.arange(WAVES, device=like.device)
    y = (rows[:, None] * rates)[:, None].expand(h, w, WAVES)
    x = (columns[:, None] * rates)[None].expand(h, w, WAVES)
    return torch.cat([y.sin(), y.cos(), x.sin(), x.cos()], dim=-1).flatten(0, 1).to(like.dtype)
