"""A random scene with the statistics of a street."""

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud


def driving_like_scene(n, seed=0, sh_degree=3):
    """Return n Gaussians around a straight road, world axes ENU with the road along x, seen well
    from (0, 0, 1.6) towards +x.

    30 % road, 35 % facades, 12 % vehicles, 18 % foliage, 5 % far shell at 300 m; sizes scale with
    n^-1/2, so that the covered share of an image does not depend on n.
    """
    rng = stream("raster-bench", seed, "scene")
    size = np.sqrt(100_000 / n)
    counts = np.floor(np.array([0.30, 0.35, 0.12, 0.18]) * n).astype(int)
    road, facade, vehicle, foliage = counts
    far = n - int(counts.sum())

    def flat(count, length_m, thickness_m):
        scales = length_m * size * np.exp(rng.normal(0.0, 0.4, (count, 3)))
        scales[:, 2] = thickness_m
        return np.asarray(scales)

    # Points are denser near the camera, as reconstructions are.
    def ahead(count, reach_m):
        return np.asarray(-8.0 + (reach_m + 8.0) * rng.uniform(0, 1, count) ** 1.5)

    road_means = np.stack(
        [ahead(road, 120), rng.uniform(-9, 9, road), rng.normal(0, 0.01, road)], axis=1
    )
    side = rng.choice([-1.0, 1.0], facade)
    facade_means = np.stack(
        [ahead(facade, 140), side * (12 + rng.normal(0, 0.1, facade)), rng.uniform(0, 14, facade)],
        axis=1,
    )
    box = rng.integers(0, 24, vehicle)
    car_at = np.stack(
        [np.linspace(4, 110, 24), np.tile([-5.5, -2.0, 2.0, 5.5], 6), np.full(24, 0.8)], axis=1
    )
    vehicle_means = car_at[box] + rng.uniform(-1, 1, (vehicle, 3)) * [2.2, 0.9, 0.75]
    tree = rng.integers(0, 30, foliage)
    tree_at = np.stack(
        [np.linspace(0, 130, 30), np.tile([-9.5, 9.5], 15), np.full(30, 4.5)], axis=1
    )
    foliage_means = tree_at[tree] + rng.normal(0, [1.4, 1.2, 1.4], (foliage, 3))
    direction = rng.normal(size=(far, 3))
    direction[:, 0] = 2 * np.abs(direction[:, 0])
    direction[:, 2] = np.abs(direction[:, 2])
    far_means = 300.0 * direction / np.linalg.norm(direction, axis=1, keepdims=True)

    upright = np.sqrt(0.5)
    quats = np.concatenate(
        [
            np.tile([1.0, 0, 0, 0], (road, 1)),
            np.tile([upright, upright, 0, 0], (facade, 1)),  # thin axis along y
            rng.normal(size=(vehicle + foliage + far, 4)),
        ]
    )
    scales = np.concatenate(
        [
            flat(road, 0.2, 0.01),
            flat(facade, 0.32, 0.02),
            flat(vehicle, 0.07, 0.02),
            0.12 * size * np.exp(rng.normal(0, 0.5, (foliage, 3))),
            7.0 * size * np.exp(rng.normal(0, 0.3, (far, 3))),
        ]
    )
    sh = rng.normal(0, 0.03, (n, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.2, 1.2, (n, 3))
    opacities = np.clip(rng.beta(4.0, 1.2, n), 0.02, 0.999)
    return GaussianCloud(
        np.concatenate([road_means, facade_means, vehicle_means, foliage_means, far_means]),
        quats.astype(np.float32),
        scales.astype(np.float32),
        opacities.astype(np.float32),
        sh.astype(np.float32),
    )


def driving_camera(width, height, yaw_rad=0.0):
    """Return a camera at (0, 0, 1.6), looking along +x turned left by the yaw, horizontal field of
    view 65 degrees.
    """
    T_world_camera = np.eye(4)
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    T_world_camera[:3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ [
        [0, 0, 1],
        [-1, 0, 0],
        [0, -1, 0],
    ]
    T_world_camera[:3, 3] = [0, 0, 1.6]
    focal = width / (2 * np.tan(np.deg2rad(65) / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return PinholeCamera.from_pose(width, height, K, T_world_camera)
