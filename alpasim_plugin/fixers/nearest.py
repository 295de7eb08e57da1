"""The control without a network: the nearest recorded frame, warped into the view, and the render
where that does not hold.
"""

from collections.abc import Sequence
from dataclasses import replace

from pydantic import Field

from alpasim_plugin.core.interfaces import BlockRule, Fixer
from alpasim_plugin.core.types import U8, Frame
from alpasim_plugin.fixers.pixel_settings import FrameByFrameSettings
from alpasim_plugin.fixers.warp import VALID


class NearestSettings(FrameByFrameSettings):
    """Which recorded frames are looked at."""

    references: int = Field(
        default=1,
        ge=1,
        le=8,
        description="Recorded frames; a nearer one is shown before a farther one.",
    )


class NearestFixer(Fixer):
    """Show what references show, and what a fixer that learned must be better than.

    Args:
        settings: How many references.
    """

    settings_model = NearestSettings
    note = "no network"
    blocks = BlockRule(1, 1)

    def __init__(self, settings: NearestSettings) -> None:
        self.settings = settings
        self.label = f"{settings.name}, no network"

    def reset(self, seed: int) -> None:
        """Start a new rollout; there is no history."""

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Return the frames with their references laid over them, the nearest on top."""
        return tuple(self.advance(frame, None, None)[0] for frame in block)

    def advance(self, frame: Frame, sdmap: U8 | None, past: None) -> tuple[Frame, None]:
        """Fix one frame; there is no past."""
        rgb = frame.rgb.copy()
        for image in reversed(frame.references):
            held = image[..., 3] == VALID
            rgb[held] = image[held, :3]
        return replace(frame, rgb=rgb, references=()), None
