"""Cameras of the semantic map: pinhole and f-theta, as exact formulas and as the arrays that the kernels read.

Camera axes are x right, y down, z forward; pixel (row i, column j) covers columns j to j + 1 and rows i to i + 1. An f-theta lens images
a ray at angle theta from the axis at distance r(theta) from the principal point, and the pixel is ``centre + A @ (r * direction)`` with a
2 x 2 matrix A; beyond the lens's largest angle r goes on in a straight line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, CameraSpec, FTheta

TABLE = 4096  # angles of the radius table; linear interpolation errs by less than 1e-4 px
_BEYOND_RAD = 0.05  # part of the table beyond the largest angle


@dataclass(frozen=True)
class FThetaCamera:
    """An f-theta camera: image size, principal point in image pixels, lens, and the matrix that takes lens pixels to image pixels."""

    name: str
    width: int
    height: int
    cx: float
    cy: float
    lens: FTheta
    calibrated: Literal["pixel_to_angle", "angle_to_pixel"] = "angle_to_pixel"  # the calibrated polynomial; the other is its fit
    A: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))

    def resized(self, width: int, height: int) -> FThetaCamera:
        """Return the camera of the same image resized to ``width`` x ``height``."""
        sx, sy = width / self.width, height / self.height
        (a, b), (c, d) = self.A
        scaled = ((a * sx, b * sx), (c * sy, d * sy))
        return FThetaCamera(self.name, width, height, self.cx * sx, self.cy * sy, self.lens, self.calibrated, scaled)


MapCamera = CameraSpec | FThetaCamera


def radius_of(camera: FThetaCamera, theta: F64) -> F64:
    """Return radii, lens pixels, of angles from the axis, radians; Newton's method where the calibrated polynomial is the inverse.

    Raises:
        InputError: The lens has no largest angle, or its radius does not grow up to there.
    """
    top = camera.lens.max_angle_rad
    if not np.isfinite(top) or not 0.0 < top < np.pi:
        raise _no_lens(camera, f"largest angle {top!r} rad")
    inside = np.minimum(theta, top)
    with np.errstate(all="ignore"):
        radius = _inside(camera, inside)
        h = 1e-5 * top
        slope = (_inside(camera, np.array([top])) - _inside(camera, np.array([top - h])))[0] / h
    out = radius + np.maximum(theta - top, 0.0) * max(slope, 0.0)
    if not np.isfinite(out).all():
        raise _no_lens(camera, "a radius that is not finite")
    return np.asarray(out, dtype=np.float64)


def _inside(camera: FThetaCamera, theta: F64) -> F64:
    radius = np.polynomial.polynomial.polyval(theta, np.array(camera.lens.angle_to_pixel))
    if camera.calibrated == "pixel_to_angle":
        poly = np.polynomial.Polynomial(camera.lens.pixel_to_angle)
        slope = poly.deriv()
        for _ in range(6):
            radius = radius - (poly(radius) - theta) / slope(radius)
    return np.asarray(radius, dtype=np.float64)


@dataclass(frozen=True)
class KernelCamera:
    """A camera as arrays for the kernels."""

    params: F64  # (9,) is_ftheta, A00 or fx, A01 or skew, A10, A11 or fy, cx, cy, table entries per radian, table's last angle
    table: F64  # (TABLE + 1,) radii; one entry for a pinhole
    half_angle_rad: float  # largest angle of a pixel from the axis


def kernel_camera(camera: MapCamera) -> KernelCamera:
    """Return a camera as the kernels read it; f-theta lenses are cached.

    Raises:
        InputError: An image without pixels, intrinsics without positive focal lengths, or a lens whose radius does not grow.
    """
    if camera.width < 1 or camera.height < 1:
        size = f"{camera.width} x {camera.height} pixels"
        raise InputError("drawing the semantic map", f"camera {camera.name}", size, "give at least one")
    if isinstance(camera, FThetaCamera):
        return _ftheta(camera)
    k = np.asarray(camera.K, dtype=np.float64)
    if k.shape != (3, 3) or not np.isfinite(k).all() or k[0, 0] <= 0 or k[1, 1] <= 0:
        found = np.array2string(k, separator=", ").replace("\n", "")
        raise InputError("drawing the semantic map", f"camera {camera.name}", f"K = {found}", "give intrinsics with positive focal lengths")
    corners = np.array([[u, v, 1.0] for u in (0, camera.width) for v in (0, camera.height)]) @ np.linalg.inv(k).T
    half = float(np.arctan(np.hypot(corners[:, 0], corners[:, 1]).max()))
    params = np.array([0.0, k[0, 0], k[0, 1], 0.0, k[1, 1], k[0, 2], k[1, 2], 0.0, 0.0])
    return KernelCamera(params, np.zeros(1), half)


@cache
def _ftheta(camera: FThetaCamera) -> KernelCamera:
    A = np.array(camera.A, dtype=np.float64)
    if A.shape != (2, 2) or not np.isfinite(A).all() or abs(np.linalg.det(A)) < 1e-9 or not np.isfinite([camera.cx, camera.cy]).all():
        raise _no_lens(camera, f"centre ({camera.cx}, {camera.cy}), A = {camera.A}")
    top = camera.lens.max_angle_rad
    last = min(top + _BEYOND_RAD, np.pi)
    angles = np.linspace(0.0, last, TABLE + 1)
    radii = radius_of(camera, angles)
    if not (np.diff(radii[angles <= top]) > 0).all():
        raise _no_lens(camera, "a radius that does not grow up to its largest angle")
    corners = np.array([[u, v] for u in (0, camera.width) for v in (0, camera.height)]) - (camera.cx, camera.cy)
    reach = float(np.linalg.norm(corners @ np.linalg.inv(A).T, axis=1).max())
    beyond = (reach - radii[-1]) / max((radii[-1] - radii[-2]) / (angles[-1] - angles[-2]), 1e-9)
    half = float(np.interp(reach, radii, angles)) if reach <= radii[-1] else min(float(last + beyond), np.pi)
    params = np.array([1.0, *A.ravel(), camera.cx, camera.cy, TABLE / last, last])
    return KernelCamera(params, radii, half)


def _no_lens(camera: FThetaCamera, found: str) -> InputError:
    do_this = "give a lens whose radius grows up to max_angle_rad"
    return InputError("drawing the semantic map", f"f-theta camera {camera.name}", found, do_this)
