"""Lane lines and edges of the road as a camera sees them, in metres on the ground: what a lane detector
should find.

    ROOT/SPLIT/SEQUENCE/lanes.npy  (T, L, 29) float32  lateral positions of every frame at 3, 5, ... 59 m ahead, metres,
                                   right positive; NaN where a line is not, or outside the image
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.arrays import open_npy
from alpasim_plugin.core.types import F64, CameraSpec, LaneMap
from alpasim_plugin.lab.video_metrics.lanes import SAMPLES_M
from alpasim_plugin.world.markings import marking_lines

LANES_FILE = "lanes.npy"
ALIKE_M = 0.7  # mean distance up to which two lines are one, such as a double line
FEWEST_SAMPLES = 2
WIDEST_M = 12.0  # to the side


def lines_of(lane_map: LaneMap) -> list[F64]:
    """Return the lane lines and the edges of the road of a map, ``(N, 3)`` metres, world."""
    return [line for line, _ in marking_lines(lane_map)] + list(lane_map.road_edges)


def lateral_positions(lines: Sequence[F64], camera: CameraSpec, T_world_camera: F64) -> F64:
    """Return where lines run before a camera ``(L, 29)``, metres, right positive, at `SAMPLES_M` ahead
    of it; lines that run together are one.

    Args:
        lines: ``(N, 3)`` each, metres, world.
        camera: A pinhole camera: positions outside its image are left out.
        T_world_camera: ``(4, 4)``.
    """
    forward = T_world_camera[:2, 2] / np.linalg.norm(T_world_camera[:2, 2])
    right = np.array([forward[1], -forward[0]])
    widest = SAMPLES_M * camera.width / (2.0 * camera.K[0, 0])
    rows: list[F64] = []
    for line in lines:
        relative = line[:, :2] - T_world_camera[:2, 3]
        row = _crossings(relative @ right, relative @ forward)
        row[~(np.abs(row) <= np.minimum(widest, WIDEST_M))] = np.nan
        if np.sum(~np.isnan(row)) >= FEWEST_SAMPLES and not any(_alike(row, x) for x in rows):
            rows.append(row)
    return np.array(rows).reshape(-1, len(SAMPLES_M))


def _crossings(x: F64, y: F64) -> F64:
    """Return x ``(29,)`` where a polyline crosses the samples ahead, the nearest to the middle where
    it does so several times; NaN where it does not.
    """
    before, after = y[:-1, None], y[1:, None]
    crosses = (np.minimum(before, after) <= SAMPLES_M) & (np.maximum(before, after) > SAMPLES_M)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (SAMPLES_M - before) / (after - before)
    positions = np.where(crosses, x[:-1, None] + share * (x[1:] - x[:-1])[:, None], np.inf)
    if not len(positions):
        return np.full(len(SAMPLES_M), np.nan)
    nearest = np.take_along_axis(positions, np.argmin(np.abs(positions), axis=0)[None], axis=0)[0]
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _alike(row: F64, other: F64) -> bool:
    common = ~np.isnan(row) & ~np.isnan(other)
    return bool(common.any()) and float(np.abs(row - other)[common].mean()) < ALIKE_M


def write_lanes(folder: Path, frames: Sequence[F64]) -> None:
    """Write the lines of every frame of a sequence, ``(L, 29)`` each, into its folder."""
    most = max((len(rows) for rows in frames), default=0)
    out = np.full((len(frames), most, len(SAMPLES_M)), np.nan, dtype=np.float32)
    for frame, rows in zip(out, frames, strict=True):
        frame[: len(rows)] = rows
    np.save(folder / LANES_FILE, out)


def has_lanes(folder: Path) -> bool:
    """Whether the lines of a sequence are known."""
    return (folder / LANES_FILE).is_file()


def read_lanes(folder: Path) -> list[F64]:
    """Return the lines of every frame of a sequence, ``(L, 29)`` each.

    Raises:
        InputError: The sequence has none.
    """
    if not has_lanes(folder):
        raise InputError(
            f"{folder}: no {LANES_FILE}", "Remove the folder and run 'simrun train pairs' again."
        )
    frames = np.asarray(open_npy(folder / LANES_FILE, "run 'simrun train pairs' again"))
    return [rows[~np.isnan(rows).all(axis=1)].astype(np.float64) for rows in frames]
