"""Cameras with lenses, and Gaussians about them."""

import numpy as np

from alpasim_plugin.cameras.lens import radial_form, resized
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import CameraSpec, LensModel
from alpasim_plugin.gaussians import GaussianCloud
from alpasim_plugin.gaussians.camera import Rolling
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.lens_rays import (
    LENS_BEND,
    LENS_LEAST,
    LENS_SMALL,
    camera_lens,
)
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


def camera(name, rolls=False, T_world_camera=WORLD, size=(WIDTH, HEIGHT)):
    T = inverse(T_world_camera)
    seen = resized(spec(name), *size)
    if not rolls:
        return LensCamera(seen, T)
    step = 1 / (size[1] - 1)
    start = inverse(T_world_camera @ BACK)
    return LensCamera(seen, T, Rolling(start, {}, (0.0, step, -0.5 - 0.5 * step), 10.0))


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


HARD = {
    "behind": (around(80, 5) - [0, 0, 12.0], (0.3, 0.2, 0.1)),
    "at 90 degrees and beyond": (
        [
            [3 * np.sin(a), 0.2 * k, 3 * np.cos(a)]
            for k, a in enumerate(np.deg2rad([85, 90, 95, 105]))
        ],
        (0.4, 0.1, 0.3),
    ),
    "needles": (around(60, 6), (10.0, 1e-3, 1e-3)),
    "discs": (around(60, 7, 0.5), (1.0, 1.0, 1e-4)),
    "flat ones in the plane of a ray": (
        [[0, 0.0, 4], [0, 0.001, 6], [0.3, 0, 5]],
        (1.0, 1.0, 1e-6),
    ),
    "enclosing": (around(12, 8, 0.2, 1.5), (1.5, 1.0, 0.8)),
    "large beside the camera": (
        [[2.0, 0, 0.1], [-1.5, 0.5, -0.5], [0, 1.5, 0.5]],
        (3.0, 1.0, 0.05),
    ),
    "near": (around(60, 9, 0.3, 1.0), (0.05, 0.02, 0.01)),
}

FINE = {
    "opencv": (700.0, 30, LensModel("opencv", (-0.1, 0.01, 1e-3, -7e-4))),
    "fisheye": (400.0, 70, LensModel("fisheye", (0.02, -0.004), max_angle_rad=np.deg2rad(100))),
    "ftheta": (1.0, 60, LensModel("ftheta", (0.0, 800.0, 0.0, -15.0))),
}


def fine_camera(name, rolls, size=(200, 150)):
    """Return a part, off the axis, of an image so fine that Gaussians are drawn as ellipses."""
    focal, off_deg, lens = FINE[name]
    whole = CameraSpec(name, WIDTH, HEIGHT, np.diag([focal, focal, 1.0]), np.eye(4), 0, lens)
    off_px = radial_form(whole).radius(np.array([np.deg2rad(off_deg)]))[0]
    off_px *= np.linalg.norm(radial_form(whole).linear, 2)
    K = whole.K.copy()
    width, height = size
    K[:2, 2] = width / 2 - 0.8 * off_px, height / 2 - 0.6 * off_px
    seen = CameraSpec(name, width, height, K, np.eye(4), 0, lens)
    if not rolls:
        return LensCamera(seen, inverse(WORLD))
    step = 1 / (height - 1)
    time = (0.0, step, -0.5 - 0.5 * step)
    return LensCamera(seen, inverse(WORLD), Rolling(inverse(WORLD @ BACK), {}, time, 60.0))


SHAPES = np.array([[1, 1, 0.02], [1, 0.02, 0.02], [0.5, 0.4, 0.3]])  # discs, needles, others


def largest_small(seen, count, seed):
    """Return Gaussians in an image, as large as ellipses may be, and of any opacity and colour."""
    rng = np.random.default_rng(seed)
    rays = seen.rays().reshape(-1, 3)
    distance = np.exp(rng.uniform(np.log(4), np.log(40), (count, 1)))
    p = rays[rng.integers(len(rays), size=count)] * distance
    numbers = camera_lens(seen)
    low_pass = numbers[LENS_BEND] * 0.55 / numbers[LENS_LEAST]
    most = (numbers[LENS_SMALL] - low_pass) / (1 + numbers[LENS_BEND]) * distance
    assert (most > 0).all()
    return cloud_of(p, most * SHAPES[rng.integers(3, size=count)], rng.uniform(0.3, 1, count), seed)
