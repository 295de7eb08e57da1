"""KV caches: what every cache is, and the fixed rolling buffer for inference.

Every cache has the same visibility rule (see `attention`): the window includes the sink and the own
block. Keys are stored after the rotary embedding at their absolute positions.

`RollingCache` allocates once a layer, at its first block. Latent ``i`` is in slot ``i`` if it is a sink, else in slot ``sink +
(i - sink) % (window - sink)``, so the newest latents overwrite the oldest without moves. Attention
is invariant to the order of keys, so the buffer is used unsorted.

A block is a series of forwards at one position: `begin` opens or reopens it, `attend` serves one
layer, `commit` keeps the keys and values of the last forward and advances.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.attention import Rope3D, RopeTable, attend
from alpasim_plugin.core.devices import upload


class BlockCache(ABC):
    """Base class: position in the rollout and the rotary table of the open block.

    Args:
        rope: The network's rotary positions.
        batch: Sequences side by side.
        height, width: Latent size, even.
        window: Latents that a token attends to, own block and sink included; None for all.
        sink: First latents of the rollout that stay visible (attention sink).
        device: Of keys and values.
    """

    keeps_graph: bool = False

    def __init__(
        self,
        rope: Rope3D,
        batch: int,
        height: int,
        width: int,
        window: int | None,
        sink: int,
        device: torch.device,
    ) -> None:
        self.rope, self.batch, self.height, self.width = rope, batch, height, width
        self.window, self.sink, self.device = window, sink, device
        self.rows = height // 2
        self.columns = width // 2
        self.tokens = self.rows * self.columns
        self.reset()

    def reset(self, position: int = 0) -> None:
        """Clear the cache and start at an absolute latent index."""
        self.position = position  # of the open block's first latent
        # latents committed since reset; differs from position in a rollout that does not start at 0
        self.filled = 0
        self.open_latents = 0  # length of the open block; 0 between blocks

    def begin(self, latents: int) -> RopeTable:
        """Open or reopen the block at the current position, and return the rotary table of its
        tokens.
        """
        self.open_latents = latents
        return self.rope.table(self.position, latents, self.rows, self.columns, self.device)

    def commit(self) -> None:
        """Keep the keys and values of the last forward and advance by its block."""
        self.position += self.open_latents
        self.filled += self.open_latents
        self.open_latents = 0

    @abstractmethod
    def attend(self, layer: int, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Attend from the open block to itself and the visible past; see `attention.attend` for
        shapes.
        """


class RollingCache(BlockCache):
    """Hold at most ``window`` latents per layer in preallocated buffers.

    Forwards through it run without gradients, since its buffers are overwritten in place.
    """

    window: int

    def reset(self, position: int = 0) -> None:
        """Clear the cache and start at an absolute latent index."""
        super().reset(position)
        self.buffers: dict[int, Tensor] = {}  # layer -> (2, B, slots, heads, head_width)

    def begin(self, latents: int) -> RopeTable:
        """Open the block and choose the slots of its latents.

        A block that is opened again has its first length: its forwards share slots.
        """
        table = super().begin(latents)
        ring = self.window - self.sink
        block_rows = range(self.filled, self.filled + latents)
        rolling = [i for i in block_rows if i >= self.sink]
        self._fits = len(rolling) <= ring  # whether the open block fits in the window
        # A block longer than the ring attends to all of itself; only its newest latents are cached.
        kept = [i for i in block_rows if i < self.sink] + rolling[max(0, len(rolling) - ring) :]
        slots = [i if i < self.sink else self.sink + (i - self.sink) % ring for i in kept]
        self._rows = self._token_rows(slots)
        self._source = self._token_rows([i - self.filled for i in kept])
        return table

    def attend(self, layer: int, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Write the block's keys and values into their slots and attend to the buffer."""
        block_keys_values = torch.stack([k, v])
        if layer not in self.buffers:
            with torch.inference_mode(False):
                slots = self.window * self.tokens
                self.buffers[layer] = torch.zeros_like(block_keys_values[:, :, :1]).repeat(
                    1, 1, slots, 1, 1
                )
        buffer = self.buffers[layer]
        buffer.index_copy_(2, self._rows, block_keys_values[:, :, self._source])
        if self._fits:
            end = min(self.window, self.filled + self.open_latents) * self.tokens
            return attend(q, *buffer[:, :, :end])
        past = min(self.sink, self.filled) * self.tokens
        return attend(q, *torch.cat([buffer[:, :, :past], block_keys_values], dim=2))

    def _token_rows(self, latents: list[int]) -> Tensor:
        first = upload(torch.tensor(latents, dtype=torch.long), self.device)[:, None] * self.tokens
        return (first + torch.arange(self.tokens, device=self.device)).flatten()
