"""Projection by an f-theta lens as its publishers define it: what the camera fit and the map
drawing are held to.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FTheta:
    """Polynomials of an f-theta lens: theta = sum b_k r^k and r = sum a_k theta^k, pixels and
    radians.
    """

    pixel_to_angle: tuple[float, ...]
    angle_to_pixel: tuple[float, ...]
    max_angle_rad: float = 0.0


@dataclass(frozen=True)
class RecordedLens:
    """An f-theta lens as calibrated: principal point and size in pixels of the recorded image, and
    both polynomials.
    """

    cx: float
    cy: float
    width: int
    height: int
    lens: FTheta
    backward_given: (
        bool  # the file's polynomial maps pixels to angle; the other direction is fitted
    )


def lens_of(values):
    """Make a lens of its calibration; the direction that is not given is fitted over the image.

    Args:
        values: ``(11,)``: cx, cy, width, height in pixels, six coefficients from the constant
            upwards, and a flag: 1 where they map pixel radius to angle (rad), 0 where they map
            angle to radius.
    """
    cx, cy, width, height = values[:4]
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) - (cx, cy)
    reach_px = float(np.linalg.norm(corners, axis=1).max())
    given = values[4:10]
    backward = bool(values[10] == 1.0)
    if backward:
        radius = np.linspace(0.0, reach_px, 2000)
        angle = _polynomial(radius, given)
        top = int(np.argmax(angle))  # a polynomial may turn over beyond the image's corners
        radius = radius[: top + 1]
        angle = angle[: top + 1]
        lens = FTheta(tuple(given.tolist()), tuple(_fit(angle, radius).tolist()), float(angle[-1]))
    else:
        angle = np.linspace(0.0, np.pi / 2, 4000)
        radius = _polynomial(angle, given)
        inside = np.nonzero(np.maximum.accumulate(radius) > reach_px)[0]
        rising = np.nonzero(np.diff(radius) <= 0)[0]
        end = int(min([len(angle), *inside[:1] + 1, *rising[:1] + 1]))
        angle = angle[:end]
        radius = radius[:end]
        lens = FTheta(tuple(_fit(radius, angle).tolist()), tuple(given.tolist()), float(angle[-1]))
    return RecordedLens(float(cx), float(cy), int(width), int(height), lens, backward)


def _polynomial(x, coefficients):
    return np.asarray(np.polynomial.polynomial.polyval(x, coefficients), dtype=np.float64)


def _fit(x, y):
    """Return six coefficients of the least-squares inverse through the origin (constant term
    zero).
    """
    scale = x[-1]
    powers = np.stack([(x / scale) ** k for k in range(1, 6)], axis=1)
    coefficients = np.linalg.lstsq(powers, y, rcond=None)[0]
    return np.concatenate([[0.0], coefficients / scale ** np.arange(1, 6)])


def project_ftheta(camera, points):
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
