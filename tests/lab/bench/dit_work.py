"""Work of the transformer from its sizes alone: what the counts of real code are compared with.

Multiply-adds count as two. Source of the terms: docs/block-fixers.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from alpasim_plugin.block_fixers.sizes import AREA, DiTSizes


@dataclass(frozen=True)
class ForwardWork:
    """Floating-point operations and least memory traffic of one forward of the transformer over one
    block.
    """

    linear: float
    self_attention: float
    cross_attention: float
    modulation: float  # 0 once folded
    weight_bytes: float  # every weight of the blocks once
    cache_bytes: float  # visible keys and values once, the block's own written

    @property
    def flops(self) -> float:
        """All of it."""
        return self.linear + self.self_attention + self.cross_attention + self.modulation


def forward_work(
    sizes: DiTSizes,
    tokens: int,
    latents: int = 2,
    window: int = 6,
    text_tokens: int = 1,
    folded: bool = True,
    width_bytes: int = 2,
    batch: int = 1,
    mapped: bool = True,
) -> ForwardWork:
    """Return the work of one steady-state forward from the network's sizes.

    Args:
        sizes: Of the network.
        tokens: Of one latent: ``height / 16 * width / 16`` in pixels.
        latents: Of the block.
        window: Latents in sight, own block included.
        text_tokens: Of the prompt; its keys and values are made once and not counted. A single
            token needs no attention.
        folded: Whether the modulation is folded away.
        width_bytes: Bytes of a weight, and of a cached number.
        batch: Views side by side.
        mapped: Whether a semantic map is embedded (by its own product; a map of zeros is not
            skipped).
    """
    d = sizes.width
    f = sizes.mlp_width
    c = sizes.latent_channels
    n = sizes.blocks
    q = latents * tokens * batch
    seen = max(window, latents) * tokens
    alone = text_tokens == 1  # attention to a single token returns its value, projected once
    cross = 2 * batch * d * d if alone else 4 * q * d * d
    linear = n * (8 * q * d * d + 4 * q * d * f + cross) + 2 * q * d * AREA * (
        2 * c + (sizes.map_channels if mapped else 0)
    )
    cross_weights = d * d if alone else 2 * d * d
    per_block = 4 * d * d + 2 * d * f + cross_weights
    modulation = 0.0
    if not folded:
        steps, rank = 1, sizes.adaln_rank  # one time step for the whole block
        modulation = steps * (
            n * 3 * 2 * (d * rank + 3 * d * rank)
            + 2 * (d * d + 3 * d * d)
            + 2 * (d * rank + 2 * d * rank)
        )
    return ForwardWork(
        linear=float(linear),
        self_attention=float(4 * n * q * seen * d),
        cross_attention=0.0 if alone else float(4 * n * q * text_tokens * d),
        modulation=float(modulation),
        weight_bytes=float(n * per_block * width_bytes),
        cache_bytes=float(2 * n * batch * (seen + latents * tokens) * d * width_bytes),
    )


def cache_bytes(
    sizes: DiTSizes, tokens: int, window: int, batch: int = 1, width_bytes: int = 2
) -> int:
    """Return the bytes of a rolling cache, allocated once."""
    return 2 * sizes.blocks * batch * window * tokens * sizes.width * width_bytes
