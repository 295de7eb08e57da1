"""The warp array by array: what its kernels are held to."""

import numpy as np

from alpasim_plugin.fixers.warp import (
    INCONSISTENT,
    INFINITY_M,
    NEAREST_M,
    SLACK,
    SLACK_M,
    VALID,
    _walls,
)


def plain_on_boxes(shape, K, T_world_camera, T_box_world, sizes):
    """Return the same as `on_boxes` of `PlacedBoxes`, array by array: the reference of its
    kernel.
    """
    rays = plain_points(np.ones(shape), K, T_world_camera) - T_world_camera[:3, 3]
    out = np.zeros(shape, dtype=bool)
    for T_box, size in zip(T_box_world, sizes, strict=True):
        with np.errstate(divide="ignore"):
            hits = (_walls(size) - _moved(T_box, T_world_camera[:3, 3]))[:, None, None] / (
                rays @ T_box[:3, :3].T
            )
        out |= np.maximum(hits.min(axis=0).max(axis=-1), 0) < hits.max(axis=0).min(axis=-1)
    return out


def plain_coordinates(lookup):
    """Return the same as `warp_coordinates`, array by array: the reference of its kernel."""
    (
        depth,
        K,
        T_world_camera,
        K_then,
        T_then_world,
        depth_then,
        T_box_world,
        T_then_box,
        sizes,
        free_share,
        _,
    ) = lookup
    height, width = depth.shape
    points = plain_points(np.where(depth > 0, depth, INFINITY_M), K, T_world_camera)
    out = points.copy()
    there = np.ones((height, width), dtype=bool)
    free = np.ones((height, width), dtype=bool)
    for T_box, T_then, size in zip(T_box_world, T_then_box, sizes, strict=True):
        q = _moved(T_box, points)
        low, high = _walls(size)
        inside = (
            free
            & (np.abs(q[..., :2]) < high[:2]).all(-1)
            & (q[..., 2] >= low[2])
            & (q[..., 2] < high[2])
        )
        out[inside] = _moved(T_then, q[inside])
        there[inside] = bool(np.isfinite(T_then).all())
        free &= ~inside
    local = _moved(T_then_world, out)
    rz = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = local[..., 0] / rz * K_then[0, 0] + K_then[0, 2]
        y = local[..., 1] / rz * K_then[1, 1] + K_then[1, 2]
        rows, columns = depth_then.shape
        seen = there & (rz > NEAREST_M) & (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    at = depth_then[np.where(seen, y, 0).astype(int), np.where(seen, x, 0).astype(int)]
    then = np.where(at > 0, at, INFINITY_M)
    far = (then > INFINITY_M / 2) & (rz > INFINITY_M / 2)
    agrees = far | (then >= free_share * rz) | (np.abs(then - rz) < SLACK * rz + SLACK_M)
    held = np.where(seen, np.where(agrees, VALID, INCONSISTENT), 0).astype(np.uint8)
    return (
        np.where(seen, x - 0.5, 0).astype(np.float32),
        np.where(seen, y - 0.5, 0).astype(np.float32),
        held,
    )


def plain_points(depth, K, T_world_camera):
    """Return the points of the world ``(H, W, 3)`` that pixels show at a depth ``(H, W)``."""
    height, width = depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    z = depth.astype(np.float64)
    return _moved(
        T_world_camera,
        np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=-1),
    )


def _moved(T, points):
    """Map points ``(..., 3)`` by ``T (4, 4)``."""
    moved = points @ T[:3, :3].T + T[:3, 3]
    return moved
