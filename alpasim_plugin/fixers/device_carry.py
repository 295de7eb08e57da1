"""Carry recorded frames into a view on a GPU: what `fixers.ground` does, with tensors, and without
waiting for them. Only the first rows of the ground may differ, where a window ends at another row.

Points are tensors ``(3, H, W)`` float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64
from alpasim_plugin.fixers import ground
from alpasim_plugin.fixers.warp import (
    FREE_SHARE,
    INCONSISTENT,
    INFINITY_M,
    NEAREST_M,
    SLACK,
    SLACK_M,
    VALID,
    RecordedImage,
    WarpTarget,
    hidden_by_users,
)

ABSENT = np.full((4, 4), np.nan)


@dataclass(frozen=True, eq=False)
class UploadedImage:
    """A recorded frame on a device.

    Attributes:
        recorded: On the host.
        rgb: ``(1, 3, H, W)`` float32 levels.
        depth: ``(H, W)`` metres.
        hidden: Depth with road users that hide all ground behind them.
    """

    recorded: RecordedImage
    rgb: Tensor
    depth: Tensor
    hidden: Tensor


def upload_image(recorded: RecordedImage, device: torch.device) -> UploadedImage:
    """Send a recorded frame, as of `ground.with_users`, to a device."""
    parts = recorded.rgb, recorded.depth, hidden_by_users(recorded)
    rgb, depth, hidden = (upload(part, device) for part in parts)
    return UploadedImage(recorded, rgb.permute(2, 0, 1)[None].float(), depth, hidden)


def carry_on_device(
    images: Sequence[UploadedImage], target: WarpTarget, T_world_rig: F64
) -> Tensor:
    """Return the recorded frames in the view ``(K, H, W, 4)`` uint8; see `ground.carry`.

    Args:
        images: Nearest first.
        target: The view, whose depth is a tensor.
        T_world_rig: ``(4, 4)`` of a rig near the view.
    """
    depth: Tensor = target.depth  # type: ignore[assignment]  # a tensor here
    rays = _rays(depth)
    on_ground = _ground_depth(rays, target, T_world_rig)
    by_depth = torch.stack([_warp(one, one.depth, rays, target, depth, np.inf) for one in images])
    by_ground = torch.stack(
        [_warp(one, one.hidden, rays, target, on_ground, FREE_SHARE) for one in images]
    )
    chosen = on_ground > 0
    if len(images) > 1:
        size = ground.window_px(target.K)
        step = ground.step_px(size)
        across = size // step | 1
        by_both = (part[:, ::step, ::step] for part in (by_ground, by_depth))
        apart = torch.sub(*(_disagreement(part, across) for part in by_both))
        agrees = (apart <= ground.PREFERENCE * across**2).repeat_interleave(step, dim=0)
        agrees = agrees.repeat_interleave(step, dim=1)[: len(depth), : depth.shape[1]]
        chosen &= agrees | (depth <= 0)
    return torch.where(chosen[..., None], by_ground, by_depth)


def _rays(depth: Tensor) -> Tensor:
    """Return the centres of the pixels of an image, (u, v, 1)."""
    height, width = depth.shape
    rows = torch.arange(height, device=depth.device).double() + 0.5
    columns = torch.arange(width, device=depth.device).double() + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)])


def _column(values: F64, like: Tensor) -> Tensor:
    """Return numbers ``(M,)`` as an image of one pixel on a device."""
    return upload(values, like.device)[:, None, None]


def _turned(matrix: F64, points: Tensor) -> Tensor:
    """Return a matrix ``(M, 3)`` times points."""
    return torch.tensordot(upload(matrix, points.device), points, dims=1)


def _warp(
    image: UploadedImage,
    seen: Tensor,
    rays: Tensor,
    target: WarpTarget,
    depth: Tensor,
    free_share: float,
) -> Tensor:
    """Return one recorded frame in the view ``(H, W, 4)``; see `warp.warp`.

    Args:
        image: The recorded frame.
        seen: Its depth.
        rays: Of the view.
        target: The view.
        depth: By which the frame is carried; road users move with their boxes by the view's own.
        free_share: A recorded surface at least this share of a point's distance away does not hide it.
    """
    recorded, placed = image.recorded, target.placed
    project = recorded.K @ inverse(recorded.T_world_camera)[:3]
    T_then_camera = project @ target.T_world_camera
    points = rays * torch.where(depth > 0, depth, INFINITY_M)
    there = _turned(T_then_camera[:, :3] @ np.linalg.inv(target.K), points)
    there += _column(T_then_camera[:, 3], points)
    boxes = zip(placed.names, *placed.seen[:3], strict=True) if depth is target.depth else ()  # type: ignore[comparison-overlap]
    for name, ray, eye, (low, high) in reversed(list(boxes)):  # of two boxes the first counts
        local = _turned(ray, points) + _column(eye, points)
        inside = (local >= _column(low, points)) & (local < _column(high, points))
        T_then_box = project @ recorded.actors.get(name, ABSENT)
        then = _turned(T_then_box[:, :3], local) + _column(T_then_box[:, 3], points)
        there = torch.where(inside.all(dim=0) & (depth > 0), then, there)
    u, v, w = there
    u, v = u / w, v / w
    height, width = seen.shape
    shown = (w > NEAREST_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = torch.where(shown, u, 0.5), torch.where(shown, v, 0.5)
    surface = seen[v.long(), u.long()].double()
    surface = torch.where(surface > 0, surface, INFINITY_M)
    far = (surface > INFINITY_M / 2) & (w > INFINITY_M / 2)
    agrees = far | (surface >= free_share * w) | ((surface - w).abs() < SLACK * w + SLACK_M)
    held = torch.where(agrees, VALID, INCONSISTENT) * shown
    grid = torch.stack([(2 * u - 1) / (width - 1) - 1, (2 * v - 1) / (height - 1) - 1], dim=-1)
    rgb = F.grid_sample(
        image.rgb, grid[None].float(), "bicubic", padding_mode="border", align_corners=True
    )
    levels = (rgb[0].permute(1, 2, 0) + 0.5).clamp(0, 255)
    return torch.cat([levels, held[..., None]], dim=-1).to(torch.uint8)


def _ground_depth(rays: Tensor, target: WarpTarget, T_world_rig: F64) -> Tensor:
    """Return the depth of the ground where a pixel may show it; see `ground.ground_hypothesis`."""
    depth = target.depth
    up = T_world_rig[:3, 2]
    down = up @ target.T_world_camera[:3, :3] @ np.linalg.inv(target.K)
    height_m = float(up @ (target.T_world_camera[:3, 3] - T_world_rig[:3, 3]))
    (slope,) = _turned(down[None], rays)
    z = -height_m / slope
    free = (slope < 0) & (z > ground.NEAREST_M) & (z < ground.FARTHEST_M)
    free &= (depth <= 0) | (depth >= FREE_SHARE * z)
    for ray, eye, walls, _ in zip(*target.placed.seen, strict=True):
        along = _turned(ray, rays)
        reaches = [_column(wall - eye, rays) / along for wall in walls]
        near = torch.minimum(*reaches).amax(dim=0).clamp(min=0)
        free &= near >= torch.maximum(*reaches).amin(dim=0)
    return torch.where(free, z, 0.0).float()


def _disagreement(images: Tensor, size: int) -> Tensor:
    """Return by how many levels the first two images differ around each pixel; see `ground`."""
    a, b = images[:2].float()
    apart = ((a - b).abs()[..., :3].sum(dim=-1) / 3).round()
    apart = torch.where(torch.minimum(a, b)[..., 3] == 0, ground.UNSEEN, apart)
    around = F.pad(apart[None, None], (size // 2,) * 4, mode="reflect")
    return F.avg_pool2d(around, size, 1, divisor_override=1)[0, 0]
