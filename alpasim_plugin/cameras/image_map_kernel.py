"""Where a lens shows a point, one at a time: the form of `cameras.image_map`."""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import math

import numpy as np

from alpasim_plugin.cameras.image_map import DEGREE, ImageMap
from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.core.types import F64

# Entries: the middle, the linear part, s_most, the terms beside the radius, the polynomial.
MIDDLE, LINEAR, S_MOST, BENT, POLYNOMIAL = 0, 2, 6, 7, 13
MAP_SIZE = POLYNOMIAL + DEGREE + 1


def map_numbers(lens_map: ImageMap) -> F64:
    """Return where a lens shows directions ``(MAP_SIZE,)`` as `lens_pixel` reads it."""
    numbers = np.zeros(MAP_SIZE)
    numbers[MIDDLE : MIDDLE + 2] = lens_map.middle
    numbers[LINEAR : LINEAR + 4] = lens_map.linear.ravel()
    numbers[S_MOST] = lens_map.s_most
    numbers[BENT : BENT + 6] = lens_map.bent
    numbers[POLYNOMIAL : POLYNOMIAL + DEGREE + 1] = lens_map.polynomial
    return numbers


@kernel
def lens_pixel(lens, x, y, z):
    """Return the pixel (u, v) of a point, with the ray held to where the lens is described; see
    `cameras.image_map`.
    """
    n = math.sqrt(x * x + y * y + z * z)
    inverse = 1.0 / max(n + z, 1e-9 * n + 1e-30)
    hx = x * inverse
    hy = y * inverse
    s = hx * hx + hy * hy
    if s > lens[S_MOST]:
        shrink = math.sqrt(lens[S_MOST] / s)
        hx *= shrink
        hy *= shrink
        s = lens[S_MOST]
    t = 2.0 * s / lens[S_MOST] - 1.0
    g = lens[POLYNOMIAL + DEGREE]
    for k in range(DEGREE - 1, -1, -1):
        g = g * t + lens[POLYNOMIAL + k]
    px = g * hx
    py = g * hy
    if lens[BENT : BENT + 6].any():
        k = 2.0 / (1.0 - s)
        ax = hx * k
        ay = hy * k
        r2 = ax * ax + ay * ay
        p1, p2 = lens[BENT], lens[BENT + 1]
        px += 2.0 * p1 * ax * ay + p2 * (r2 + 2.0 * ax * ax)
        px += r2 * (lens[BENT + 2] + r2 * lens[BENT + 3])
        py += p1 * (r2 + 2.0 * ay * ay) + 2.0 * p2 * ax * ay
        py += r2 * (lens[BENT + 4] + r2 * lens[BENT + 5])
    u = lens[LINEAR] * px + lens[LINEAR + 1] * py + lens[MIDDLE]
    v = lens[LINEAR + 2] * px + lens[LINEAR + 3] * py + lens[MIDDLE + 1]
    return u, v
