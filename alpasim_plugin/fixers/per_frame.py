"""The factory of the per-frame generators: what is known of one without loading its network, and how a session is made."""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.fixers.bundle import FixerFactory
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings

if TYPE_CHECKING:
    from alpasim_plugin.fixers.pixel_fixer import PixelFixer


def _session(settings: PixelFixerSettings, scene_id: str, seed: int, device: str, threads: int | None) -> PixelFixer:
    from alpasim_plugin.fixers.pixel_fixer import PixelFixer  # loads torch

    return PixelFixer(settings, scene_id, seed, device, threads)


per_frame = FixerFactory(PixelFixerSettings, _session)
