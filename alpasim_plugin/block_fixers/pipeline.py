"""One block through the networks: encode, mix (Eq. 1), flow (Eq. 2), decode, write the history.
Tensors in, tensors out.

A run leaves the history unchanged: it may be repeated from the same state, with other frames, any
number of times. `BlockPipeline.keep` adds the last run's result to the history.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.kv_cache import RollingCache
from alpasim_plugin.block_fixers.networks import Networks, decode
from alpasim_plugin.block_fixers.sampling import (
    finalise,
    mixed_source,
    opacity_mask,
    opacity_values,
    sample_block,
)
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.streaming import State
from alpasim_plugin.fixers.network.schedule import from_names


def condition_of(
    settings: OneFixerSettings, z_map: Tensor, z_render: Tensor, alpha: Tensor, first: bool
) -> Tensor:
    """Return what the transformer sees besides its source ``(B, channels, T, h, w)``.

    Args:
        settings: Say which of the inputs it sees.
        z_map, z_render: ``(B, 16, T, h, w)``.
        alpha, first: As for `opacity_values`.
    """
    parts = [z_map]
    if settings.render_input:
        parts.append(z_render)
    if settings.opacity_input:
        parts.append(opacity_values(alpha, first))
    return torch.cat(parts, dim=1)


def map_video(settings: OneFixerSettings, rgb: Tensor, sdmap: Tensor | None) -> Tensor | None:
    """Return the map's frames, or what the settings put in the place of none: black frames, or None
    for zero latents.
    """
    return torch.full_like(rgb, -1.0) if sdmap is None and settings.no_map == "black" else sdmap


@dataclass(frozen=True, eq=False)
class PipelineState:
    """State of a rollout before a block. Everything is immutable but the cache."""

    latent: int  # absolute index of the next block's first latent
    encoder: State | None  # render and map views as one batch
    decoder: State | None
    cache: RollingCache
    # adds the block before to the cache, where it is still open; to be called at most once
    write: Callable[[], None] | None = None


class BlockPipeline:
    """Run blocks of views through the networks of a fixer.

    Args:
        networks: Shared, never written to.
        settings: Window, steps, history, source, decoder.
    """

    def __init__(self, networks: Networks, settings: OneFixerSettings) -> None:
        self.networks = networks
        self.settings = settings
        self.schedule = from_names(settings.steps)

    @property
    def draws(self) -> int:
        """How many draws of noise a block takes: one for each step, and one for a cache write by a
        forward.
        """
        return len(self.schedule) + self.settings.finalises

    def start(self, batch: int, height: int, width: int) -> PipelineState:
        """Return the state before a rollout's first block.

        Args:
            batch: Number of views.
            height, width: Pixels, multiples of 16.
        """
        cache = self.networks.dit.new_cache(
            batch, height // 8, width // 8, self.settings.window, self.settings.sink
        )
        return PipelineState(0, None, None, cache)

    @torch.inference_mode()
    def run(
        self,
        state: PipelineState,
        rgb: Tensor,
        alpha: Tensor,
        sdmap: Tensor | None,
        noise: Sequence[Tensor],
    ) -> tuple[Tensor, PipelineState]:
        """Fix one block.

        Args:
            state: From `start` or `keep`; the newest of its rollout.
            rgb: ``(B, 3, T, H, W)`` render in [-1, 1]; T is ``1 + 4 (block_latents - 1)`` in the
                first block, then ``4 block_latents``.
            alpha: ``(B, 1, T, H, W)`` opacity.
            sdmap: ``(B, 3, T, H, W)`` semantic map in [-1, 1], or None for the whole rollout; then
                ``no_map`` says what takes its place.
            noise: `draws` standard normal tensors ``(B, 16, block_latents, H / 8, W / 8)``.

        Returns:
            ``(B, 3, T, H, W)``, not clipped to [-1, 1], and the state after the block, which is
            still open: give it to `keep`, or run the block again.
        """
        settings = self.settings
        nets = self.networks
        is_first = state.latent == 0
        map_frames = map_video(settings, rgb, sdmap)
        views = rgb if map_frames is None else torch.cat([rgb, map_frames])
        latents, encoder = nets.vae.encode_next(views, state.encoder)
        z_render = latents[: len(rgb)].float()
        z_map = latents[len(rgb) :].float()
        if map_frames is None:
            z_map = torch.zeros_like(z_render)
        sources = list(noise[: len(self.schedule)])
        if settings.holes == "render":
            sources = [z_render] * len(sources)
        elif settings.holes == "noise":
            mask = opacity_mask(alpha, first=is_first)
            sources = [mixed_source(z_render, mask, eps) for eps in sources]
        condition = condition_of(settings, z_map, z_render, alpha, is_first)
        cache = state.cache
        z_0 = sample_block(nets.dit, sources, nets.text, condition, cache, self.schedule)
        out, decoder = decode(nets, settings, z_0, rgb, alpha, state.decoder)

        def write() -> None:
            if settings.finalises:
                finalise(nets.dit, z_0, noise[-1], nets.text, condition, cache)
            else:
                cache.commit()

        return out, PipelineState(state.latent + z_0.shape[2], encoder, decoder, cache, write)

    @torch.inference_mode()
    def keep(self, state: PipelineState) -> PipelineState:
        """Add the block that led to ``state`` to the history, and return the state after it."""
        if state.write is not None:
            state.write()
        return replace(state, write=None)

    @torch.inference_mode()
    def drop_history(self, state: PipelineState) -> PipelineState:
        """Return a state at the same latent without NaN: the KV cache is emptied, NaN in the
        codecs' states becomes 0.
        """
        state.cache.reset(state.latent)

        def clean(codec: State | None) -> State | None:
            return codec and tuple(torch.nan_to_num(part, 0.0, 0.0, 0.0) for part in codec)

        encoder = clean(state.encoder)
        decoder = clean(state.decoder)
        return replace(state, encoder=encoder, decoder=decoder, write=None)
