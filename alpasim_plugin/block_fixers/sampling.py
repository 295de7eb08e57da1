"""The noise schedule: time steps of a sampler and their noise levels.

With shift 5, ``sigma(u) = 5 u / (1 + 4 u)`` for ``u`` in (0, 1], tabulated at 1000 points; the
network takes ``1000 sigma``. A *named* step, as in "1000, 750, 500, 250", is ``1000 u``, before the
shift. The cache write at 128 is after the shift: it is the network's time input, and its noise
level is that of the nearest entry in the table (0.12993).

Source: OmniDreams' flow-matching scheduler and self-forcing sampler.

Sampling: from the latents of a render to clean latents (paper, Eq. 1 and 2), and the extension to
    several steps.

Noise is an argument. All functions take normalised latents ``(B, C, T, H, W)`` and are
differentiable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


def opacity_mask(opacity: Tensor, first: bool = True, nan_as: float | None = None) -> Tensor:
    """Max-pool a renderer's opacity to latent size: the mask ``m`` of Eq. 1.

    A latent covers 4 frames of 8 x 8 pixels. The first frame of a rollout is repeated three times,
    since the first latent covers it alone.

    Args:
        opacity: ``(B, 1, frames, H, W)``, 0 to 1; ``1 + 4 n`` frames if ``first``, else ``4 n``; H
            and W in multiples of 8.
        first: Whether the rollout starts here.
        nan_as: Value that replaces NaN; None refuses NaN.

    Returns:
        ``(B, 1, latents, H / 8, W / 8)``.

    Raises:
        InputError: Wrong shape, NaN, or values outside [0, 1].
    """
    return F.max_pool3d(_checked_opacity(opacity, first, nan_as), POOL, POOL)


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
    cells = F.avg_pool3d(_checked_opacity(opacity, first, None), (1, 4, 4))
    b, _, frames, rows, columns = cells.shape
    split = cells.view(b, frames // 4, 4, rows // 2, 2, columns // 2, 2)
    return split.permute(0, 2, 4, 6, 1, 3, 5).flatten(
        1, 3
    )  # (B, frame row column, latents, H / 8, W / 8)


def _checked_opacity(opacity: Tensor, first: bool, nan_as: float | None) -> Tensor:
    """Return opacity in [0, 1], four frames a latent."""
    frames = opacity.shape[2] if opacity.ndim == 5 else 0
    if (
        opacity.ndim != 5
        or opacity.shape[1] != 1
        or frames < 1
        or (frames - first) % 4
        or opacity.shape[3] % 8
        or opacity.shape[4] % 8
    ):
        raise InputError(
            f"opacity: shape {list(opacity.shape)}",
            f"give (B, 1, {'1 + 4 n' if first else '4 n'} frames, H, W) with H and W in multiples of 8",
        )
    if not opacity.is_meta:
        opacity = _without_nan(opacity, nan_as)
    video = opacity.clamp(0, 1)
    if first:
        video = torch.cat([video[:, :, :1].expand(-1, -1, 3, -1, -1), video], dim=2)
    return video


def _without_nan(opacity: Tensor, nan_as: float | None) -> Tensor:
    """Replace NaN, if allowed, and refuse values outside [0, 1]."""
    unknown = opacity.isnan()
    count = int(unknown.sum())
    if count and nan_as is None:
        raise InputError(
            f"opacity: {count} of {opacity.numel()} values are NaN",
            "repair the renderer, or give a replacement with nan_as (0 treats those pixels as empty)",
        )
    if count:
        opacity = opacity.masked_fill(unknown, nan_as if nan_as is not None else 0.0)
    low, high = float(opacity.min()), float(opacity.max())
    if low < -SLACK or high > 1 + SLACK:
        raise InputError(
            f"opacity: values from {low:.4g} to {high:.4g}",
            "give accumulated alpha between 0 and 1",
        )
    return opacity


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
    given: Tensor | None = None,
    finalise_net: BlockNet | None = None,
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
        given: ``(B, C, n, H, W)`` known clean latents of the first n of the block: they replace the
            input of every forward, the cache write included, and the prediction.
        finalise_net: Network for the cache write, when ``net`` is folded for another time step.
        commit: False leaves the block open: run it again (for example with its true poses), or keep
            it with ``cache.commit()``.

    Returns:
        ``(B, C, T, H, W)`` clean latents.

    Raises:
        InputError: A wrong number of sources.
    """
    if len(sources) != sources_needed(schedule, history) or not schedule:
        do = f"give {sources_needed(schedule, history)}: one per step" + (
            ", one for the cache write" if history == "finalise" else ""
        )
        raise InputError(
            f"sources: {len(sources)} sources for {len(schedule)} steps with history {history!r}",
            do,
        )
    fixed, mask = _given(given, sources[0])
    z = sources[0]
    for i, level in enumerate(schedule):
        last = i == len(schedule) - 1
        v = net.step(
            fixed(z),
            level.t,
            text,
            hdmap,
            cache,
            commit and last and history == "last-forward",
            mask,
        )
        z_0 = fixed(flow_step(z, v, level.sigma))
        if not last:
            z = interpolant(z_0, sources[i + 1], schedule[i + 1].sigma)
    if history == "finalise":
        finalise(finalise_net or net, z_0, sources[-1], text, hdmap, cache, given, commit)
    return z_0


def finalise(
    net: BlockNet,
    z_0: Tensor,
    eps: Tensor,
    text: Tensor | TextContext,
    hdmap: Tensor,
    cache: BlockCache,
    given: Tensor | None = None,
    commit: bool = True,
) -> None:
    """Write clean latents into the cache by a forward over them, slightly noised, at t = 128.

    Args:
        net, text, hdmap, cache, given, commit: As in `sample_block`.
        z_0: ``(B, C, T, H, W)`` clean latents of the open block.
        eps: Standard normal noise like ``z_0``.
    """
    level = context_level()
    fixed, mask = _given(given, z_0)
    net.step(fixed(interpolant(z_0, eps, level.sigma)), level.t, text, hdmap, cache, commit, mask)


def _given(given: Tensor | None, like: Tensor) -> tuple[Callable[[Tensor], Tensor], Tensor | None]:
    """Return a function that overwrites the first latents of a block with known ones, and the
    condition mask.
    """
    if given is None:
        return lambda z: z, None
    n = given.shape[2]
    mask = torch.cat([torch.ones_like(given[:, :1]), torch.zeros_like(like[:, :1, n:])], dim=2)
    return lambda z: torch.cat([given, z[:, :, n:]], dim=2), mask
