"""Render with plain torch operations, differentiable with respect to every Gaussian parameter and
the camera pose.

Meant for gradients on scenes of moderate size (fitting, refinement, tests), on any device.
Thresholds cut the gradient where they cut the image: nothing flows through skipped or saturated
pixels, which is also what GPU rasterisers do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

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
from alpasim_plugin.gaussians.sh import C0, sh_terms

_TILE_PX = 16


@dataclass(frozen=True, eq=False)
class GaussianTensors:
    """The fields of `GaussianCloud` as tensors on one device; any of them may require gradients.

    Attributes:
        means: ``(N, 3)``; keep float64 where coordinates are large.
        quats: ``(N, 4)`` wxyz.
        scales: ``(N, 3)`` linear.
        opacities: ``(N,)`` linear.
        sh: ``(N, K, 3)``.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

    @classmethod
    def from_cloud(
        cls, cloud: GaussianCloud, dtype: torch.dtype = torch.float32, device: str = "cpu"
    ) -> GaussianTensors:
        """Copy a cloud; means stay float64."""
        rest = (
            torch.as_tensor(np.array(a), dtype=dtype, device=device)
            for a in (cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
        )
        return cls(
            torch.as_tensor(np.array(cloud.means), dtype=torch.float64, device=device), *rest
        )


@dataclass(frozen=True, eq=False)
class RasterTensors:
    """One rendered view with its graph: rgb ``(H, W, 3)`` not clamped above, alpha ``(H, W)``,
    depth ``(H, W)`` (0 where alpha is 0).
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor


@dataclass(frozen=True, eq=False)
class _Splats:
    uv: Tensor  # (M, 2)
    cov: Tensor  # (M, 3): C11, C12, C22 with the low-pass
    det: Tensor  # (M,)
    radii: Tensor  # (M, 2), no gradient
    opacity: Tensor  # (M,)
    features: Tensor  # (M, 4): red, green, blue, depth


def rasterize_tensors(
    gaussians: GaussianTensors,
    camera: PinholeCamera,
    background: Tensor | None = None,
    *,
    near_m: float = NEAR_M,
    lod_px: float = 0.0,
    T_camera_world: Tensor | None = None,
) -> RasterTensors:
    """Render tensors by the rule of `rasterize_reference`, in the precision of ``gaussians.sh``.

    Args:
        gaussians: What to draw.
        camera: Size, intrinsics and, unless given apart, pose.
        background: ``(3,)`` or ``(H, W, 3)``; None is black.
        near_m: Gaussians whose centre is nearer are left out.
        lod_px: Gaussians whose radius before the low-pass is smaller are left out; 0 draws all.
        T_camera_world: ``(4, 4)`` float64 pose that replaces the camera's, for gradients of the
            pose.

    Returns:
        The image tensors; memory grows with the number of (splat, tile) pairs while gradients are
        recorded.
    """
    splats = _project(gaussians, camera, near_m, lod_px, T_camera_world)
    dtype, device = gaussians.sh.dtype, gaussians.sh.device
    behind = (
        torch.zeros(3, dtype=dtype, device=device)
        if background is None
        else background.to(device, dtype)
    )
    behind = behind.expand(camera.height, camera.width, 3)
    # Boxes grown by a pixel, in the order of depth; each tile takes its part of its row's part.
    low, high = splats.uv.detach() - splats.radii - 1.0, splats.uv.detach() + splats.radii + 1.0
    rows = []
    for top in range(0, camera.height, _TILE_PX):
        bottom = min(top + _TILE_PX, camera.height)
        row = torch.nonzero((high[:, 1] >= top) & (low[:, 1] <= bottom))[:, 0]
        row_low, row_high = low[row, 0], high[row, 0]
        tiles = []
        for left in range(0, camera.width, _TILE_PX):
            right = min(left + _TILE_PX, camera.width)
            index = row[(row_high >= left) & (row_low <= right)]
            tiles.append(_composite(splats, index, (left, right), (top, bottom), behind))
        rows.append(torch.cat(tiles, dim=1))
    image = torch.cat(rows, dim=0)
    alpha = image[..., 4]
    depth = torch.where(alpha > 0, image[..., 3] / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return RasterTensors(image[..., :3], alpha, depth)


def _project(
    g: GaussianTensors,
    camera: PinholeCamera,
    near_m: float,
    lod_px: float,
    T_camera_world: Tensor | None,
) -> _Splats:
    """Project, drop and sort, as `project_gaussians` does."""
    dtype, device = g.sh.dtype, g.sh.device
    T = (
        torch.as_tensor(camera.T_camera_world, device=device)
        if T_camera_world is None
        else T_camera_world.double()
    )
    # Differences of large coordinates in float64, the rest in the caller's precision.
    relative = g.means.double() + T[:3, :3].T @ T[:3, 3]
    p64 = relative @ T[:3, :3].T
    drawable = (p64[:, 2] >= near_m) & (p64[:, 2] <= FAR_M) & (g.opacities >= ALPHA_MIN)
    index = torch.nonzero(drawable)[:, 0]
    p = p64[index].to(dtype)
    relative = relative[index].to(dtype)
    rotation = T[:3, :3].to(dtype)
    x, y, z = p.unbind(1)
    low_x, high_x, low_y, high_y = camera.slope_limits()
    j0 = (camera.fx / z)[:, None] * (
        rotation[0] - (x / z).clamp(low_x, high_x)[:, None] * rotation[2]
    )
    j1 = (camera.fy / z)[:, None] * (
        rotation[1] - (y / z).clamp(low_y, high_y)[:, None] * rotation[2]
    )
    factor = _rotations(g.quats[index].to(dtype)) * g.scales[index].to(dtype)[:, None, :]
    m, n = (j0[:, None, :] @ factor)[:, 0], (j1[:, None, :] @ factor)[:, 0]
    mm = (m * m).sum(1)
    mn = (m * n).sum(1)
    nn = (n * n).sum(1)
    cov = torch.stack([mm + EPS2D_PX2, mn, nn + EPS2D_PX2], dim=1)
    det = torch.linalg.cross(m, n).square().sum(1) + EPS2D_PX2 * (mm + nn) + EPS2D_PX2**2
    opacity = g.opacities[index].to(dtype)
    extent = torch.sqrt(2 * torch.log((opacity.detach() / ALPHA_MIN).clamp(min=1.0))).clamp(
        max=EXTENT_MAX_SIGMA
    )
    uv = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    colours = sh_colours_torch(g.sh[index], torch.nn.functional.normalize(relative, dim=1))

    keep = extent * torch.sqrt(torch.maximum(mm, nn).detach()) >= lod_px
    order = torch.nonzero(keep)[:, 0]
    order = order[torch.argsort(p64[index][order, 2].detach().float(), stable=True)]
    radii = extent[:, None] * cov.detach()[:, [0, 2]].sqrt()
    features = torch.cat([colours, z[:, None]], dim=1)
    return _Splats(uv[order], cov[order], det[order], radii[order], opacity[order], features[order])


def _composite(
    splats: _Splats, i: Tensor, columns: tuple[int, int], rows: tuple[int, int], behind: Tensor
) -> Tensor:
    """Return a tile ``(h, w, 5)`` of the splats at ``i``: colour with background, depth sum,
    alpha.
    """
    uv = splats.uv
    x = torch.arange(*columns, dtype=uv.dtype, device=uv.device) + 0.5
    y = torch.arange(*rows, dtype=uv.dtype, device=uv.device) + 0.5
    dx = (x[None, None, :] - splats.uv[i, 0, None, None]).expand(-1, len(y), -1)
    dy = (y[None, :, None] - splats.uv[i, 1, None, None]).expand(-1, -1, len(x))
    c12, c22 = splats.cov[i, 1, None, None], splats.cov[i, 2, None, None]
    # The distance as a sum of squares, the x part given y: exact for needles in float32, where the
    # usual quadratic form cancels.
    distance2 = (dx - c12 / c22 * dy).square() * (
        c22 / splats.det[i, None, None]
    ) + dy.square() / c22
    alpha = (splats.opacity[i, None, None] * torch.exp(-0.5 * distance2)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    after = torch.cumprod(1 - alpha, dim=0)
    # The running product never grows, so "this splat would cross the stop" is also true for all
    # behind it.
    drawn = after > TRANSMITTANCE_STOP
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weight = torch.where(drawn, alpha * before, 0.0)
    sums = torch.einsum("nhw,nc->hwc", weight, splats.features[i])
    total = weight.sum(dim=0)[..., None]
    colour = sums[..., :3] + (1 - total) * behind[slice(*rows), slice(*columns)]
    return torch.cat([colour, sums[..., 3:], total], dim=2)


def _rotations(quats: Tensor) -> Tensor:
    """Return rotation matrices ``(N, 3, 3)`` of quaternions ``(N, 4)`` of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(entries, dim=1).reshape(-1, 3, 3)


def sh_colours_torch(sh: Tensor, directions: Tensor) -> Tensor:
    """Return RGB ``(N, 3)`` of coefficients ``(N, K, 3)`` along unit directions ``(N, 3)``, as
    `sh_colours` does.
    """
    x, y, z = directions.unbind(1)
    terms = [torch.full_like(x, C0), *sh_terms(x, y, z)][: sh.shape[1]]
    return torch.clamp(0.5 + torch.einsum("nk,nkc->nc", torch.stack(terms, dim=1), sh), min=0.0)


def rasterize_torch(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    lod_px: float = 0.0,
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
) -> RasterOutput:
    """Render a cloud without gradients; see `rasterize_tensors` for gradients.

    Raises:
        InputError: The cloud holds Gaussians that cannot be drawn, or the background does not fit.
    """
    cloud.require_drawable()
    behind = torch.as_tensor(background_image(background, camera), device=device)
    with torch.no_grad():
        out = rasterize_tensors(
            GaussianTensors.from_cloud(cloud, dtype, device),
            camera,
            behind.reshape(-1) if behind.numel() == 3 else behind,
            near_m=near_m,
            lod_px=lod_px,
        )
    image, alpha, depth = (
        t.float().cpu().numpy() for t in (out.rgb.clamp(0, 1), out.alpha, out.depth)
    )
    return RasterOutput(image, alpha, depth, {"gaussians": len(cloud)})
