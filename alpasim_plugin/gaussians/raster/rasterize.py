"""Render a Gaussian cloud with the backend of choice."""

from importlib import import_module
from typing import Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import NEAR_M
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput

Backend = Literal["cpu", "reference", "torch", "triton"]
# The module of each backend, imported on use: each brings its own heavy library.
MODULES = {
    "cpu": "rasterize_cpu",
    "reference": "rasterize_reference",
    "torch": "rasterize_gradient",
    "triton": "rasterize_triton",
}

THROUGH_LENSES = ("cpu", "triton")  # backends that draw what a camera with a lens sees


def rasterize(
    cloud: GaussianCloud,
    camera: PinholeCamera | LensCamera,
    background: Background = (0.0, 0.0, 0.0),
    backend: Backend = "cpu",
    *,
    near_m: float = NEAR_M,
) -> RasterOutput:
    """Render a cloud.

    Args:
        cloud: Gaussians in world coordinates.
        camera: From where; through a lens with ``cpu`` and ``triton`` alone.
        background: ``(r, g, b)`` or an ``(H, W, 3)`` image behind everything, 0..1.
        backend: ``cpu`` (fast), ``reference`` (float64, slow, the definition), ``torch``
            (that of the differentiable `rasterize_gradient`) or ``triton`` (GPU).
        near_m: Gaussians whose centre is nearer are left out.

    Returns:
        Colour, accumulated alpha and depth.

    Raises:
        InputError: Unknown backend, or a cloud or background that cannot be drawn.
        RendererError: Triton is not installed.
        InfrastructureError: There is no GPU; nothing falls back to another backend.

    Example:
        >>> import numpy as np
        >>> cloud = GaussianCloud([[0, 0, 5.0]], [[1.0, 0, 0, 0]], [[0.5, 0.5, 0.5]], [0.9], np.zeros((1, 1, 3)))
        >>> K = np.array([[30.0, 0, 16], [0, 30, 8], [0, 0, 1]])
        >>> out = rasterize(cloud, PinholeCamera(32, 16, K, np.eye(4)), backend="reference")
        >>> out.rgb.shape, round(float(out.depth[8, 16]), 3)
        ((16, 32, 3), 5.0)
    """
    if backend not in MODULES:
        raise InputError(
            f"backend {backend!r}: no such backend", f"choose one of {', '.join(MODULES)}"
        )
    if isinstance(camera, LensCamera) and backend not in THROUGH_LENSES:
        raise InputError(
            f"backend {backend!r}: draws pinholes alone, and this camera has a lens",
            f"use the backend {' or '.join(THROUGH_LENSES)}",
        )
    module = import_module(f"{__package__}.{MODULES[backend]}")
    return getattr(module, f"rasterize_{backend}")(cloud, camera, background, near_m=near_m)
