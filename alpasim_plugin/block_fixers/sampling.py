"""Sampling: from the latents of a render to clean latents (paper, Eq. 1 and 2), and the extension to
several steps.

Noise is an argument. All functions take normalised latents ``(B, C, T, H, W)`` and are
differentiable. The cache write at t = 128 is after the shift of the schedule: its noise level is
that of the nearest entry in the table (0.12993; OmniDreams' self-forcing sampler).
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.block_fixers.clips import check_frames, whole_groups
from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.block_fixers.kv_cache import BlockCache
from alpasim_plugin.fixers.network.schedule import (
    TABLE,
    NoiseLevel,
    interpolant,
    shifted,
)

CONTEXT_STEP = 128.0
POOL = (4, 8, 8)  # frames, rows, columns of one latent
OPACITY_CHANNELS = 16  # of `opacity_values`: 4 frames, 2 rows, 2 columns of a latent


def context_level() -> NoiseLevel:
    """Return the noise level of the cache write: time input 128, sigma of the table's nearest
    entry.

    Example:
        >>> round(context_level().sigma, 5)
        0.12993
    """
    table = (shifted(1 - i / TABLE) for i in range(TABLE))
    sigma = min(table, key=lambda sigma: abs(TABLE * sigma - CONTEXT_STEP))
    return NoiseLevel(CONTEXT_STEP, sigma)


def opacity_mask(opacity: Tensor, first: bool = True) -> Tensor:
    """Max-pool a renderer's opacity to latent size: the mask ``m`` of Eq. 1.

    A latent covers 4 frames of 8 x 8 pixels. The first frame of a rollout is repeated three times,
    since the first latent covers it alone.

    Args:
        opacity: ``(B, 1, frames, H, W)``, 0 to 1; ``1 + 4 n`` frames if ``first``, else ``4 n``; H
            and W in multiples of 8.
        first: Whether the rollout starts here.

    Returns:
        ``(B, 1, latents, H / 8, W / 8)``.

    Raises:
        InputError: Another shape.
    """
    return F.max_pool3d(_checked_opacity(opacity, first), POOL, POOL)


def opacity_values(opacity: Tensor, first: bool = True) -> Tensor:
    """Average a renderer's opacity over 4 x 4 pixels, as channels of its latents: the input of a
    network that sees the opacity.

    Args:
        opacity, first: As for `opacity_mask`.

    Returns:
        ``(B, 16, latents, H / 8, W / 8)``, channels ordered (frame, row, column).

    Raises:
        InputError: As `opacity_mask`.
    """
    cells = F.avg_pool3d(_checked_opacity(opacity, first), (1, 4, 4))
    b, _, frames, rows, columns = cells.shape
    split = cells.view(b, frames // 4, 4, rows // 2, 2, columns // 2, 2)
    # (B, frame row column, latents, H / 8, W / 8)
    return split.permute(0, 2, 4, 6, 1, 3, 5).flatten(1, 3)


def _checked_opacity(opacity: Tensor, first: bool) -> Tensor:
    """Return opacity in [0, 1], four frames a latent."""
    check_frames("opacity", opacity, 1, first)
    return whole_groups(opacity.clamp(0, 1), first)


def mixed_source(z_r: Tensor, m: Tensor, eps: Tensor) -> Tensor:
    """Mix the render where it is opaque with noise elsewhere (Eq. 1).

    Args:
        z_r: ``(B, C, T, H, W)`` latents of the render.
        m: ``(B, 1, T, H, W)`` mask from `opacity_mask`.
        eps: Standard normal noise like ``z_r``.

    Returns:
        ``z_1``, like ``z_r``.
    """
    return m * z_r + (1 - m) * eps


def flow_step(z_t: Tensor, v: Tensor, t: Tensor | float = 1.0) -> Tensor:
    """Predict the clean latents in one Euler step along the velocity (Eq. 2): ``z_0 = z_t - t v``;
    in float32 or wider.
    """
    wide = torch.promote_types(z_t.dtype, torch.float32)
    return (z_t.to(wide) - t * v.to(wide)).to(z_t.dtype)


def sample_block(
    net: CosmosCausalDiT,
    sources: Sequence[Tensor],
    text: Tensor | TextContext,
    hdmap: Tensor,
    cache: BlockCache,
    schedule: Sequence[NoiseLevel],
) -> Tensor:
    """Sample one block of clean latents and leave it open in the cache.

    Each step predicts the clean latents; between steps they are noised again to the next level with
    a *fresh* source (stochastic, not Euler). Then the block may be sampled again, for example with
    its true poses. Its keys and values enter the cache by ``cache.commit()``, which keeps those of
    the last step, or by `finalise`.

    Args:
        net: The network.
        sources: One for each step: ``z_1`` at the start (Eq. 1, or noise), then one for each
            renoising (mixed again with fresh noise, or noise). Each ``(B, C, T, H, W)``.
        text: Prompt, best as a `TextContext`.
        hdmap: ``(B, map_channels, T, H, W)``.
        cache: KV cache of this rollout.
        schedule: Noise levels, the first with sigma 1; see `schedule.steps`.

    Returns:
        ``(B, C, T, H, W)`` clean latents.
    """
    z_0 = sources[0]
    for source, level in zip(sources, schedule, strict=True):
        z_t = interpolant(z_0, source, level.sigma)
        z_0 = flow_step(z_t, net.step(z_t, level.t, text, hdmap, cache, write=False), level.sigma)
    return z_0


def finalise(
    net: CosmosCausalDiT,
    z_0: Tensor,
    eps: Tensor,
    text: Tensor | TextContext,
    hdmap: Tensor,
    cache: BlockCache,
) -> None:
    """Write clean latents into the cache by a forward over them, slightly noised, at t = 128.

    Args:
        net, text, hdmap, cache: As in `sample_block`.
        z_0: ``(B, C, T, H, W)`` clean latents of the open block.
        eps: Standard normal noise like ``z_0``.
    """
    level = context_level()
    net.step(interpolant(z_0, eps, level.sigma), level.t, text, hdmap, cache)
