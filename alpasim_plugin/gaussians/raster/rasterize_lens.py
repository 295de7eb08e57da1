"""Render through lenses and rolling shutters on the CPU, each Gaussian evaluated along each pixel's
ray; the stages are those of `rasterize_cpu`.

One order of drawing for the whole frame, by the largest of |x|, |y| and |z| of each mean in the
camera's axes: it equals z in a pinhole of up to 90 degrees, is continuous, and nothing pops between
tiles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.gaussians.constants import POSE_ANTIALIAS, POSE_SHIFT, POSE_TURN
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.lens_project_kernels import LONG, SHORT, project_lens_part
from alpasim_plugin.gaussians.raster.lens_raster_kernels import composite_lens_tiles
from alpasim_plugin.gaussians.raster.lens_rays import (
    LENS_SHIFT,
    MOTION,
    MOTION_SPEED,
    MOTION_TURN,
    camera_lens,
    node_motion,
    tile_rays,
)
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image
from alpasim_plugin.gaussians.raster.prepared import Node
from alpasim_plugin.gaussians.raster.stages import (
    WORTH_THREADS,
    depth_order,
    list_boxes,
    node_poses,
    run_on_threads,
    write_motion,
)

STRAIGHT_RAD = 1e-5  # a road user that turns less in a shutter moves along a line


def rasterize_lens(
    nodes: Sequence[Node],
    camera: LensCamera,
    background: Background,
    *,
    near_m: float,
    threads: int,
    starts: Sequence[F64 | None] = (),
) -> RasterOutput:
    """Render several prepared clouds in one image; see `rasterize_cpu.rasterize_prepared`.

    Returns:
        Colour, alpha, and as depth the mean distance from the camera's centre, metres. Where the
        lens sees nothing it is black and opaque.
    """
    behind = background_image(background, camera)
    lens = camera_lens(camera)
    table_of_rays = tile_rays(camera)
    poses = node_poses([T for _, T in nodes], camera, near_m)
    poses[:, POSE_ANTIALIAS] = [prepared.antialias_px2 for prepared, _ in nodes]
    numbers, moved, motion = _motions(nodes, starts, camera, poses, lens)
    size = SHORT if motion is None else LONG
    room = sum(len(prepared.index) for prepared, _ in nodes)
    records = np.empty(room * size, dtype=np.float32)
    boxes = np.empty((room, 4), dtype=np.int16)
    keys = np.empty(room, dtype=np.float32)
    ids = np.empty(room, dtype=np.int64)
    ends = np.cumsum([prepared.n_input for prepared, _ in nodes])
    parts = [
        (*prepared.arrays(), end - prepared.n_input, pose, number, shift, lens, size)
        for (prepared, _), end, pose, number, shift in zip(
            nodes, ends, poses, numbers, moved, strict=True
        )
    ]
    cursor = np.zeros(len(parts) + 1, dtype=np.int64)

    def project() -> None:
        for place, part in enumerate(parts):
            project_lens_part(cursor, place, *part, records, boxes, keys, ids)

    run_on_threads(threads if room > WORTH_THREADS else 1, project)
    count = int(cursor[0])
    order = depth_order(keys[:count], ids[:count])
    tiles = list_boxes(order, boxes[:count], camera.width, camera.height, threads)
    shape = (camera.height, camera.width)
    colour = np.empty((*shape, 3), dtype=np.float32)
    alpha = np.empty(shape, dtype=np.float32)
    depth = np.empty(shape, dtype=np.float32)
    lists = (np.zeros(1, dtype=np.int64), tiles.columns, tiles.starts, tiles.lists, records)
    rays = (table_of_rays.rays, table_of_rays.alive, table_of_rays.blocks, lens)
    run_on_threads(
        threads, composite_lens_tiles, *lists, *rays, motion, behind, colour, alpha, depth
    )
    return RasterOutput(colour, alpha, depth)


def _motions(
    nodes: Sequence[Node], starts: Sequence[F64 | None], camera: LensCamera, poses: F64, lens: F64
) -> tuple[list[int], list[F64], F32 | None]:
    """Write into the numbers of the nodes' poses how each moves as the camera sees it; return the
    place of each node's own motion in the world, -1 where it does not turn, by how much the camera
    moves as each sees it ``(3,)``, and the motions of those that turn; None of a global shutter.
    """
    rolling = camera.rolling
    camera_shift = lens[LENS_SHIFT : LENS_SHIFT + 3].copy()
    if rolling is None:
        poses[:, POSE_TURN : POSE_SHIFT + 3] = 0.0
        return [-1] * len(nodes), [camera_shift] * len(nodes), None
    write_motion(poses, nodes, starts or [None] * len(nodes), camera)
    numbers: list[int] = []
    moved: list[F64] = []
    motions: list[F32] = []
    for (_, T), start in zip(nodes, starts or [None] * len(nodes), strict=True):
        number = -1
        shift = camera_shift
        if T is not None and start is not None:
            motion = node_motion(camera, rolling, np.asarray(T, dtype=np.float64), start)
            shift = camera_shift - motion[MOTION_SPEED : MOTION_SPEED + 3]
            if np.linalg.norm(motion[MOTION_TURN : MOTION_TURN + 3]) > STRAIGHT_RAD:
                number = len(motions)
                motions.append(motion)
        numbers.append(number)
        moved.append(shift)
    table = np.concatenate(motions) if motions else np.zeros(MOTION, dtype=np.float32)
    return numbers, moved, table
