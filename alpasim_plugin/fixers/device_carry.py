"""Carry recorded frames into a view on a GPU: what `fixers.ground` does, with tensors, and without
waiting for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64
from alpasim_plugin.fixers import ground
from alpasim_plugin.fixers.warp import (
    INCONSISTENT,
    INFINITY_M,
    NEAREST_M,
    PARALLEL,
    SLACK,
    SLACK_M,
    VALID,
    RecordedImage,
    WarpTarget,
)


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


def upload(recorded: RecordedImage, device: torch.device) -> UploadedImage:
    """Send a recorded frame, as of `ground.with_users`, to a device."""
    rgb, depth = (
        torch.from_numpy(part.copy()).to(device) for part in (recorded.rgb, recorded.depth)
    )
    hidden = depth
    if recorded.users is not None:
        users = torch.from_numpy(recorded.users).to(device)
        hidden = depth.masked_fill(users, ground.HIDING_M)
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
    by_depth = torch.stack([_warp(one, one.depth, target, target.depth, np.inf) for one in images])
    depth = _ground_depth(target, T_world_rig)
    on_ground = torch.stack(
        [_warp(one, one.hidden, target, depth, ground.FREE_SHARE) for one in images]
    )
    chosen = depth > 0
    if len(images) > 1:
        size = ground.window_px(target.K)
        apart = _disagreement(on_ground, size) - _disagreement(by_depth, size)
        chosen &= (apart <= ground.PREFERENCE * size**2) | (target.depth <= 0)
    return torch.where(chosen[..., None], on_ground, by_depth)


def _pixels(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the centres of the columns ``(W,)`` and rows ``(H, 1)`` of an image."""
    height, width = depth.shape
    columns = torch.arange(width, device=depth.device, dtype=torch.float64) + 0.5
    return columns, torch.arange(height, device=depth.device, dtype=torch.float64)[:, None] + 0.5


def _along(matrix: F64, x: Tensor, y: Tensor, z: Tensor | float = 1.0) -> list[Tensor]:
    """Return the rows of a matrix times (x, y, z)."""
    return [float(a) * x + float(b) * y + float(c) * z for a, b, c in matrix[:, :3]]


def _warp(
    image: UploadedImage, seen: Tensor, target: WarpTarget, depth: Tensor, free_share: float
) -> Tensor:
    """Return one recorded frame in the view ``(H, W, 4)`` by a depth of the view; see `warp.warp`.

    Args:
        image: The recorded frame.
        seen: Its depth.
        target: The view.
        depth: That of the view; road users move with their boxes where it is the render's.
        free_share: See `warp.Lookup`.
    """
    recorded = image.recorded
    project = recorded.K @ inverse(recorded.T_world_camera)[:3]
    columns, rows = _pixels(depth)
    z = torch.where(depth > 0, depth, INFINITY_M).double()
    A = project[:, :3] @ target.T_world_camera[:3, :3] @ np.linalg.inv(target.K)
    b = project[:, :3] @ target.T_world_camera[:3, 3] + project[:, 3]
    u, v, w = (
        z * slope + float(shift) for slope, shift in zip(_along(A, columns, rows), b, strict=True)
    )
    placed = target.placed
    if depth is target.depth:
        for i in reversed(range(len(placed.names))):  # of two boxes the first counts
            low, high = placed.seen.walls[i]
            ray = _along(placed.seen.ray[i], columns, rows)
            point = [
                z * slope + float(eye) for slope, eye in zip(ray, placed.seen.eye[i], strict=True)
            ]
            inside = depth > 0
            for p, least, most in zip(point, low, high, strict=True):
                inside = inside & (p >= float(least)) & (p < float(most))
            T = recorded.actors.get(placed.names[i], np.full((4, 4), np.nan))
            to_then = project @ T
            moved = _along(to_then, *point)
            u, v, w = (
                torch.where(inside, there + float(shift), here)
                for there, shift, here in zip(moved, to_then[:, 3], (u, v, w), strict=True)
            )
    u, v = u / w, v / w
    height, width = seen.shape
    there = (w > NEAREST_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = torch.where(there, u, 0.5), torch.where(there, v, 0.5)
    surface = seen[v.long(), u.long()].double()
    surface = torch.where(surface > 0, surface, INFINITY_M)
    far = (surface > INFINITY_M / 2) & (w > INFINITY_M / 2)
    agrees = far | (surface >= free_share * w) | ((surface - w).abs() < SLACK * w + SLACK_M)
    held = torch.where(agrees, VALID, INCONSISTENT) * there
    x, y = 2 * (u - 0.5) / (width - 1) - 1, 2 * (v - 0.5) / (height - 1) - 1
    grid = torch.stack([x, y], dim=-1).float()
    rgb = F.grid_sample(
        image.rgb, grid[None], mode="bicubic", padding_mode="border", align_corners=True
    )
    levels = (rgb[0].permute(1, 2, 0) + 0.5).clamp(0, 255)
    return torch.cat([levels, held[..., None]], dim=-1).to(torch.uint8)


def _ground_depth(target: WarpTarget, T_world_rig: F64) -> Tensor:
    """Return the depth of the ground where a pixel may show it; see `ground.ground_hypothesis`."""
    depth = target.depth
    columns, rows = _pixels(depth)
    down = T_world_rig[:3, 2] @ target.T_world_camera[:3, :3] @ np.linalg.inv(target.K)
    height_m = float(T_world_rig[:3, 2] @ (target.T_world_camera[:3, 3] - T_world_rig[:3, 3]))
    (slope,) = _along(down[None], columns, rows)
    z = torch.where(slope < 0, -height_m / slope, 0.0)
    free = (z > ground.NEAREST_M) & (z < ground.FARTHEST_M)
    free &= (depth <= 0) | (depth >= ground.FREE_SHARE * z)
    for ray, eye, walls, _ in zip(*target.placed.seen, strict=True):
        near = torch.zeros_like(z)
        far = torch.full_like(z, np.inf)
        for axis, along in enumerate(_along(ray, columns, rows)):
            along = torch.where(along == 0, PARALLEL, along)
            a, b = (float(wall - eye[axis]) / along for wall in walls[:, axis])
            near = torch.maximum(near, torch.minimum(a, b))
            far = torch.minimum(far, torch.maximum(a, b))
        free &= near >= far
    return torch.where(free, z, 0.0).float()


def _disagreement(images: Tensor, size: int) -> Tensor:
    """Return by how many levels the first two images differ around each pixel; see `ground`."""
    a, b = images[:2].float()
    apart = ((a - b).abs()[..., :3].sum(dim=-1) / 3).round()
    apart = torch.where(torch.minimum(a, b)[..., 3] == 0, ground.UNSEEN, apart)
    around = F.pad(apart[None, None], (size // 2,) * 4, mode="reflect")
    return F.avg_pool2d(around, size, 1, divisor_override=1)[0, 0]
