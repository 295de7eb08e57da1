"""The image systems before they are loaded: settings, kinds of bundle, factories. They have no map
and no history in the transformer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from alpasim_plugin.block_fixers.settings import LatentFixerSettings, latent_kind
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.schedule import TABLE
from alpasim_plugin.fixers.settings import (
    BundleKind,
    Part,
    Positive,
    Unit,
    check_no_blocks,
    check_steps,
    counted_steps,
)

if TYPE_CHECKING:
    pass

LATENT_FRAMES = 4  # of every latent but a clip's first


@dataclass(frozen=True)
class RenderLevel:
    """The noise level that a render is taken to have: ``z_r = alpha z_0 + sigma eps``.

    Example:
        >>> harmonizer = RenderLevel(1.0, 0.25)
        >>> harmonizer.t, harmonizer.scale, harmonizer.network_t
        (0.2, 0.8, 200.0)

    Raises:
        InputError: Values that are not positive.
    """

    alpha: float
    sigma: float

    def __post_init__(self) -> None:
        if not (self.alpha > 0 and self.sigma > 0):
            raise InputError(
                f"alpha and sigma: alpha {self.alpha:g}, sigma {self.sigma:g}",
                "give values above 0",
            )

    @property
    def t(self) -> float:
        """Time on the straight path, 0 to 1."""
        return self.sigma / (self.alpha + self.sigma)

    @property
    def scale(self) -> float:
        """Factor from the render's latents to the point on the path."""
        return 1 / (self.alpha + self.sigma)

    @property
    def network_t(self) -> float:
        """Time input of the network, a whole number of 0 to 1000."""
        return float(round(TABLE * self.t))


class RenderLevelSettings(Part):
    """The noise level that a render is taken to have: ``z_r = alpha z_0 + sigma eps``."""

    alpha: float = Field(gt=0, description="Share of the clean latents.")
    sigma: float = Field(gt=0, description="Share of noise.")


class MaplessSettings(LatentFixerSettings):
    """Attention over all latents of one call, no map, no cache."""

    opacity_to_decoder: bool = Field(
        default=False,
        description="Whether a decoder conditioned on the render is also conditioned on its opacity; else opacity 1.",
    )

    @property
    def loop_mode(self) -> str:
        """How the closed loop runs the fixer, in one word."""
        return "frame by frame"

    @model_validator(mode="after")
    def _no_blocks(self) -> MaplessSettings:
        check_no_blocks(self)
        if self.uses_map:
            raise ValueError("uses_map true | this fixer has no input for a map: leave it out")
        return self


class RenderStepSettings(MaplessSettings):
    """One deterministic step from the render, at a fixed time: DiFix3D+, DiffusionHarmonizer."""

    bundle_kind: ClassVar[BundleKind] = latent_kind(
        "render-step",
        must_match=("opacity_to_decoder", "render_level.alpha", "render_level.sigma"),
        may_differ=("references",),
    )
    render_level: RenderLevelSettings = Field(
        description="The noise level that the render is taken to have."
    )
    references: Literal[0, 4] = Field(
        default=0,
        description="Last outputs that the network looks at; a camera's first frames, which have fewer, are fixed without.",
    )
    steps: Literal[1] = Field(default=1, description="The method takes one step.")

    @property
    def level(self) -> RenderLevel:
        """The render's noise level."""
        return RenderLevel(self.render_level.alpha, self.render_level.sigma)

    @property
    def network_times(self) -> tuple[float, ...]:
        """Time input of the network's one step, 0 to 1000."""
        return (self.level.network_t,)

    @property
    def unit(self) -> Unit:
        """What a frame costs."""
        return Unit(1, 1, 1 + self.references // LATENT_FRAMES, 0)


class NoiseWindowSettings(MaplessSettings):
    """Windows of frames sampled from noise by Euler steps, with the render as a condition: GSFix3D,
    3DGS-Enhancer.
    """

    bundle_kind: ClassVar[BundleKind] = latent_kind(
        "noise-window",
        must_match=("opacity_to_decoder", "window_frames"),
        may_differ=("steps", "stride_frames", "stitch", "noise"),
    )
    opacity_to_decoder: bool = Field(
        default=True, description=MaplessSettings.model_fields["opacity_to_decoder"].description
    )
    steps: tuple[float, ...] = Field(
        min_length=1,
        description="Times of the network's calls, falling from 1000, without a shift.",
    )
    window_frames: Positive = Field(
        default=1, description="Frames of a window, 1 + 4 n. More than one: whole clips only."
    )
    stride_frames: Positive = Field(
        default=1, description="Frames from the start of a window to that of the next."
    )
    stitch: Literal["fade", "cut"] = Field(
        default="fade",
        description="Where windows overlap: the later one fades in linearly, or takes over at once.",
    )
    noise: Literal["fresh", "fixed"] = Field(
        default="fresh",
        description="Noise of a window: its own, or the first window's in all of them, which flickers less.",
    )

    @property
    def latents(self) -> int:
        """Latents of a window."""
        return 1 + (self.window_frames - 1) // LATENT_FRAMES

    @property
    def fade_frames(self) -> int:
        """Frames over which a window fades in."""
        return self.window_frames - self.stride_frames if self.stitch == "fade" else 0

    @property
    def network_times(self) -> tuple[float, ...]:
        """Time inputs of the network's steps, 0 to 1000."""
        return self.steps

    @property
    def is_offline(self) -> bool:
        """Whether the fixer needs whole clips, so that it cannot run in a closed loop."""
        return self.window_frames > 1

    @property
    def loop_mode(self) -> str:
        """How the closed loop runs the fixer, in one word."""
        return "whole clips" if self.is_offline else "frame by frame"

    @property
    def unit(self) -> Unit:
        """What a window costs."""
        return Unit(self.stride_frames, len(self.steps), self.latents, self.window_frames - 1)

    @field_validator("steps", mode="before")
    @classmethod
    def _counted(cls, value: Any) -> Any:
        return counted_steps(value)

    @model_validator(mode="after")
    def _consistent(self) -> NoiseWindowSettings:
        check_steps(self.steps)
        if (self.window_frames - 1) % LATENT_FRAMES:
            raise ValueError(f"window_frames {self.window_frames} | give 1 + 4 n, whole latents")
        if self.stride_frames > self.window_frames:
            raise ValueError(
                f"stride_frames {self.stride_frames} with windows of {self.window_frames} | frames between would be missing"
            )
        return self
