"""Tiny cases that compile the kernels of the rasterisers."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud

SIDE_PX = 16


def rasterise() -> None:
    """Draw one Gaussian."""
    from alpasim_plugin.gaussians.raster.rasterize_cpu import rasterize_cpu

    rasterize_cpu(_cloud(), _camera(), np.zeros((SIDE_PX, SIDE_PX, 3), np.float32), threads=1)


def fit() -> None:
    """Take the gradient of one Gaussian's image."""
    # Imported on use: it loads torch.
    from alpasim_plugin.gaussians.raster.gradient_types import Splats
    from alpasim_plugin.gaussians.raster.rasterize_gradient import rasterize_gradient

    splats = Splats.from_cloud(_cloud())
    splats.means.requires_grad_(True)
    loss = rasterize_gradient(splats, _camera(), threads=1).rgb.sum()
    loss.backward()  # type: ignore[no-untyped-call]


def _cloud() -> GaussianCloud:
    parts = [[0, 0, 5]], [[1, 0, 0, 0]], [[0.5, 0.5, 0.5]], [0.9], [[[0.1, 0.2, 0.3]]]
    return GaussianCloud(*(np.array(part, np.float32) for part in parts))


def _camera() -> PinholeCamera:
    return PinholeCamera.from_hfov(SIDE_PX, SIDE_PX, 1.0)
