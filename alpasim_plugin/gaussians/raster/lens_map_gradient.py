"""Where a lens shows points and how its image changes there, with torch's graph: `lens_map_kernels` for
the fit. Vectors are tensors ``(3, N)`` float64 in the camera's axes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from alpasim_plugin.cameras.image_map import DEGREE
from alpasim_plugin.core.types import F64
from alpasim_plugin.gaussians.raster.lens_map_kernels import LEAST_SLOPE
from alpasim_plugin.gaussians.raster.lens_rays import (
    LENS_BENDS,
    LENS_G,
    LENS_LINEAR,
    LENS_MIDDLE,
    LENS_S_MOST,
    LENS_SLOPE,
)


class LensPlace(NamedTuple):
    """Where a lens shows points, and how its image changes there.

    Attributes:
        uv: ``(2, N)`` pixels.
        slopes: ``(2, 2, N)`` pixels per radian: the derivative of u and v by the steps right and
            down across the line of sight.
        right, down: ``(3, N)`` these two directions.
        distance: ``(N,)`` metres.
    """

    uv: Tensor
    slopes: Tensor
    right: Tensor
    down: Tensor
    distance: Tensor


def lens_place(lens: F64, p: Tensor) -> LensPlace:
    """Return where a lens shows points ``(3, N)``; see `lens_map_kernels` and `cameras.image_map`.

    Args:
        lens: ``(LENS_SIZE,)``.
        p: Points.
    """
    n = p.square().sum(dim=0).sqrt()
    hx, hy = p[:2] / torch.maximum(n + p[2], 1e-6 * n)
    s = hx * hx + hy * hy
    held = s.clamp(max=lens[LENS_S_MOST])
    shrink = (held / s.clamp(min=1e-30)).sqrt()
    x = hx * shrink
    y = hy * shrink
    g = _polynomial(lens, LENS_G, DEGREE, held)
    slope = 2 * _polynomial(lens, LENS_SLOPE, DEGREE - 1, held)
    slope = torch.maximum(slope, (LEAST_SLOPE - 1) * g / held.clamp(min=1e-12))
    plane = torch.stack([x * g, y * g])
    mixed = slope * x * y
    by_h = torch.stack(
        [torch.stack([g + slope * x * x, mixed]), torch.stack([mixed, g + slope * y * y])]
    )
    if lens[LENS_BENDS] > 0:
        bent, bent_by_h = _bent(lens, x, y, held)
        plane = plane + bent
        by_h = by_h + bent_by_h
    linear = p.new_tensor(lens[LENS_LINEAR : LENS_LINEAR + 4]).reshape(2, 2)
    middle = p.new_tensor(lens[LENS_MIDDLE : LENS_MIDDLE + 2])[:, None]
    uv = linear @ plane + middle
    slopes = 0.5 * (1 + held) * torch.einsum("ij,jkn->ikn", linear, by_h)
    right, down = _tangents(p, n)
    return LensPlace(uv, slopes, right, down, n)


def _polynomial(lens: F64, first: int, degree: int, s: Tensor) -> Tensor:
    x = s * (2 / float(lens[LENS_S_MOST])) - 1
    value = torch.full_like(x, float(lens[first + degree]))
    for k in range(degree - 1, -1, -1):
        value = value * x + float(lens[first + k])
    return value


def _bent(lens: F64, hx: Tensor, hy: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
    """Return what the tangential and thin prism terms add ``(2, N)``, and its derivative by h."""
    p1, p2, s1, s2, s3, s4 = lens[LENS_BENDS + 1 : LENS_BENDS + 7].tolist()
    t = 2 / (1 - held)
    x = hx * t
    y = hy * t
    r2 = x * x + y * y
    bent_x = r2 * (s1 + s2 * r2) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = r2 * (s3 + s4 * r2) + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    fx = 2 * s1 + 4 * s2 * r2
    fy = 2 * s3 + 4 * s4 * r2
    by_tangents = torch.stack(
        [
            torch.stack([2 * p1 * y + 6 * p2 * x + fx * x, 2 * p1 * x + 2 * p2 * y + fx * y]),
            torch.stack([2 * p1 * x + 2 * p2 * y + fy * x, 6 * p1 * y + 2 * p2 * x + fy * y]),
        ]
    )
    # of the tangents by h: t I + t^2 h h^T
    mixed = x * y
    of_h = torch.stack([torch.stack([t + x * x, mixed]), torch.stack([mixed, t + y * y])])
    return torch.stack([bent_x, bent_y]), torch.einsum("ijn,jkn->ikn", by_tangents, of_h)


def _tangents(p: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors across the directions of points, along h's axes."""
    hx, hy = p[:2] / torch.maximum(n + p[2], 1e-7 * n)
    k = 2 / (1 + hx * hx + hy * hy)
    mixed = -k * hx * hy
    right = torch.stack([1 - k * hx * hx, mixed, -k * hx])
    down = torch.stack([mixed, 1 - k * hy * hy, -k * hy])
    return right, down
