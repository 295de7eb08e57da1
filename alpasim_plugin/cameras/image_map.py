"""Lenses in the form that kernels compute: where a direction lies in the image, without trigonometry.

With n the length of a direction (x, y, z), h = (x, y) / (n + z), of length tan(angle / 2), and s =
|h|^2, a lens shows it at ``linear (g(s) h + bent) + middle``: g is a polynomial that is fitted to the
lens once. Up to `BEYOND_RAD` beyond what its image shows; farther out the distance from the middle
stays that of this limit, so that a polynomial which turns back brings nothing into the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.cameras.lens import RadialForm, radial_form, rays_of
from alpasim_plugin.core.types import F64, CameraSpec, LensModel

DEGREE = 9
NODES = 64
BEYOND_RAD = np.deg2rad(20.0)
FARTHEST_RAD = np.deg2rad(130.0)
BELOW_TURN = 0.9  # of the angle at which a lens turns back; an image may reach beyond it


@dataclass(frozen=True, eq=False)
class ImageMap:
    """Where a lens shows directions; see above.

    Attributes:
        middle: ``(2,)`` pixels.
        linear: ``(2, 2)``.
        polynomial: ``(DEGREE + 1,)`` of ``2 s / s_most - 1``, from the constant.
        s_most: Up to which s it holds.
        bent: See `lens.RadialForm`.
        error_px: By how much it misses the lens at most.
        px_per_rad: Least and most pixels per radian within the image.
        widest_rad: The largest angle from the axis that the image shows.
    """

    middle: F64
    linear: F64
    polynomial: F64
    s_most: float
    bent: tuple[float, ...]
    error_px: float
    px_per_rad: tuple[float, float]
    widest_rad: float


def with_lens(camera: CameraSpec) -> CameraSpec:
    """Return a camera that has a lens: a pinhole is an OpenCV lens without distortion."""
    if camera.lens is not None:
        return camera
    return CameraSpec(
        camera.name,
        camera.width,
        camera.height,
        camera.K,
        camera.T_rig_camera,
        camera.shutter_us,
        LensModel("opencv"),
        camera.interval_us,
    )


def image_map(camera: CameraSpec) -> ImageMap:
    """Return where a camera with a lens shows directions.

    Raises:
        InputError: Values that make no lens, or a lens that sees nothing.
    """
    form = radial_form(camera)
    widest = rays_of(camera).widest_rad
    turns_rad = max(BELOW_TURN * form.grows_to_rad, min(widest, form.grows_to_rad))
    limit = min(widest + BEYOND_RAD, FARTHEST_RAD, turns_rad)
    s_most = float(np.tan(limit / 2) ** 2)
    nodes = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    s = (nodes + 1) / 2 * s_most
    radius = form.radius(2 * np.arctan(np.sqrt(s)))
    series = np.polynomial.chebyshev.chebfit(nodes, radius / np.sqrt(s), DEGREE)
    missed = np.polynomial.chebyshev.chebval(nodes, series) * np.sqrt(s) - radius
    scale = float(np.linalg.norm(form.linear, 2))
    return ImageMap(
        np.asarray(camera.K[:2, 2], dtype=np.float64),
        np.asarray(form.linear, dtype=np.float64),
        np.asarray(np.polynomial.chebyshev.cheb2poly(series), dtype=np.float64),
        s_most,
        form.bent,
        1.5 * scale * float(np.abs(missed).max()),
        _resolution(form, widest),
        widest,
    )


def _resolution(form: RadialForm, widest: float) -> tuple[float, float]:
    """Return the least and most pixels per radian, along and across the radius."""
    angle = np.linspace(1e-3, widest, 256)
    radius = form.radius(angle)
    along = np.gradient(radius, angle)
    across = radius / np.sin(angle)
    sizes = np.linalg.svd(form.linear, compute_uv=False)
    least = float(sizes[-1] * min(along.min(), across.min()))
    return max(least, 1.0), float(sizes[0] * max(along.max(), across.max()))
