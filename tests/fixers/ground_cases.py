"""Recorded frames of a street with known ground."""

import numpy as np

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.fixers.warp import RecordedImage

WIDTH = 64
HEIGHT = 48
HEIGHT_M = 1.5
K = np.array([[50.0, 0, 32], [0, 50.0, 16], [0, 0, 1]])
FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, HEIGHT_M], [0, 0, 0, 1]])
NOBODY = {}


def rig(x_m):
    return se2(x_m, 0.0, 0.0)


def rays(T_world_camera):
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    local = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    return np.asarray(local @ T_world_camera[:3, :3].T)


def street(x_m, wall_m=np.inf):
    """Pose, depth and picture of a road with a pattern that is fixed to the world, and of a wall
    across it with another.
    """
    T = se2(x_m, 0.0, 0.0) @ FORWARD
    along = rays(T)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(along[..., 2] < 0, -HEIGHT_M / along[..., 2], np.inf)
    walled = depth > wall_m - x_m
    depth = np.where(walled, wall_m - x_m, depth)
    here = T[:3, 3] + along * np.where(np.isfinite(depth), depth, 0)[..., None]
    grey = (
        128
        + 60 * np.sin(1.3 * here[..., 0]) * np.cos(1.1 * here[..., 1])
        + 60 * walled * np.sin(2.0 * here[..., 2])
    )
    grey[~np.isfinite(depth)] = 230
    rgb = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return T, np.where(np.isfinite(depth), depth, 0).astype(np.float32), rgb


def recorded(x_m, wall_m=np.inf):
    T, depth, rgb = street(x_m, wall_m)
    return RecordedImage(K, T, rgb, depth, NOBODY)
