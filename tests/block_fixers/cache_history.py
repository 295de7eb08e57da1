"""Contents of a KV cache in order of time, for comparisons."""

from __future__ import annotations

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.kv_cache import BlockCache, GraphCache, RollingCache


def history(cache: BlockCache, layer: int) -> tuple[Tensor, Tensor]:
    """Return a layer's cached keys and values, oldest first, ``(B, latents * tokens, heads,
    head_width)``.
    """
    if isinstance(cache, RollingCache):
        ring = cache.size - cache.sink
        rolling = range(max(cache.sink, cache.filled - ring), cache.filled)
        slots = [
            *range(min(cache.sink, cache.filled)),
            *(cache.sink + (i - cache.sink) % ring for i in rolling),
        ]
        rows = cache._token_rows(slots).to(cache.device)
        return cache.keys[layer][:, rows], cache.values[layer][:, rows]
    assert isinstance(cache, GraphCache)
    kept = cache._kept.get(layer, [])
    newest = len(kept) - (cache.window - cache.sink) if cache.window is not None else 0
    visible = [pair for i, pair in enumerate(kept) if i < cache.sink or i >= newest]
    return torch.cat([k for k, _ in visible], dim=1), torch.cat([v for _, v in visible], dim=1)
