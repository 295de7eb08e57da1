"""Small scenes and comparisons shared by the rasteriser tests."""

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera
from alpasim_plugin.gaussians.sh import dc_from_rgb

LSB = 1.0 / 255.0


def splats(means, scales=0.3, opacities=0.8, rgb=(1.0, 1.0, 1.0), quats=(1.0, 0.0, 0.0, 0.0)):
    """Build a cloud of plain colours; scalars and single rows are repeated."""
    means = np.atleast_2d(np.asarray(means, dtype=np.float64))
    n = len(means)
    scales = np.asarray(scales, dtype=np.float64)
    scales = scales[:, None] if scales.ndim == 1 and len(scales) == n and n != 3 else scales
    return GaussianCloud(
        means,
        np.broadcast_to(np.asarray(quats, dtype=np.float64), (n, 4)).copy(),
        np.broadcast_to(scales, (n, 3)).copy(),
        np.broadcast_to(np.asarray(opacities, dtype=np.float64), (n,)).copy(),
        np.broadcast_to(dc_from_rgb(rgb), (n, 3)).reshape(n, 1, 3).copy(),
    )


def random_cloud(n, seed=0, degree=3):
    """Return Gaussians of all shapes and opacities in front of the camera at the origin looking
    along z.
    """
    rng = stream("raster-tests", seed, "cloud")
    return GaussianCloud(
        rng.uniform([-4, -3, 0.5], [4, 3, 12], (n, 3)),
        rng.normal(size=(n, 4)),
        np.exp(rng.uniform(-5, -0.5, (n, 3))),
        rng.uniform(0.0, 1.0, n),
        rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.3,
    )


def camera(width=96, height=64, f=80.0, T_camera_world=None):
    """Return a camera with square pixels and a slightly off-centre principal point."""
    K = np.array([[f, 0, width / 2 + 1.3], [0, f, height / 2 - 0.7], [0, 0, 1]])
    return PinholeCamera(width, height, K, np.eye(4) if T_camera_world is None else T_camera_world)


def random_rigid(seed, reach_m=5.0):
    """Return a random rotation and translation."""
    rng = stream("raster-tests", seed, "pose")
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = q, rng.uniform(-reach_m, reach_m, 3)
    return T


def assert_same_image(found, wanted, tolerance=2e-5, odd_share=0.0):
    """Compare colour, alpha and depth; ``odd_share`` of the pixels may differ by a documented
    discontinuity.
    """
    colour = np.abs(found.rgb - wanted.rgb).max(axis=2)
    opacity = np.abs(found.alpha - wanted.alpha)
    scale = np.maximum(wanted.depth, 1.0) / np.maximum(wanted.alpha, 1e-3)
    depth = np.abs(found.depth - wanted.depth) / scale
    for name, error in (("rgb", colour), ("alpha", opacity), ("depth", depth)):
        odd = np.mean(error > tolerance)
        assert np.isfinite(error).all(), f"{name} holds NaN"
        assert odd <= odd_share, (
            f"{name}: {odd:.2%} of pixels differ by more than {tolerance}, at most {error.max():.3g}"
        )


def needle(length_px, angle):
    quat = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
    return splats([0.1, -0.05, 2.0], [[length_px / 40, 0.02, 0.003]], 0.9, quats=quat)


def kilometre_splats():
    rng = np.random.default_rng(0)
    means = rng.uniform(-500, 500, (10, 3)) + np.array([0, 0, 600])
    return splats(means, 1000.0, 0.3, rng.uniform(0, 1, (10, 3)))


HARD = {
    "no Gaussian": random_cloud(0),
    "all shapes": random_cloud(200, 4),
    "constant colours": random_cloud(60, 5, degree=0),
    "harmonics of degree 1": random_cloud(60, 6, degree=1),
    "harmonics of degree 2": random_cloud(60, 7, degree=2),
    "saturated layers": splats(np.column_stack([np.zeros((8, 2)), np.arange(2.0, 10)]), 5.0, 1.0),
    "kilometre splats": kilometre_splats(),
    "zero scale": splats([0, 0, 3.0], 0.0, 0.9),
    "centre behind": splats([0, 0, -0.5], 3.0, 0.9),
    "far off axis": splats([9.8, 0, 1.7], 0.3, 0.95),
    "needle of 10 pixels": needle(10, 0.3),
    "needle of 1,000 pixels": needle(1_000, 1.1),
    "needle of 10,000 pixels": needle(10_000, 2.0),
    "overflowing width": splats([0, 0, 5.0], [[np.exp(19.9), 1e-30, 1.0]], 0.5),
}


def covariances(cloud):
    """Return ``(N, 3, 3)``: ``(R diag s)(R diag s)^T``, metres^2."""
    factor = cloud.rotations() * cloud.scales.astype(np.float64)[:, None, :]
    return factor @ np.swapaxes(factor, 1, 2)
