"""The per-frame generator in pixels before it is loaded: its settings, its kind of bundle, and its
factory.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from alpasim_plugin.fixers.settings import (
    BundleKind,
    FixerSettings,
    Part,
    Positive,
    Unit,
    WeightedSettings,
    WeightsSettings,
    check_no_blocks,
    check_steps,
    counted_steps,
)


class PixelSizesSettings(Part):
    """Sizes of a generator in pixels where they are not read off weights."""

    widths: tuple[Positive, Positive, Positive] = Field(
        default=(48, 64, 160), description="Channels at 1/4, 1/8 and 1/16."
    )
    blocks: tuple[int, int, int, int, int] = Field(
        default=(0, 1, 1, 1, 1),
        description="Residual blocks at 1/4, 1/8, 1/16, and on the way back at 1/8 and 1/4.",
    )
    detail: Positive = Field(default=16, description="Channels of the detail path at 1/2.")
    hidden: int = Field(default=16, ge=0, description="Recurrent channels at 1/4.")
    blend: int = Field(
        default=0,
        ge=0,
        description="Channels of the head that blends references with the image; 0: none are read.",
    )
    finer: int = Field(
        default=0,
        ge=0,
        description="Channels by which references are weighed once more in large images; 0: they are not.",
    )


USUAL_PX = 256 * 144  # of most images of the training
PER_FRAME = BundleKind(
    "per-frame",
    frozenset({"generator"}),
    may_differ=("steps", "holes", "uses_map", "references", "recording", "scale"),
)


class FrameByFrameSettings(FixerSettings):
    """Of a fixer that works on single frames."""

    @property
    def loop_mode(self) -> str:
        """How the closed loop runs the fixer, in one word."""
        return "frame by frame"

    @model_validator(mode="after")
    def _no_blocks(self) -> Self:
        check_no_blocks(self)
        return self


class PixelFixerSettings(FrameByFrameSettings, WeightedSettings):
    """A causal generator in pixels, one frame at a time."""

    bundle_kind: ClassVar[BundleKind] = PER_FRAME
    uses_map: bool = Field(
        default=True, description="Whether the semantic map is drawn and given to the fixer."
    )
    generator: PixelSizesSettings = Field(
        default=PixelSizesSettings(), description="Sizes where no weights say them."
    )
    weights: WeightsSettings = Field(
        default=WeightsSettings(), description="File with weights: `bundle` alone."
    )
    steps: tuple[float, ...] = Field(
        default=(1000.0,), min_length=1, description="Named time steps, falling from 1000."
    )
    holes: Literal["noise", "render", "everywhere"] = Field(
        default="noise",
        description="Source of a frame: noise where the render is transparent (Eq. 1), the render alone, or noise everywhere.",
    )
    noise: Literal["rollout", "content"] = Field(
        default="rollout",
        description="Key of a frame's noise: its index in the rollout, or its time and content, as in `simrun serve`.",
    )
    keep_render: bool = Field(
        default=True,
        description="Keep the render where it is opaque, the change is large, and neither map nor history supports it.",
    )
    scale: Literal["auto"] | Positive = Field(
        default="auto",
        description="The network looks at an image this many times smaller; render and references are blended at full size. "
        "auto: the largest that leaves as many pixels as 256x144 has, the usual size of the training.",
    )
    precision: Literal["fp32", "bf16"] = Field(
        default="fp32",
        description="Of the network. bf16 is faster where the processor multiplies matrices of it.",
    )

    def scale_of(self, height: int, width: int) -> int:
        """Return how many times smaller the network looks at images of a size.

        Example:
            >>> [PixelFixerSettings(name="onefixer").scale_of(*size) for size in ((144, 256), (270, 480), (288, 512), (1080, 1920))]
            [1, 1, 2, 7]
        """
        return (
            max(1, math.isqrt(height * width // USUAL_PX)) if self.scale == "auto" else self.scale
        )

    @property
    def unit(self) -> Unit:
        """What a frame costs."""
        return Unit(1, len(self.steps), 0, 0)

    @field_validator("scale", mode="before")
    @classmethod
    def _whole(cls, value: Any) -> Any:
        if value != "auto" and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
            raise ValueError(f"scale = {value!r} | give auto, or a whole number from 1")
        return value

    @field_validator("steps", mode="before")
    @classmethod
    def _counted(cls, value: Any) -> Any:
        return counted_steps(value)

    @model_validator(mode="after")
    def _consistent(self) -> PixelFixerSettings:
        check_steps(self.steps)
        parts = [
            key
            for key in ("dit", "vae", "decoder", "prompt")
            if getattr(self.weights, key) is not None
        ]
        if parts:
            raise ValueError(
                f"weights.{parts[0]} | a generator in pixels has one file: give weights.bundle"
            )
        return self
