"""Render on the CPU: project, sort, list per tile, composite; each stage on all threads."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.files.places import require_kernels
from alpasim_plugin.core.types import F32, F64, I64
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import NEAR_M, POSE_ANTIALIAS, RECORD, TILE, Z
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.binning import tile_boxes
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image
from alpasim_plugin.gaussians.raster.prepared import Node, PreparedCloud, prepare
from alpasim_plugin.gaussians.raster.project_kernels import project_part
from alpasim_plugin.gaussians.raster.raster_kernels import composite_tiles
from alpasim_plugin.gaussians.raster.stages import (
    WORTH_THREADS,
    TileLists,
    depth_order,
    list_boxes,
    node_poses,
    run_on_threads,
    thread_count,
    write_motion,
)

Part = tuple[Any, ...]
_prepared: weakref.WeakKeyDictionary[GaussianCloud, PreparedCloud] = weakref.WeakKeyDictionary()


def rasterize_prepared(
    nodes: Sequence[Node],
    camera: PinholeCamera | LensCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    threads: int | None = None,
    starts: Sequence[F64 | None] = (),
) -> RasterOutput:
    """Render several prepared clouds, each at its rigid pose, in one image.

    Args:
        nodes: ``(prepared, T_world_node)`` pairs; None stands for the identity (a background in
            world coordinates). Equal depths are drawn in the order of the nodes.
        camera: From where; through a lens see `rasterize_lens`.
        background: ``(r, g, b)`` or an ``(H, W, 3)`` image behind everything.
        near_m: Gaussians whose centre is nearer are left out.
        threads: How many threads to use; None takes ``numba.get_num_threads()``. The image does not
            depend on it.
        starts: Poses of the nodes at the start of the camera's rolling shutter; those above are
            then of its middle.

    Raises:
        InputError: A transform is not rigid or the background does not fit.
        InfrastructureError: Kernels cannot be compiled: no folder can be written.
    """
    require_kernels()
    threads = thread_count(threads)
    if isinstance(camera, LensCamera):
        # Its kernels are looked up only where somebody looks through a lens: a tenth of a second.
        from alpasim_plugin.gaussians.raster.rasterize_lens import rasterize_lens

        return rasterize_lens(
            nodes, camera, background, near_m=near_m, threads=threads, starts=starts
        )
    behind = background_image(background, camera)
    view = camera_numbers(camera)
    T_world_nodes = [T for _, T in nodes]
    poses = node_poses(T_world_nodes, camera, near_m)
    poses[:, POSE_ANTIALIAS] = [prepared.antialias_px2 for prepared, _ in nodes]
    if camera.rolling is not None:
        write_motion(poses, T_world_nodes, starts, camera)
    ends = np.cumsum([prepared.n_input for prepared, _ in nodes])
    parts: list[Part] = [
        (*prepared.arrays(), end - prepared.n_input, pose)
        for (prepared, _), end, pose in zip(nodes, ends, poses, strict=True)
    ]
    room = sum(len(prepared.index) for prepared, _ in nodes)
    records = np.empty(room * RECORD, dtype=np.float32)
    ids = np.empty(room, dtype=np.int64)
    workers = threads if room > WORTH_THREADS else 1
    cursor = np.zeros(len(parts) + 1, dtype=np.int64)
    groups = [len(prepared.index) // 16 for prepared, _ in nodes]

    def project() -> None:
        for number, part in enumerate(parts):
            # A call costs more than the check whether another thread has taken the whole part.
            if cursor[number + 1] < groups[number]:
                project_part(cursor, number, *part, view, records, ids)

    run_on_threads(workers, project)
    count = int(cursor[0])

    order = depth_order(records[Z : count * RECORD : RECORD], ids[:count])
    tiles = list_per_tile(order, records, camera, threads)
    return RasterOutput(*composite(tiles, records, None, behind, camera, threads))


def camera_numbers(camera: PinholeCamera) -> F32:
    """Return a camera as the kernels read it, columns ``CAM_*``."""
    low_x, high_x, low_y, high_y = camera.slope_limits()
    rolling = camera.rolling
    return np.array(
        [
            *(camera.fx, camera.fy, camera.cx, camera.cy),
            *(low_x, high_x, low_y, high_y),
            *(camera.width, camera.height),
            *((0.0, 0.0, 0.0, 0.0) if rolling is None else (*rolling.time, rolling.reach_px)),
        ],
        dtype=np.float32,
    )


def list_per_tile(order: I64, records: F32, camera: PinholeCamera, threads: int) -> TileLists:
    """List projected records per tile; ``order`` is that of `depth_order`."""
    boxes = np.empty((len(order), 4), dtype=np.int16)
    tile_boxes(records, -(-camera.width // TILE), -(-camera.height // TILE), boxes)
    return list_boxes(order, boxes, camera.width, camera.height, threads)


def composite(
    tiles: TileLists,
    records: F32,
    kept: F32 | None,
    behind: F32 | None,
    camera: PinholeCamera,
    threads: int,
) -> tuple[F32, F32, F32]:
    """Return the image ``(H, W, 3)``, alpha ``(H, W)`` and depth ``(H, W)``, metres, before a
    background; without one the sums of weighted colours and depths. See `composite_tiles`.
    """
    shape = (camera.height, camera.width)
    colour = np.empty((*shape, 3), dtype=np.float32)
    alpha = np.empty(shape, dtype=np.float32)
    depth_sum = np.empty(shape, dtype=np.float32)
    lists = (np.zeros(1, dtype=np.int64), tiles.columns, tiles.starts, tiles.lists, records)
    run_on_threads(threads, composite_tiles, *lists, kept, behind, colour, alpha, depth_sum)
    return colour, alpha, depth_sum


def rasterize_cpu(
    cloud: GaussianCloud,
    camera: PinholeCamera | LensCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    threads: int | None = None,
) -> RasterOutput:
    """Render one cloud in world coordinates.

    The prepared form of a cloud is kept as long as the cloud lives, so repeated frames of one cloud
    are fast. Arrays that a cloud was built from are therefore not to be changed in place (those of
    the cloud itself are read-only).
    """
    prepared = _prepared.get(cloud)
    if prepared is None:
        prepared = _prepared[cloud] = prepare(cloud)
    return rasterize_prepared(
        [(prepared, None)], camera, background, near_m=near_m, threads=threads
    )
