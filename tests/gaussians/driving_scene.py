"""A random scene with the statistics of a street."""

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud


def driving_like_scene(n, seed=0):
    """Return n flat Gaussians of a straight road along x, world axes ENU, and of the facades beside
    it, seen well from (0, 0, 1.6) towards +x; every twentieth lies on a far shell.

    Sizes scale with n^-1/2, so that the covered share of an image does not depend on n.
    """
    rng = stream("raster-bench", seed, "scene")
    is_road = rng.random(n) < 0.4
    is_far = np.arange(n) % 20 == 0
    ahead = -8.0 + 140 * rng.uniform(0, 1, n) ** 1.5  # denser near the camera
    across = np.where(is_road, rng.uniform(-9, 9, n), rng.choice([-12.0, 12.0], n))
    means = np.stack([ahead, across, np.where(is_road, 0, rng.uniform(0, 14, n))], axis=1)
    means += rng.normal(0, 0.05, (n, 3))
    means[is_far] *= 300 / np.linalg.norm(means[is_far], axis=1, keepdims=True)
    scales = 0.25 * np.sqrt(100_000 / n) * np.exp(rng.normal(0, 0.4, (n, 3)))
    scales[np.arange(n), np.where(is_road, 2, 1)] = 0.02
    scales[is_far] = 20
    sh = rng.normal(0, 0.03, (n, 16, 3))
    sh[:, 0] = rng.uniform(-1.2, 1.2, (n, 3))
    opacities = np.clip(rng.beta(4.0, 1.2, n), 0.02, 0.999)
    turned = np.eye(4)[0] + rng.normal(0, 0.1, (n, 4))
    return GaussianCloud(means, *(x.astype(np.float32) for x in (turned, scales, opacities, sh)))


def driving_camera(width, height):
    """Return a camera at (0, 0, 1.6), looking along +x, horizontal field of view 65 degrees."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T_world_camera[:3, 3] = [0, 0, 1.6]
    focal = width / (2 * np.tan(np.deg2rad(65) / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return PinholeCamera.from_pose(width, height, K, T_world_camera)
