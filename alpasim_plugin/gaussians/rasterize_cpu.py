"""Render prepared nodes on the CPU."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import NEAR_M
from alpasim_plugin.gaussians.output import Background, RasterOutput
from alpasim_plugin.gaussians.prepared import Node, prepare
from alpasim_plugin.gaussians.rasterize_reference import rasterize_reference


def rasterize_prepared(
    nodes: Sequence[Node],
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    lod_px: float = 0.0,
    threads: int | None = None,
) -> RasterOutput:
    """Render several prepared clouds, each at its rigid pose, in one image.

    Args:
        nodes: ``(prepared, T_world_node)`` pairs; None stands for the identity (a background in world coordinates). Equal depths are
            drawn in the order of the nodes.
        camera: From where.
        background: ``(r, g, b)`` or an ``(H, W, 3)`` image behind everything.
        near_m: Gaussians whose centre is nearer are left out.
        lod_px: Gaussians whose radius before the low-pass is smaller are left out; 0 draws all.
        threads: How many threads to use; None takes ``numba.get_num_threads()``. The image does not depend on it.

    Raises:
        InputError: A transform is not rigid or the background does not fit.
    """
    clouds = [p.cloud if T is None else p.cloud.transformed(np.asarray(T), p.sh_frame == "object") for p, T in nodes]
    return rasterize_reference(GaussianCloud.concatenate(clouds), camera, background, near_m=near_m, lod_px=lod_px)


def rasterize_cpu(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    lod_px: float = 0.0,
    threads: int | None = None,
) -> RasterOutput:
    """Render one cloud in world coordinates; for repeated frames `prepare` it once and call `rasterize_prepared`."""
    return rasterize_prepared([(prepare(cloud), None)], camera, background, near_m=near_m, lod_px=lod_px, threads=threads)
