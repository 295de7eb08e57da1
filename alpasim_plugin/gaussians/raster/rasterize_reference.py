"""Project and composite Gaussians in float64, one after the other: the readable reference
implementation for the fast backends.

Zwicker et al., EWA Splatting (2002), with the first-order projection of Kerbl et al., 3D Gaussian
Splatting (2023), and the constants of `alpasim_plugin.gaussians.constants`; the 2D filter of
antialiased models is that of Yu et al., Mip-Splatting (2024), equation 10.
"""

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import unit
from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    EPS2D_PX2,
    EXTENT_MAX_SIGMA,
    FAR_M,
    NEAR_M,
    TRANSMITTANCE_STOP,
)
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image
from alpasim_plugin.gaussians.sh import sh_colours


@dataclass(frozen=True, eq=False)
class Projection:
    """Screen-space Gaussians in the order in which they are drawn, nearest first.

    Attributes:
        index: ``(M,)`` position in the cloud.
        uv: ``(M, 2)`` centres, pixels (column, row).
        depth: ``(M,)`` metres along the optical axis.
        cov: ``(M, 3)`` screen covariance with the low-pass added, pixels^2: C11, C12, C22.
        det: ``(M,)`` its determinant, pixels^4.
        extent: ``(M,)`` standard deviations beyond which alpha is below the cut.
        opacity: ``(M,)``.
        rgb: ``(M, 3)`` colour from the camera's side, clamped at 0 below.
    """

    index: I64
    uv: F64
    depth: F64
    cov: F64
    det: F64
    extent: F64
    opacity: F64
    rgb: F64

    def __len__(self) -> int:
        """Return M."""
        return len(self.index)

    def radii(self) -> F64:
        """Return ``(M, 2)`` half sizes, pixels, of the box around the ellipse at `extent`."""
        return self.extent[:, None] * np.sqrt(self.cov[:, [0, 2]])


def project_gaussians(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    near_m: float = NEAR_M,
) -> Projection:
    """Project a cloud and sort it by depth.

    Dropped: centres nearer than ``near_m`` or beyond 1e10 m and opacities below 1/255. Depth order is that of
    the float32 depths, ties in input order: two surfaces that coincide then keep one order while
    the camera moves, instead of one decided by rounding.

    Raises:
        InputError: The cloud holds Gaussians that cannot be drawn.
    """
    cloud.require_drawable()
    T = camera.T_camera_world
    # Subtracting the camera's centre first keeps UTM-sized coordinates exact: the difference is
    # small and rounds once.
    relative = cloud.means.astype(np.float64) - camera.centre_world
    p = relative @ T[:3, :3].T
    opacity = cloud.opacities.astype(np.float64)
    index = np.flatnonzero((p[:, 2] >= near_m) & (p[:, 2] <= FAR_M) & (opacity >= ALPHA_MIN))
    cloud = cloud.take(index)
    p = p[index]
    relative = relative[index]
    opacity = opacity[index]
    x, y, z = p.T

    jacobian = _jacobian(p, camera)
    # With rows m, n of M = J R_camera R_q diag(s) the covariance is M M^T and its determinant a sum
    # of squares (Cauchy-Binet), which cannot cancel for needles as C11 C22 - C12^2 does.
    m, n = np.moveaxis(
        jacobian @ T[:3, :3] @ cloud.rotations() * cloud.scales.astype(np.float64)[:, None, :], 1, 0
    )
    raw = np.column_stack([np.sum(m * m, axis=1), np.sum(m * n, axis=1), np.sum(n * n, axis=1)])
    eps = cloud.antialias_px2 or EPS2D_PX2
    cov = raw + np.array([eps, 0.0, eps])
    raw_det = np.sum(np.cross(m, n) ** 2, axis=1)
    det = raw_det + eps * (raw[:, 0] + raw[:, 2]) + eps**2
    if cloud.antialias_px2:
        opacity = opacity * np.sqrt(raw_det / det)
    extent = np.minimum(EXTENT_MAX_SIGMA, np.sqrt(2 * np.log(np.maximum(opacity / ALPHA_MIN, 1.0))))
    uv = np.column_stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])

    order = np.argsort(z.astype(np.float32), kind="stable")
    direction = unit(relative[order])
    return Projection(
        index[order],
        uv[order],
        z[order],
        cov[order],
        det[order],
        extent[order],
        opacity[order],
        sh_colours(cloud.sh[order], direction),
    )


