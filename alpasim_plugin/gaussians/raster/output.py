"""What a rasteriser returns, and the background that it receives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, U8, Bool, FloatArray, Frame
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.lens_camera import LensCamera

OPAQUE = 0.5  # opacity from which a pixel shows a surface
Background = tuple[float, float, float] | FloatArray


@dataclass(frozen=True, eq=False)
class RasterOutput:
    """One rendered view.

    Attributes:
        rgb: ``(H, W, 3)`` float32, 0..1, background included, clamped after compositing.
        alpha: ``(H, W)`` float32, accumulated opacity 1 - T; a wall of opaque splats ends at 0.99,
            not 1.
        depth: ``(H, W)`` float32 metres along the optical axis, through a lens from the camera's
            centre, alpha-weighted mean over the splats of the pixel; 0 where alpha is 0, so read it together with `alpha`. At silhouettes
            it lies between the surfaces.
    """

    rgb: F32
    alpha: F32
    depth: F32

    def on_host(self) -> RasterOutput:
        """Return the view with arrays: itself, unless a device drew it."""
        return self

    def blank(
        self,
        height: int,
        width: int,
        parts: Sequence[RasterOutput],
        again: Callable[[], Sequence[RasterOutput]],
    ) -> RasterOutput:
        """Return a black and opaque image without depth, into which parts are to be written.

        Args:
            height, width: Pixels.
            parts: Drawn where this one was.
            again: Draws the image with all parts once more, where a device lacked room for one;
                alone in a list.
        """
        rgb = np.zeros((height, width, 3), dtype=np.float32)
        alpha = np.ones((height, width), dtype=np.float32)
        return RasterOutput(rgb, alpha, np.zeros_like(alpha))

    def beside(self, array: FloatArray | Bool) -> Any:
        """Return an array where the planes are."""
        return array

    def changed(self, change: Callable[[Any], Mapping[str, Any]]) -> Self:
        """Return the view with other planes."""
        return replace(self, **change(self))

    def surface(self) -> Self:
        """Return the view with depth only where the splats are at least half opaque; 0 where the
        background shows through.
        """
        return self.changed(lambda out: {"depth": out.depth * (out.alpha >= OPAQUE)})

    def covered(self, share: F32) -> Self:
        """Return the view with an opacity of at least ``share``, ``(H, W)`` or one number."""
        least = self.beside(share)
        return self.changed(lambda out: {"alpha": out.alpha.clip(least)})

    def with_sky(self, above: Bool) -> Self:
        """Return the view with an opaque sky without depth where no surface is shown.

        Args:
            above: ``(H, W)`` the pixels above the horizon.
        """
        high = self.beside(above)

        def change(out: Any) -> Mapping[str, Any]:
            sky = (out.alpha < OPAQUE) & high
            return {"alpha": out.alpha.clip(sky), "depth": out.depth * ~sky}

        return self.changed(change)

    def exposed(self, gain: F32) -> Self:
        """Return the view with another exposure, a factor ``(3,)`` for the channels."""
        factor = self.beside(gain)
        return self.changed(lambda out: {"rgb": (out.rgb * factor).clip(0, 1)})

    def frame(self, t_us: int, camera: str) -> Frame:
        """Return the view as a camera's frame."""
        return Frame(t_us, camera, self.to_uint8(), self.alpha, self.depth)

    def to_uint8(self) -> U8:
        """Return ``(H, W, 3)`` uint8 sRGB, rounded to nearest."""
        levels = self.rgb * np.float32(255.0)
        levels += np.float32(0.5)
        return levels.astype(np.uint8)


def background_image(background: Background, camera: PinholeCamera | LensCamera) -> F32:
    """Return the background as ``(H, W, 3)`` float32, or ``(1, 1, 3)`` where it is one colour.

    Raises:
        InputError: Neither three finite numbers nor an image of the camera's size.
    """
    value = np.asarray(background, dtype=np.float32)
    if value.shape == (3,):
        value = value.reshape(1, 1, 3)
    elif value.shape != (camera.height, camera.width, 3):
        raise InputError(
            f"an array of shape {value.shape}: a camera of {camera.width} x {camera.height} pixels",
            f"give (r, g, b) or an image of shape ({camera.height}, {camera.width}, 3)",
        )
    # A sum is finite only if all are; one of huge values may overflow, and then each is looked at.
    if not np.isfinite(value.sum()) and not np.isfinite(value).all():
        raise InputError(
            "its values: NaN or infinity",
            "give finite numbers, 0..1 for sRGB",
        )
    # Read-only arrays are another type to compiled code and would be compiled for again.
    return np.require(value, dtype=np.float32, requirements=["C_CONTIGUOUS", "WRITEABLE"])
