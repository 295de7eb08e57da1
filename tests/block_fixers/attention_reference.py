"""Block-causal attention with one explicit mask: the reference of
`attention.block_causal_attention`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def block_causal_reference(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    tokens: int,
    block_latents: int,
    window: int | None = None,
    sink: int = 0,
) -> Tensor:
    """Attend with an explicit mask and a written-out softmax; arguments as of
    `block_causal_attention`.
    """
    frames = q.shape[1] // tokens
    mask = torch.zeros(frames, frames, dtype=torch.bool, device=q.device)
    for start in range(0, frames, block_latents):
        end = min(start + block_latents, frames)
        mask[start:end, :end] = True
        if window is not None:
            mask[start:end, sink : min(start, end - (window - sink))] = False
    mask = mask.repeat_interleave(tokens, 0).repeat_interleave(tokens, 1)
    scores = torch.einsum("bqhd,bkhd->bhqk", q, k) / math.sqrt(q.shape[-1])
    weights = scores.masked_fill(~mask, -torch.inf).softmax(dim=-1)
    return torch.einsum("bhqk,bkhd->bqhd", weights, v).flatten(2)
