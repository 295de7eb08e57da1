"""Scenes whose gradients are hard to get right."""

import numpy as np

from alpasim_plugin.gaussians import PinholeCamera
from alpasim_plugin.gaussians.sh import dc_from_rgb
from tests.gaussians.gaussian_scenes import camera, random_rigid
from tests.gaussians.gradient_scenes import scene

SMALL = camera(24, 18, 20.0)
TOLERANCE = (
    5e-4  # of the largest gradient of a Gaussian in a field; float32 sums of terms that cancel
)


def overlapping():
    rng = np.random.default_rng(3)
    means = rng.uniform([-0.6, -0.5, 1.5], [0.6, 0.5, 4.0], (3, 3))
    return scene(means, rng.uniform(0.1, 0.5, (3, 3)), SMALL, opacities=rng.uniform(0.2, 0.95, 3))


def needles_before_the_camera():
    """Splats of up to 3000 pixels by half a pixel, at 0.3 to 1 m."""
    means = [[0.02, 0.01, 0.3], [-0.05, 0.0, 0.6], [0.1, 0.05, 1.0]]
    scales = [[2.0, 0.002, 0.002], [5.0, 0.004, 0.001], [12.0, 0.003, 0.004]]
    aslant = [[0.95, 0.05, 0.02, 0.3], [0.9, 0.0, 0.01, -0.2], [0.99, 0.01, 0.02, 0.05]]
    return scene(means, scales, camera(24, 18, 250.0), quaternions=aslant, opacities=0.7)


def centres_outside_with_clamped_slopes():
    means = [[2.4, 0.0, 1.4], [0.1, -2.2, 1.5], [-2.6, 2.1, 1.6]]
    return scene(means, [[0.9, 0.8, 0.7]], SMALL)


def opaque_stack():
    """Layers of opacity 0.999: alpha is held at 0.99 and the second such layer ends the pixel."""
    means = [[0.0, 0.0, 2.0], [0.05, 0.0, 2.2], [0.0, 0.05, 2.4], [0.1, 0.0, 2.6], [0.0, 0.0, 6.0]]
    return scene(means, [[0.35, 0.3, 0.3]], SMALL, opacities=[0.6, 0.999, 0.998, 0.9, 0.9])


def smaller_than_the_low_pass():
    return scene(
        [[0.1, 0.1, 4.0], [-0.5, 0.2, 5.0], [0.0, -0.3, 6.0]],
        [[0.01, 0.02, 0.005]],
        SMALL,
        opacities=0.9,
    )


def behind_and_before_the_near_plane():
    return scene([[0.0, 0.0, -2.0], [0.02, 0.0, 0.05], [0.0, 0.0, 2.0]], [[0.2, 0.1, 0.3]], SMALL)


def colours_clamped_at_zero():
    sh = np.zeros((3, 4, 3))
    sh[:, 0] = [
        dc_from_rgb([-0.4, 0.5, 0.2]),
        dc_from_rgb([0.3, -0.2, -0.6]),
        dc_from_rgb([-0.5, -0.5, -0.5]),
    ]
    sh[:, 1:] = np.random.default_rng(0).normal(size=(3, 3, 3)) * 0.1
    return scene(
        [[0.0, 0.1, 2.0], [0.2, 0.0, 2.5], [-0.3, 0.0, 3.0]], [[0.4, 0.3, 0.2]], SMALL, sh=sh
    )


def principal_point_beyond_the_corner():
    K = np.array([[22.0, 0, -5.0], [0, 19.0, 25.0], [0, 0, 1]])
    return scene(
        [[1.2, -1.0, 2.0], [2.5, -2.5, 3.5], [0.1, -0.5, 1.5]],
        [[0.4, 0.3, 0.2]],
        PinholeCamera(24, 18, K, np.eye(4)),
    )


def quaternions_of_any_length():
    quaternions = np.random.default_rng(1).normal(size=(3, 4)) * [[1e-2], [1.0], [30.0]]
    return scene(
        [[0.0, 0.1, 2.0], [0.2, 0.0, 2.5], [-0.3, 0.0, 3.0]],
        [[0.4, 0.1, 0.05]],
        SMALL,
        quaternions=quaternions,
    )


def turned_camera_and_harmonics_of_degree_three():
    T = random_rigid(3, 2.0)
    means = np.array([[0.4, -0.2, 2.5], [-0.5, 0.0, 1.2]]) - T[:3, 3]
    sh = np.random.default_rng(2).normal(size=(2, 16, 3)) * 0.2
    return scene(means @ T[:3, :3], [[0.4, 0.3, 0.1]], camera(24, 18, 20.0, T), sh=sh)


HARD = (
    overlapping,
    needles_before_the_camera,
    centres_outside_with_clamped_slopes,
    opaque_stack,
    smaller_than_the_low_pass,
    behind_and_before_the_near_plane,
    colours_clamped_at_zero,
    principal_point_beyond_the_corner,
    quaternions_of_any_length,
    turned_camera_and_harmonics_of_degree_three,
)