def _jacobian(p: F64, camera: PinholeCamera) -> F64:
    """Return the projection's derivative ``(N, 2, 3)``, pixels a metre, at points ``(N, 3)`` of the
    camera's frame; slopes beyond the image's surroundings are clamped.
    """
    x, y, z = p.T
    low_x, high_x, low_y, high_y = camera.slope_limits()
    zero = np.zeros_like(z)
    rows = (
        [camera.fx / z, zero, -camera.fx * np.clip(x / z, low_x, high_x) / z],
        [zero, camera.fy / z, -camera.fy * np.clip(y / z, low_y, high_y) / z],
    )
    return np.moveaxis(np.array(rows), 2, 0)


def rasterize_reference(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    brute: bool = False,
) -> RasterOutput:
    """Render by the definition: every Gaussian in depth order, over all of its pixels.

    Args:
        cloud: What to draw.
        camera: From where.
        background: ``(r, g, b)`` or an ``(H, W, 3)`` image behind everything.
        near_m: Gaussians whose centre is nearer are left out.
        brute: Evaluate all pixels of the image for each Gaussian. By default only the box around
            its ellipse (grown by a pixel) is evaluated; outside of it alpha is below the cut, so
            the image is the same and large clouds stay affordable.

    Raises:
        InputError: The cloud holds Gaussians that cannot be drawn, or the background does not fit.
    """
    splats = project_gaussians(cloud, camera, near_m)
    behind = background_image(background, camera).astype(np.float64)
    colour, alpha, depth = composite_reference(splats, camera, behind, brute)
    return RasterOutput(
        np.clip(colour, 0, 1).astype(np.float32),
        alpha.astype(np.float32),
        depth.astype(np.float32),
    )


def composite_reference(
    splats: Projection, camera: PinholeCamera, behind: F64, brute: bool = False
) -> tuple[F64, F64, F64]:
    """Blend projected Gaussians, nearest first, in float64.

    Args:
        splats: In the order in which they are drawn.
        camera: Gives the image's size.
        behind: ``(H, W, 3)`` or ``(1, 1, 3)`` background.
        brute: See `rasterize_reference`.

    Returns:
        Colour ``(H, W, 3)`` with background, not clamped; alpha ``(H, W)``; depth ``(H, W)``,
        metres, 0 where alpha is 0.
    """
    height = camera.height
    width = camera.width
    rows = np.arange(height) + 0.5
    columns = np.arange(width) + 0.5
    colour = np.zeros((height, width, 3))
    depth_sum = np.zeros((height, width))
    transmittance = np.ones((height, width))
    finished = np.zeros((height, width), dtype=bool)
    first = np.clip(np.floor(splats.uv - splats.radii()) - 1, 0, [width, height]).astype(int)
    last = np.clip(np.ceil(splats.uv + splats.radii()) + 1, 0, [width, height]).astype(int)

    for i in range(len(splats)):
        box = (
            (slice(0, height), slice(0, width))
            if brute
            else (slice(first[i, 1], last[i, 1]), slice(first[i, 0], last[i, 0]))
        )
        dx = columns[None, box[1]] - splats.uv[i, 0]
        dy = rows[box[0], None] - splats.uv[i, 1]
        if dx.size == 0 or dy.size == 0:
            continue
        c11, c12, c22 = splats.cov[i]
        distance2 = (c22 * dx * dx - 2 * c12 * dx * dy + c11 * dy * dy) / splats.det[i]
        alpha = np.minimum(ALPHA_MAX, splats.opacity[i] * np.exp(-0.5 * distance2))
        visible = (alpha >= ALPHA_MIN) & ~finished[box]
        after = transmittance[box] * (1 - alpha)
        # This splat is left out, and so is everything behind it.
        stops = visible & (after <= TRANSMITTANCE_STOP)
        finished[box] |= stops
        visible &= ~stops
        weight = np.where(visible, alpha * transmittance[box], 0.0)
        colour[box] += weight[:, :, None] * splats.rgb[i]
        depth_sum[box] += weight * splats.depth[i]
        transmittance[box] = np.where(visible, after, transmittance[box])

    alpha_total = 1 - transmittance
    depth = np.divide(depth_sum, alpha_total, out=np.zeros_like(depth_sum), where=alpha_total > 0)
    return colour + transmittance[:, :, None] * behind, alpha_total, depth
