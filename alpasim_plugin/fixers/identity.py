"""Fixers that are known without loading a network: the one that fixes nothing, and the factory of
the per-frame generators.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from alpasim_plugin.core.interfaces import BlockRule, Fixer
from alpasim_plugin.core.types import U8, Frame
from alpasim_plugin.fixers.bundle import FixerFactory
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.fixers.settings import FixerSettings

if TYPE_CHECKING:
    from alpasim_plugin.fixers.pixel_fixer import PixelFixer


class IdentityFixer(Fixer):
    """Return every frame as it came.

    Args:
        settings: Gives the length of a block.
    """

    settings_model = FixerSettings
    note = "no network"

    def __init__(self, settings: FixerSettings) -> None:
        self.settings = settings
        self.label = f"{settings.name}, no network"
        self.blocks = BlockRule.of_latents(settings.block_latents)
        self._done = 0

    def reset(self, seed: int) -> None:
        """Start a new rollout."""
        self._done = 0

    def preview(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Return the block, checked as every fixer checks it."""
        from alpasim_plugin.fixers.views import group_views  # loads torch

        group_views(block, maps, self.blocks.frames(self._done))
        return tuple(block)

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Return the block and count it."""
        out = self.preview(block, maps)
        self._done += 1
        return out


def _session(
    settings: PixelFixerSettings, scene_id: str, seed: int, device: str, threads: int | None
) -> PixelFixer:
    from alpasim_plugin.fixers.pixel_fixer import PixelFixer  # loads torch

    return PixelFixer(settings, scene_id, seed, device, threads)


per_frame = FixerFactory(PixelFixerSettings, _session)
