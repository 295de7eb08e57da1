"""Render a Gaussian cloud with the backend of choice, and carry what a rasteriser returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import NEAR_M

F32 = npt.NDArray[np.float32]
Background = tuple[float, float, float] | npt.NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class RasterOutput:
    """One rendered view.

    Attributes:
        rgb: ``(H, W, 3)`` float32, 0..1, background included, clamped after compositing.
        alpha: ``(H, W)`` float32, accumulated opacity 1 - T; a wall of opaque splats ends at 0.99, not 1.
        depth: ``(H, W)`` float32 metres along the optical axis, alpha-weighted mean over the splats of the pixel; 0 where alpha is 0, so
            read it together with `depth_valid`. At silhouettes it lies between the surfaces.
        stats: Counts of the frame: ``gaussians``, ``visible`` and, for the tiled backend, ``pairs``.
    """

    rgb: F32
    alpha: F32
    depth: F32
    stats: Mapping[str, int] = field(default_factory=dict)

    @property
    def depth_valid(self) -> npt.NDArray[np.bool_]:
        """Return ``(H, W)``: where anything was drawn, so that `depth` means something."""
        return self.alpha > 0

    def to_uint8(self) -> npt.NDArray[np.uint8]:
        """Return ``(H, W, 3)`` uint8 sRGB, rounded to nearest."""
        return np.asarray(self.rgb * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)


def background_image(background: Background, camera: PinholeCamera) -> F32:
    """Return the background as ``(H, W, 3)`` float32, or ``(1, 1, 3)`` where it is one colour.

    Raises:
        InputError: Neither three finite numbers nor an image of the camera's size.
    """
    value = np.asarray(background, dtype=np.float32)
    if value.shape == (3,):
        value = value.reshape(1, 1, 3)
    elif value.shape != (camera.height, camera.width, 3):
        raise InputError(
            "reading a background",
            f"an array of shape {value.shape}",
            f"a camera of {camera.width} x {camera.height} pixels",
            f"give (r, g, b) or an image of shape ({camera.height}, {camera.width}, 3)",
        )
    if not np.isfinite(value).all():
        raise InputError("reading a background", "its values", "NaN or infinity", "give finite numbers, 0..1 for sRGB")
    # Read-only arrays are another type to compiled code and would be compiled for again.
    return np.require(value, np.float32, ["C_CONTIGUOUS", "WRITEABLE"])


Backend = Literal["cpu", "reference", "torch", "gsplat"]


def rasterize(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    backend: Backend = "cpu",
    *,
    near_m: float = NEAR_M,
    lod_px: float = 0.0,
) -> RasterOutput:
    """Render a cloud.

    Args:
        cloud: Gaussians in world coordinates.
        camera: From where.
        background: ``(r, g, b)`` or an ``(H, W, 3)`` image behind everything, 0..1.
        backend: ``cpu`` (fast), ``reference`` (float64, slow, the definition), ``torch`` (differentiable) or ``gsplat`` (GPU).
        near_m: Gaussians whose centre is nearer are left out.
        lod_px: Gaussians whose screen radius before the low-pass is smaller are left out; 0 draws all.

    Returns:
        Colour, accumulated alpha and depth.

    Raises:
        InputError: Unknown backend, or a cloud or background that cannot be drawn.
        RendererError: ``gsplat`` is missing or does not work on this machine; there is no silent fallback.

    Example:
        >>> import numpy as np
        >>> cloud = GaussianCloud([[0, 0, 5.0]], [[1.0, 0, 0, 0]], [[0.5, 0.5, 0.5]], [0.9], np.zeros((1, 1, 3)))
        >>> out = rasterize(cloud, PinholeCamera.from_hfov(32, 16, 1.0), backend="reference")
        >>> out.rgb.shape, round(float(out.depth[8, 16]), 3)
        ((16, 32, 3), 5.0)
    """
    # Imported on use: each backend brings its own heavy library.
    if backend == "cpu":
        from alpasim_plugin.gaussians.raster.rasterize_cpu import rasterize_cpu

        return rasterize_cpu(cloud, camera, background, near_m=near_m, lod_px=lod_px)
    if backend == "reference":
        from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference

        return rasterize_reference(cloud, camera, background, near_m=near_m, lod_px=lod_px)
    if backend == "torch":
        from alpasim_plugin.gaussians.raster.rasterize_torch import rasterize_torch

        return rasterize_torch(cloud, camera, background, near_m=near_m, lod_px=lod_px)
    if backend == "gsplat":
        from alpasim_plugin.gaussians.raster.rasterize_gsplat import rasterize_gsplat

        return rasterize_gsplat(cloud, camera, background, near_m=near_m, lod_px=lod_px)
    raise InputError("rendering Gaussians", f"backend {backend!r}", "no such backend", f"choose one of {', '.join(get_args(Backend))}")
