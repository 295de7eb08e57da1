"""Composite Gaussians in float64, one after the other: the reference implementation for the fast backends.

Kerbl et al., 3D Gaussian Splatting (2023), with the constants of `alpasim_plugin.gaussians.constants`.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import ALPHA_MAX, ALPHA_MIN, NEAR_M, TRANSMITTANCE_STOP
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image
from alpasim_plugin.gaussians.raster.project import Projection, project_gaussians


def rasterize_reference(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    lod_px: float = 0.0,
    brute: bool = False,
) -> RasterOutput:
    """Render by the definition: every Gaussian in depth order, over all of its pixels.

    Args:
        cloud: What to draw.
        camera: From where.
        background: ``(r, g, b)`` or an ``(H, W, 3)`` image behind everything.
        near_m: Gaussians whose centre is nearer are left out.
        lod_px: Gaussians whose radius before the low-pass is smaller are left out; 0 draws all.
        brute: Evaluate all pixels of the image for each Gaussian. By default only the box around its ellipse (grown by a pixel) is
            evaluated; outside of it alpha is below the cut, so the image is the same and large clouds stay affordable.

    Raises:
        InputError: The cloud holds Gaussians that cannot be drawn, or the background does not fit.
    """
    splats = project_gaussians(cloud, camera, near_m, lod_px)
    behind = background_image(background, camera).astype(np.float64)
    colour, alpha, depth, blends = composite_reference(splats, camera, behind, brute)
    stats = {"gaussians": len(cloud), "visible": len(splats), "blends": blends}
    return RasterOutput(np.clip(colour, 0, 1).astype(np.float32), alpha.astype(np.float32), depth.astype(np.float32), stats)


def composite_reference(splats: Projection, camera: PinholeCamera, behind: F64, brute: bool = False) -> tuple[F64, F64, F64, int]:
    """Blend projected Gaussians, nearest first, in float64.

    Args:
        splats: In the order in which they are drawn.
        camera: Gives the image's size.
        behind: ``(H, W, 3)`` or ``(1, 1, 3)`` background.
        brute: See `rasterize_reference`.

    Returns:
        Colour ``(H, W, 3)`` with background, not clamped; alpha ``(H, W)``; depth ``(H, W)``, metres, 0 where alpha is 0; how many splats
        were blended into a pixel, over all pixels.
    """
    height, width = camera.height, camera.width
    rows, columns = np.arange(height) + 0.5, np.arange(width) + 0.5
    colour = np.zeros((height, width, 3))
    depth_sum = np.zeros((height, width))
    transmittance = np.ones((height, width))
    finished = np.zeros((height, width), dtype=bool)
    blends = 0
    first = np.clip(np.floor(splats.uv - splats.radii()) - 1, 0, [width, height]).astype(int)
    last = np.clip(np.ceil(splats.uv + splats.radii()) + 1, 0, [width, height]).astype(int)

    for i in range(len(splats)):
        box = (slice(0, height), slice(0, width)) if brute else (slice(first[i, 1], last[i, 1]), slice(first[i, 0], last[i, 0]))
        dx = columns[None, box[1]] - splats.uv[i, 0]
        dy = rows[box[0], None] - splats.uv[i, 1]
        if dx.size == 0 or dy.size == 0:
            continue
        c11, c12, c22 = splats.cov[i]
        distance2 = (c22 * dx * dx - 2 * c12 * dx * dy + c11 * dy * dy) / splats.det[i]
        alpha = np.minimum(ALPHA_MAX, splats.opacity[i] * np.exp(-0.5 * distance2))
        drawn = (alpha >= ALPHA_MIN) & ~finished[box]
        after = transmittance[box] * (1 - alpha)
        stops = drawn & (after <= TRANSMITTANCE_STOP)  # this splat is left out, and so is everything behind it
        finished[box] |= stops
        drawn &= ~stops
        blends += int(np.count_nonzero(drawn))
        weight = np.where(drawn, alpha * transmittance[box], 0.0)
        colour[box] += weight[:, :, None] * splats.rgb[i]
        depth_sum[box] += weight * splats.depth[i]
        transmittance[box] = np.where(drawn, after, transmittance[box])

    alpha_total = 1 - transmittance
    depth = np.divide(depth_sum, alpha_total, out=np.zeros_like(depth_sum), where=alpha_total > 0)
    return colour + transmittance[:, :, None] * behind, alpha_total, depth, blends
