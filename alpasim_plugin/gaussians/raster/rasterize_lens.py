"""Render through lenses and rolling shutters on the CPU, each Gaussian evaluated along each pixel's
ray. Small ones are drawn as ellipses of the image, which miss them by a level of 255 at most. The
stages are those of `rasterize_cpu`.

One order of drawing for the whole frame, by the largest of |x|, |y| and |z| of each mean in the
camera's axes: it equals z in a pinhole of up to 90 degrees, is continuous, and nothing pops between
tiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F32, F64, I64
from alpasim_plugin.gaussians.constants import POSE_ANTIALIAS, TILE
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.lens_motion import node_motions
from alpasim_plugin.gaussians.raster.lens_project_kernels import project_lens_part
from alpasim_plugin.gaussians.raster.lens_raster_kernels import composite_lens_tiles
from alpasim_plugin.gaussians.raster.lens_rays import MOTION, TileRays, camera_lens, tile_rays
from alpasim_plugin.gaussians.raster.lens_records import INVERSE_O2, LONG, SHORT
from alpasim_plugin.gaussians.raster.lens_touch_kernels import SQUARES, roll_tiles, split_wide
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image
from alpasim_plugin.gaussians.raster.prepared import Node
from alpasim_plugin.gaussians.raster.stages import (
    WORTH_THREADS,
    TileLists,
    depth_order,
    list_boxes,
    node_poses,
    run_on_threads,
)

WIDE_TILES = 40  # in a larger box the tiles are looked for that a splat touches


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
    tile_splats = drawn_splats(nodes, camera, near_m=near_m, threads=threads, starts=starts)
    return RasterOutput(*composite_lens(tile_splats, camera, None, behind, threads))


class DrawnSplats(NamedTuple):
    """The splats that reach an image: see `lens_project_kernels.project_lens_part`."""

    records: F32
    size: int
    boxes: npt.NDArray[np.int16]
    keys: F32
    ids: I64


class DrawnTiles(NamedTuple):
    """What the tiles of an image are composited of.

    Attributes:
        splats: Their records.
        tiles: Which of them each tile may show.
        lens: See `lens_rays.camera_lens`.
        motion: See `lens_motion.NodeMotions`.
    """

    splats: DrawnSplats
    tiles: TileLists
    lens: F64
    motion: F32 | None


def drawn_splats(
    nodes: Sequence[Node],
    camera: LensCamera,
    *,
    near_m: float,
    threads: int,
    starts: Sequence[F64 | None] = (),
) -> DrawnTiles:
    """Project the Gaussians of several prepared clouds and list those that each tile may show."""
    lens = camera_lens(camera)
    T_world_nodes = [T for _, T in nodes]
    poses = node_poses(T_world_nodes, camera, near_m)
    poses[:, POSE_ANTIALIAS] = [prepared.antialias_px2 for prepared, _ in nodes]
    numbers, moved, motion = node_motions(T_world_nodes, starts, camera, poses, lens)
    size = SHORT if motion is None else LONG
    room = sum(len(prepared.index) for prepared, _ in nodes)
    records = np.empty(room * size, dtype=np.float32)
    boxes = np.empty((room, 4), dtype=np.int16)
    keys = np.empty(room, dtype=np.float32)
    ids = np.empty(room, dtype=np.int64)
    motions = np.zeros(MOTION, dtype=np.float32) if motion is None else motion
    ends = np.cumsum([prepared.n_input for prepared, _ in nodes])
    parts = [
        (*prepared.arrays(), end - prepared.n_input, pose, number, shift, motions, lens, size)
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
    splats = DrawnSplats(records, size, boxes[:count], keys[:count], ids[:count])
    tiles = _listed(splats, camera, tile_rays(camera), lens, motion, threads)
    return DrawnTiles(splats, tiles, lens, motion)


def composite_lens(
    tile_splats: DrawnTiles, camera: LensCamera, kept: F32 | None, behind: F32 | None, threads: int
) -> tuple[F32, F32, F32]:
    """Return colour ``(H, W, 3)``, alpha and depth ``(H, W)``: see `composite_lens_tiles`."""
    tiles = tile_splats.tiles
    table = tile_rays(camera)
    shape = (camera.height, camera.width)
    colour = np.empty((*shape, 3), dtype=np.float32)
    alpha = np.empty(shape, dtype=np.float32)
    depth = np.empty(shape, dtype=np.float32)
    run_on_threads(
        threads,
        composite_lens_tiles,
        np.zeros(1, dtype=np.int64),
        tiles.columns,
        tiles.starts,
        tiles.lists,
        tile_splats.splats.records,
        table.rays,
        table.alive,
        table.blocks,
        tile_splats.lens,
        tile_splats.motion,
        kept,
        behind,
        colour,
        alpha,
        depth,
    )
    return colour, alpha, depth


def _listed(
    splats: DrawnSplats,
    camera: LensCamera,
    table: TileRays,
    lens: F64,
    motion: F32 | None,
    threads: int,
) -> TileLists:
    """Return the lists of the tiles; wide splats are in those alone that they touch."""
    boxes = splats.boxes
    count = len(boxes)
    tiles_x = -(-camera.width // TILE)
    tiles_y = -(-camera.height // TILE)
    sides = boxes[:, 1::2] - boxes[:, ::2]
    wide = np.flatnonzero(sides[:, 0].astype(np.int32) * sides[:, 1] > WIDE_TILES)
    wide = wide[splats.records[wide * splats.size + INVERSE_O2] >= 0]
    room = int(sides[wide, 1].sum())
    owners = np.empty(room, dtype=np.int64)
    spans = np.empty((room, 4), dtype=np.int16)
    tile_table = table.tiles
    if motion is not None:
        groups = -(-tiles_x // 16)
        tile_table = np.empty(tiles_y * groups * SQUARES, dtype=np.float32)
        roll_tiles(table.tiles, tiles_x, tiles_y, lens, tile_table)
    cursor = np.zeros(2, dtype=np.int64)
    run_on_threads(
        threads if len(wide) > 64 else 1,
        split_wide,
        cursor,
        wide,
        splats.records,
        splats.size,
        tile_table,
        lens,
        motion,
        boxes,
        owners,
        spans,
        tiles_x,
    )
    written = int(cursor[1])
    owners = owners[:written]
    keys = np.concatenate([splats.keys, splats.keys[owners]])
    ids = np.concatenate([splats.ids, splats.ids[owners]])
    boxes = np.concatenate([boxes, spans[:written]])
    owners = np.concatenate([np.arange(count), owners])
    order = depth_order(keys, ids)
    return list_boxes(order, boxes, camera.width, camera.height, threads, owners)
