"""Cameras with lenses, and Gaussians about them."""

import numpy as np

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import CameraSpec, LensModel
from alpasim_plugin.gaussians import GaussianCloud
from alpasim_plugin.gaussians.camera import Rolling
from alpasim_plugin.gaussians.lens_camera import LensCamera
from tests.gaussians.lens_reference import Motion

WIDTH = 80
HEIGHT = 60
LENSES = {
    "pinhole": (45.0, None),
    "opencv": (
        50.0,
        LensModel(
            "opencv",
            (-0.28, 0.08, 1e-3, -7e-4, -0.01, 0.0, 0.0, 0.0, 1e-3, -5e-4, 8e-4, 3e-4),
        ),
    ),
    "fisheye": (22.0, LensModel("fisheye", (0.02, -0.004, 0.001), max_angle_rad=np.deg2rad(100))),
    "ftheta": (1.0, LensModel("ftheta", (0.0, 40.0, 0.0, -0.6), (), (1.01, 0.01, -0.02))),
    "ftheta-backward": (1.0, LensModel("ftheta", (), (0.0, 1 / 40, 0.0, 1e-7))),
    # beyond 95 degrees its radius falls
    "turning": (1.0, LensModel("ftheta", (0.0, 40.0, 0.0, -4.85), max_angle_rad=np.deg2rad(80))),
}


def spec(name):
    focal, lens = LENSES[name]
    K = np.array([[focal, 0, WIDTH / 2 + 1], [0, 1.02 * focal, HEIGHT / 2 - 1], [0, 0, 1]])
    return CameraSpec(name, WIDTH, HEIGHT, K, np.eye(4), 0, lens)


def pose(turn, place):
    start = Motion(np.eye(4), np.eye(4))
    start.turn = np.asarray(turn, dtype=np.float64)
    T = start.at(1.0)
    T[:3, 3] = place
    return T


WORLD = pose([0.1, 0.2, -0.1], [0.1, 0.2, 0.3])
# Half of 30 ms at 15 m/s and 30 degrees a second.
BACK = pose([0.0, -0.00785, 0.0], [0.02, 0.01, -0.225])


def camera(name, rolls=False, T_world_camera=WORLD):
    T = inverse(T_world_camera)
    if not rolls:
        return LensCamera(spec(name), T)
    step = 1 / (HEIGHT - 1)
    start = inverse(T_world_camera @ BACK)
    return LensCamera(spec(name), T, Rolling(start, {}, (0.0, step, -0.5 - 0.5 * step), 10.0))


def cloud_of(p, scales, opacity=0.8, seed=0, antialias_px2=0.0, T_world_camera=WORLD):
    """Return Gaussians at places of the camera's axes, turned at random."""
    rng = np.random.default_rng(seed)
    p = np.atleast_2d(np.asarray(p, dtype=np.float64))
    means = p @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    quats = rng.normal(size=(len(p), 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    sizes = np.broadcast_to(np.asarray(scales, dtype=np.float64), (len(p), 3))
    opacities = np.broadcast_to(opacity, len(p)).copy()
    sh = 0.3 * rng.normal(size=(len(p), 4, 3))
    return GaussianCloud(means, quats, sizes.copy(), opacities, sh, antialias_px2=antialias_px2)


def around(count, seed, least_m=1.0, most_m=20.0):
    """Return directions and distances all about the camera."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return d * rng.uniform(least_m, most_m, (count, 1))
