"""The factories of the image fixers: what is known of one without loading its networks, and how a
session is made.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.fixers.bundle import FixerFactory
from alpasim_plugin.lab.image_fixers.settings import NoiseWindowSettings, RenderStepSettings

if TYPE_CHECKING:
    from alpasim_plugin.lab.image_fixers.image_fixer import ImageFixer
    from alpasim_plugin.lab.image_fixers.window_fixer import WindowFixer


def _image_session(
    settings: RenderStepSettings, scene_id: str, seed: int, device: str, threads: int | None
) -> ImageFixer:
    from alpasim_plugin.lab.image_fixers.image_fixer import ImageFixer  # loads torch

    return ImageFixer(settings, scene_id, seed, device, threads)


def _window_session(
    settings: NoiseWindowSettings, scene_id: str, seed: int, device: str, threads: int | None
) -> ImageFixer | WindowFixer:
    """Make a session of single frames, or, where a window has more, of a whole clip."""
    from alpasim_plugin.lab.image_fixers.image_fixer import ImageFixer  # loads torch
    from alpasim_plugin.lab.image_fixers.window_fixer import WindowFixer

    return (WindowFixer if settings.is_offline else ImageFixer)(
        settings, scene_id, seed, device, threads
    )


image = FixerFactory(
    RenderStepSettings,
    _image_session,
    {
        "difix": "system of the comparison: DiFix3D+, one step from the render, frame by frame; to be trained",
        "harmonizer": "system of the comparison: DiffusionHarmonizer, one step from the render, frame by frame; to be trained",
        "harmonizer-temporal": "system of the comparison: DiffusionHarmonizer, with its last four outputs; to be trained",
    },
)
windows = FixerFactory(
    NoiseWindowSettings,
    _window_session,
    {
        "gsfix3d": "system of the comparison: GSFix3D, eight steps from noise, frame by frame; to be trained",
        "3dgs-enhancer": "system of the comparison: 3DGS-Enhancer, eight steps from noise in windows; recorded clips only; to be trained",
    },
)
