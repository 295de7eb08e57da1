"""Stages that the CPU rasterisers share: poses of nodes, order of depth, lists by tile, threads.

Kernels release the interpreter lock and share work through an atomic counter, so the same compiled
code serves any number of threads, and one thread costs nothing extra. Threads are kept from call to
call; a forked process starts its own.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.kept_threads import kept_pool
from alpasim_plugin.core.types import F32, F64, I64, FloatArray
from alpasim_plugin.gaussians.camera import Posed
from alpasim_plugin.gaussians.cloud import all_rigid, require_rigid
from alpasim_plugin.gaussians.constants import (
    FAR_M,
    POSE_ANTIALIAS,
    POSE_CENTRE,
    POSE_FAR,
    POSE_NEAR,
    POSE_ROTATION,
    POSE_SIZE,
    POSE_TURN,
    TILE,
)
from alpasim_plugin.gaussians.raster.binning import count_tiles, fill_tiles, sorted_numbers

WORTH_THREADS = 4096  # splats; below, waking a second thread costs more than it saves
_IDENTITY = np.eye(4)


def node_poses(
    T_world_nodes: Sequence[FloatArray | None],
    camera: Posed,
    near_m: float,
) -> F64:
    """Pack nodes' poses relative to the camera, ``(N, POSE_SIZE)``, of clouds without antialiasing;
    all differences of large coordinates happen here, in float64.

    Args:
        T_world_nodes: Rigid transforms; None is the identity.
        camera: Seen from where.
        near_m: Near plane, metres.

    Raises:
        InputError: A transform is not rigid.
    """
    poses = [_IDENTITY, *(np.asarray(T, dtype=np.float64) for T in T_world_nodes if T is not None)]
    shaped = all(T.shape == (4, 4) for T in poses)
    if not shaped or not all_rigid(np.array(poses)):
        # The precise message is composed only where the cheap test of all nodes at once fails.
        for T in poses:
            require_rigid(T)
    T_world_node = np.array(poses)
    rotation = T_world_node[:, :3, :3]
    placed = np.zeros((len(poses), POSE_SIZE))
    placed[:, POSE_ROTATION:POSE_CENTRE] = (camera.T_camera_world[:3, :3] @ rotation).reshape(-1, 9)
    placed[:, POSE_CENTRE:POSE_ANTIALIAS] = np.einsum(
        "nji,nj->ni", rotation, camera.centre_world - T_world_node[:, :3, 3]
    )
    placed[:, POSE_NEAR], placed[:, POSE_FAR] = near_m, FAR_M
    moved = np.array([T is not None for T in T_world_nodes], dtype=bool)
    # All that stand in the world share the first
    return placed[np.where(moved, np.cumsum(moved), 0)]


def write_motion(
    poses: F64,
    T_world_nodes: Sequence[FloatArray | None],
    starts: Sequence[F64 | None],
    camera: Posed,
) -> None:
    """Write into the numbers of the nodes' poses how each moves while the shutter rolls; a node
    without both poses stands.
    """
    still = camera.motion(_IDENTITY, _IDENTITY)
    for pose, T, T_start in zip(poses, T_world_nodes, starts, strict=True):
        if T is None or T_start is None:
            pose[POSE_TURN:] = still
        else:
            pose[POSE_TURN:] = camera.motion(np.asarray(T, dtype=np.float64), T_start)


def depth_order(depths: F32, ids: I64) -> I64:
    """Return the numbers ``(N,)`` of depths nearest first, equal ones by identity ``(N,)``.

    Bits of depths sort as the depths do, which are not negative. The result does not depend on the
    order in which threads wrote the records.
    """
    bits = np.ascontiguousarray(depths).view(np.int32)
    keys = bits - bits.min(initial=np.iinfo(np.int32).max)
    order: I64
    order, tied = sorted_numbers(keys, int(keys.max(initial=0)).bit_length())
    if len(tied):
        splats = order[tied]
        # Equal depths lie side by side, so the tied ones alone, sorted again, fill their places.
        order[tied] = splats[np.lexsort((ids[splats], keys[splats]))]
    return order


@dataclass(frozen=True, eq=False)
class TileLists:
    """Which visible splats each tile may show, nearest first.

    Attributes:
        columns: Tiles in a row of tiles.
        starts: int64, where each tile's list begins, and the end of the last.
        lists: int32, numbers of records, in the order of depth within a tile.
    """

    columns: int
    starts: I64
    lists: npt.NDArray[np.int32]


def list_boxes(
    order: I64,
    by_record: npt.NDArray[np.int16],
    width: int,
    height: int,
    threads: int,
    owners: I64 | None = None,
) -> TileLists:
    """List projected records per tile.

    Args:
        order: That of `depth_order`.
        by_record: ``(N, 4)``, see `binning.tile_boxes`.
        width, height: Pixels of the image.
        threads: How many threads to use.
        owners: ``(N,)``, the record of each box; None: a box is that of the record with its number.
    """
    count = len(order)
    tiles_x = -(-width // TILE)
    tiles_y = -(-height // TILE)
    # At most 64 chunks of at least 8192 splats: enough to share out, few enough to keep their tile
    # counts small.
    chunk_size = max(8192, -(-count // 64))
    boxes = np.empty_like(by_record)
    changes = np.empty((-(-count // chunk_size), tiles_y + 1, tiles_x + 1), dtype=np.int32)
    workers = min(threads, max(1, len(changes) // 4))  # a millisecond of work for each
    cursor = np.zeros(1, dtype=np.int64)
    run_on_threads(workers, count_tiles, cursor, chunk_size, order, by_record, boxes, changes)
    counts = changes.cumsum(axis=1).cumsum(axis=2)[:, :-1, :-1].reshape(-1, tiles_x * tiles_y)
    starts = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    before = np.cumsum(counts, axis=0) - counts
    lists = np.empty(starts[-1], dtype=np.int32)
    cursor[:] = 0
    splats = order if owners is None else owners[order]
    chunks = (cursor, chunk_size, splats, boxes)
    run_on_threads(workers, fill_tiles, *chunks, tiles_x, starts[:-1] + before, lists)
    return TileLists(tiles_x, starts, lists)


def thread_count(threads: int | None) -> int:
    """Return how many threads to use: the argument, or numba's current setting.

    Raises:
        InputError: Fewer than one.
    """
    if threads is None:
        import numba

        return int(numba.get_num_threads())
    if threads < 1:
        raise InputError(
            f"threads={threads}: no thread to work with",
            "give at least 1, or None for the default",
        )
    return threads


def map_on_threads(threads: int, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Return what a function makes of each item, in their order; a thread that is free takes the
    next.

    An exception in any of them is raised here, after all have ended.
    """
    if min(threads, len(items)) <= 1:
        return [function(item) for item in items]
    with _pool(min(threads, len(items))) as pool:
        results = [pool.submit(function, item) for item in items]
        wait(results)
    return [result.result() for result in results]


def run_on_threads(threads: int, function: Callable[..., None], *args: Any) -> None:
    """Call ``function(*args)`` on each of ``threads`` threads, this one included, and return when
    all have ended.

    An exception in any of them is raised here.
    """
    if threads == 1:
        function(*args)
        return
    with _pool(threads - 1) as pool:
        others = [pool.submit(function, *args) for _ in range(threads - 1)]
        try:
            function(*args)
        finally:
            wait(others)
    for other in others:
        other.result()


@contextmanager
def _pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Yield a pool of threads.

    That of the main thread is kept, because starting threads takes as long as their work in a small
    image. Another thread may be one of a kept pool, and would wait for itself: it gets a pool of its
    own, for the time of the block.
    """
    if threading.current_thread() is threading.main_thread():
        yield kept_pool(threads)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield pool
