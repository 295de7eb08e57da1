"""The KV cache of training: a growing list of keys and values with their gradients.

It has the visibility rule of `alpasim_plugin.block_fixers.kv_cache.RollingCache` and is its
reference implementation.
"""

from __future__ import annotations

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.attention import attend
from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.kv_cache import BlockCache
from alpasim_plugin.core.errors import InputError


class GraphCache(BlockCache):
    """Keep every block's keys and values with their gradients; memory grows with the rollout."""

    keeps_graph = True

    @classmethod
    def of(
        cls,
        net: CosmosCausalDiT,
        batch: int,
        height: int,
        width: int,
        window: int | None = 6,
        sink: int = 0,
    ) -> GraphCache:
        """Make an empty cache for a network; arguments as of `CosmosCausalDiT.new_cache`, and a
        window of None holds all latents.
        """
        return cls(net.rope, batch, height, width, window, sink, net.device)

    def reset(self, position: int = 0) -> None:
        """Clear the cache and start at an absolute latent index."""
        super().reset(position)
        # layer -> per latent k, v: (B, tokens, heads, head_width)
        self._kept: dict[int, list[tuple[Tensor, Tensor]]] = {}
        self._open: dict[int, tuple[Tensor, Tensor]] = {}

    def attend(self, layer: int, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Attend to the concatenation of the visible past and the block."""
        self._open[layer] = (k, v)
        kept = self._kept.get(layer, [])
        oldest = 0
        if self.window is not None:
            end = self.filled + self.open_latents
            oldest = min(self.filled, end - (self.window - self.sink))
        visible = [i for i in range(self.filled) if i < self.sink or i >= oldest]
        return attend(
            q,
            torch.cat([*(kept[i][0] for i in visible), k], dim=1),
            torch.cat([*(kept[i][1] for i in visible), v], dim=1),
        )

    def commit(self) -> None:
        """Keep the tensors of the last forward."""
        for layer, (k, v) in self._open.items():
            pairs = zip(
                torch.split(k, self.tokens, dim=1), torch.split(v, self.tokens, dim=1), strict=True
            )
            self._kept.setdefault(layer, []).extend(pairs)
        self._open = {}
        super().commit()

    def fork(self) -> GraphCache:
        """Return an independent cache with the same, detached past.

        Raises:
            InputError: A block is open.
        """
        if self.open_latents:
            raise InputError(
                f"latent {self.position}: an open block with forwards that were not committed",
                "commit the block first, or reset the cache",
            )
        copy = GraphCache(
            self.rope, self.batch, self.height, self.width, self.window, self.sink, self.device
        )
        copy.position = self.position
        copy.filled = self.filled
        copy._kept = {
            layer: [(k.detach(), v.detach()) for k, v in kept] for layer, kept in self._kept.items()
        }
        return copy
