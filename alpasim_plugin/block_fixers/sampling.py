"""Sampling: from the latents of a render to clean latents (paper, Eq. 1 and 2), and the extension to
several steps.

Noise is an argument. All functions take normalised latents ``(B, C, T, H, W)`` and are
differentiable. The cache write at t = 128 is after the shift of the schedule: its noise level is
that of the nearest entry in the table (0.12993; OmniDreams' self-forcing sampler).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.block_fixers.dit import TextContext
from alpasim_plugin.block_fixers.kv_cache import BlockCache
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.schedule import TABLE, NoiseLevel, interpolant, shifted
from alpasim_plugin.fixers.views import SLACK

CONTEXT_STEP = 128.0
History = Literal["finalise", "last-forward", "none"]
POOL = (4, 8, 8)  # frames, rows, columns of one latent
OPACITY_CHANNELS = 16  # of `opacity_values`: 4 frames, 2 rows, 2 columns of a latent


def context_level(t: float = CONTEXT_STEP) -> NoiseLevel:
    """Return the noise level of the cache write: time input ``t``, sigma of the table's nearest
    entry.

    Example:
        >>> round(context_level().sigma, 5)
        0.12993
    """
    table = (shifted(1 - i / TABLE) for i in range(TABLE))
    return NoiseLevel(t, min(table, key=lambda sigma: abs(TABLE * sigma - t)))


class BlockNet(Protocol):
    """The network interface of the sampler; `CosmosCausalDiT` and its folded copies implement
    it.
    """

    def step(
        self,
        x_block: Tensor,
        t_block: Tensor | float,
        text: Tensor | TextContext,
        hdmap_block: Tensor,
        cache: BlockCache,
        write: bool = True,
        condition_mask: Tensor | None = None,
    ) -> Tensor:
        """Predict the velocity of one block; see `CosmosCausalDiT.step`."""
        ...


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
        InputError: Wrong shape, NaN, or values outside [0, 1].
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
    return split.permute(0, 2, 4, 6, 1, 3, 5).flatten(
        1, 3
    )  # (B, frame row column, latents, H / 8, W / 8)


def _checked_opacity(opacity: Tensor, first: bool) -> Tensor:
    """Return opacity in [0, 1], four frames a latent."""
    fits = opacity.ndim == 5 and opacity.shape[1] == 1 and opacity.shape[2] > 0
    if not fits or (opacity.shape[2] - first) % 4 or opacity.shape[3] % 8 or opacity.shape[4] % 8:
        raise InputError(
            f"opacity: shape {list(opacity.shape)}",
            f"give (B, 1, {'1 + 4 n' if first else '4 n'} frames, H, W) with H and W in multiples of 8",
        )
    if not opacity.is_meta:
        low, high = float(opacity.min()), float(opacity.max())
        if not (low >= -SLACK and high <= 1 + SLACK):  # also refuses NaN
            raise InputError(
                f"opacity: values from {low:.4g} to {high:.4g}",
                "give accumulated alpha between 0 and 1",
            )
    video = opacity.clamp(0, 1)
    if first:
        video = torch.cat([video[:, :, :1].expand(-1, -1, 3, -1, -1), video], dim=2)
    return video


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


def sources_needed(schedule: Sequence[NoiseLevel], history: History) -> int:
    """Return the number of noise tensors for one block: one per step, and one for the cache
    write.
    """
    return len(schedule) + (history == "finalise")


def sample_block(
    net: BlockNet,
    sources: Sequence[Tensor],
    text: Tensor | TextContext,
    hdmap: Tensor,
    cache: BlockCache,
    schedule: Sequence[NoiseLevel],
    history: History = "finalise",
    commit: bool = True,
) -> Tensor:
    """Sample one block of clean latents and write its keys and values into the cache.

    Each step predicts the clean latents; between steps they are noised again to the next level with
    a *fresh* source (stochastic, not Euler). The cache keeps the keys and values of the block's
    last forward: either an extra one over the clean latents, slightly noised at t = 128
    (``finalise``), or the last denoising step itself (``last-forward``, one forward less). With
    ``none`` nothing is kept.

    Args:
        net: The network; a folded copy if ``schedule`` has its one step.
        sources: As many as `sources_needed`: ``z_1`` at the start (Eq. 1, or noise), one for each
            renoising between steps (mixed again with fresh noise, or noise), then the noise of the
            cache write. Each ``(B, C, T, H, W)``.
        text: Prompt, best as a `TextContext`.
        hdmap: ``(B, map_channels, T, H, W)``.
        cache: KV cache of this rollout.
        schedule: Noise levels, the first with sigma 1; see `schedule.steps`.
        history: What the cache keeps.
        commit: False leaves the block open: run it again (for example with its true poses), or keep
            it with ``cache.commit()``.

    Returns:
        ``(B, C, T, H, W)`` clean latents.

    Raises:
        InputError: A wrong number of sources.
    """
    if len(sources) != sources_needed(schedule, history) or not schedule:
        raise InputError(
            f"{len(sources)} sources for {len(schedule)} steps with history {history!r}",
            "give one per step, and one for the cache write of finalise",
        )
    z = sources[0]
    for i, level in enumerate(schedule):
        last = i == len(schedule) - 1
        is_write = commit and last and history == "last-forward"
        v = net.step(z, level.t, text, hdmap, cache, is_write)
        z_0 = flow_step(z, v, level.sigma)
        if not last:
            z = interpolant(z_0, sources[i + 1], schedule[i + 1].sigma)
    if history == "finalise":
        finalise(net, z_0, sources[-1], text, hdmap, cache, commit)
    return z_0


def finalise(
    net: BlockNet,
    z_0: Tensor,
    eps: Tensor,
    text: Tensor | TextContext,
    hdmap: Tensor,
    cache: BlockCache,
    commit: bool = True,
) -> None:
    """Write clean latents into the cache by a forward over them, slightly noised, at t = 128.

    Args:
        net, text, hdmap, cache, commit: As in `sample_block`.
        z_0: ``(B, C, T, H, W)`` clean latents of the open block.
        eps: Standard normal noise like ``z_0``.
    """
    level = context_level()
    net.step(interpolant(z_0, eps, level.sigma), level.t, text, hdmap, cache, commit)
