"""Projection by an f-theta lens as its publishers define it: what the camera fit and the map
drawing are held to.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import F64
from scenarios.ftheta import RecordedLens


def project_ftheta(camera: RecordedLens, points: F64) -> F64:
    """Project camera-frame points ``(N, 3)`` to pixels ``(N, 2)`` of the recorded image; NaN beyond
    the lens's largest angle.

    The radius comes from the forward polynomial, refined by Newton steps on the backward one where
    that is the calibrated side.
    """
    across = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(across, points[:, 2])
    radius = np.polynomial.Polynomial(camera.lens.angle_to_pixel)(theta)
    if camera.backward_given:
        poly = np.polynomial.Polynomial(camera.lens.pixel_to_angle)
        for _ in range(4):
            radius = radius - (poly(radius) - theta) / poly.deriv()(radius)
    unit = points[:, :2] / np.maximum(across, 1e-12)[:, None]
    pixels = unit * radius[:, None] + (camera.cx, camera.cy)
    return np.asarray(np.where((theta <= camera.lens.max_angle_rad)[:, None], pixels, np.nan))
