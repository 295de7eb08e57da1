"""Ground height under the scene: a regular grid, bilinear in between, constant beyond its
border.
"""

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import unit
from alpasim_plugin.core.types import F64, HeightField

MAX_NODES = 30_000_000  # 240 MB of heights
SIGHT_M = 400.0  # nothing farther from a drive is built or seen, so no ground is fitted there
STACKED_M = 2.5  # points of one place that lie farther apart in height are of several roads ...
PLACE_M = 4.0  # ... where a place is a square of this side
SLOPE = 0.1  # beside a drive the ground may lie so much higher or lower per metre of distance
BUILT_WHOLE_M = 1500.0  # a longer drive is built in sections, those within `SIGHT_M` of a camera
SLOPE_SPAN_M = 1.5  # half the length over which a pose's slope is taken: about half a wheelbase


def flat(z: float = 0.0) -> HeightField:
    """Return a level ground at height ``z`` metres."""
    return HeightField(0.0, 0.0, 1.0, np.full((2, 2), float(z)))


def from_points(points: F64, cell_m: float = 2.0, drive: F64 | None = None) -> HeightField:
    """Fit a height field to scattered ground points.

    Points are averaged per cell (position and height, so a plane stays a plane), the averages are
    joined by a Delaunay triangulation that is read at the grid nodes, and nodes outside the convex
    hull take the nearest average.

    Args:
        points: ``(N, 3)`` metres, world; order does not matter.
        cell_m: Grid step in metres.
        drive: ``(T, 3)`` positions of the ego on the ground; points more than `SIGHT_M` outside the
            rectangle around them are left out, so that a large map costs no more than what is seen
            of it. Where roads lie above one another, the one at the height of the nearest position
            counts.

    Raises:
        InputError: The grid would have more than `MAX_NODES` nodes.
    """
    xyz = points.reshape(-1, 3)
    if drive is not None:
        near = np.all(
            (xyz[:, :2] >= drive[:, :2].min(axis=0) - SIGHT_M)
            & (xyz[:, :2] <= drive[:, :2].max(axis=0) + SIGHT_M),
            axis=1,
        )
        xyz = _on_level_of(drive, xyz[near]) if near.any() else drive
    low = np.floor(xyz[:, :2].min(axis=0) / cell_m) * cell_m
    nx, ny = (int(n) + 2 for n in np.floor((xyz[:, :2].max(axis=0) - low) / cell_m))
    if nx * ny > MAX_NODES:
        raise InputError(
            f"{len(xyz)} points, cell {cell_m} m: a grid of {nx} x {ny} nodes, more than {MAX_NODES}",
            "check the extent, or use a larger cell",
        )
    # The mean point ``(M, 3)`` of each occupied cell.
    ij = np.floor((xyz[:, :2] - low) / cell_m).astype(np.int64)
    _, inverse, count = np.unique(ij[:, 1] * nx + ij[:, 0], return_inverse=True, return_counts=True)
    # Sums of differences to one point: UTM-sized coordinates keep their last digits.
    sums = np.stack([np.bincount(inverse, offsets) for offsets in (xyz - xyz[0]).T], axis=1)
    means = sums / count[:, None] + xyz[0]
    xs = low[0] + cell_m * np.arange(nx)
    ys = low[1] + cell_m * np.arange(ny)
    nodes = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)  # (Ny * Nx, 2)
    z = means[scipy.spatial.KDTree(means[:, :2]).query(nodes)[1], 2]
    local = means[:, :2] - means[0, :2]
    if len(means) > 2 and np.linalg.matrix_rank(local, tol=1e-6) > 1:  # not a line of points
        inside = scipy.interpolate.LinearNDInterpolator(local, means[:, 2])(nodes - means[0, :2])
        z = np.where(np.isnan(inside), z, inside)
    return HeightField(float(low[0]), float(low[1]), float(cell_m), z.reshape(ny, nx))


def _on_level_of(drive: F64, xyz: F64) -> F64:
    """Return points ``(N, 3)`` without those of bridges above a drive and of roads below it; all of
    them where no place has two heights.
    """
    place = np.floor(xyz[:, :2] / PLACE_M).astype(np.int64)
    _, number = np.unique(place, axis=0, return_inverse=True)
    number = number.reshape(-1)
    lowest_m = np.full(number.max() + 1, np.inf)
    highest_m = np.full(number.max() + 1, -np.inf)
    np.minimum.at(lowest_m, number, xyz[:, 2])
    np.maximum.at(highest_m, number, xyz[:, 2])
    is_stacked = (highest_m - lowest_m > STACKED_M)[number]
    if not is_stacked.any():
        return xyz
    away_m, nearest = scipy.spatial.KDTree(drive[:, :2]).query(xyz[:, :2])
    apart_m = np.abs(xyz[:, 2] - drive[nearest, 2])
    least_m = np.full(number.max() + 1, np.inf)
    np.minimum.at(least_m, number, apart_m)
    most_m = np.where(is_stacked, least_m[number] + STACKED_M / 2, STACKED_M + SLOPE * away_m)
    on_level = apart_m <= most_m
    return xyz[on_level] if on_level.any() else xyz


def height_at(field: HeightField, xy: F64) -> F64:
    """Return the ground height ``(N,)`` in metres at ``(N, 2+)`` points."""
    ny, nx = field.z.shape
    u = np.clip((xy[:, 0] - field.x0_m) / field.cell_m, 0, nx - 1)
    v = np.clip((xy[:, 1] - field.y0_m) / field.cell_m, 0, ny - 1)
    i = np.minimum(u.astype(np.int64), max(nx - 2, 0))
    j = np.minimum(v.astype(np.int64), max(ny - 2, 0))
    i1 = np.minimum(i + 1, nx - 1)
    j1 = np.minimum(j + 1, ny - 1)
    fu = u - i
    fv = v - j
    low = field.z[j, i] * (1 - fu) + field.z[j, i1] * fu
    high = field.z[j1, i] * (1 - fu) + field.z[j1, i1] * fu
    return low * (1 - fv) + high * fv


def ground_pose(field: HeightField, x: float, y: float, yaw: float) -> F64:
    """Return ``T_world_rig (4, 4)`` standing on the ground with exactly this heading; see
    `ground_poses`.
    """
    return ground_poses(field, np.array([[x, y]]), np.array([yaw]))[0]


def ground_poses(field: HeightField, xy: F64, yaw: F64) -> F64:
    """Return ``T_world_rig (N, 4, 4)`` standing on the ground with exactly these headings.

    Pitch and roll follow the surface: slopes are central differences over `SLOPE_SPAN_M` along and
    across the heading, about what four wheels feel, so a step in the grid does not kick the body.
    """
    c = np.cos(yaw)
    s = np.sin(yaw)
    h = SLOPE_SPAN_M
    ahead = np.column_stack([c * h, s * h])
    left = np.column_stack([-s * h, c * h])
    samples = np.concatenate([xy, xy + ahead, xy - ahead, xy + left, xy - left])
    z = height_at(field, samples).reshape(5, -1)
    along = (z[1] - z[2]) / (2 * h)
    across = (z[3] - z[4]) / (2 * h)
    ex = np.column_stack([c, s, along]) / np.sqrt(1 + along * along)[:, None]
    ez = np.cross(ex, np.column_stack([-s, c, across]))
    ez = unit(ez)
    poses = np.zeros((len(yaw), 4, 4))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = ex, np.cross(ez, ex), ez
    poses[:, :2, 3], poses[:, 2, 3], poses[:, 3, 3] = xy, z[0], 1.0
    return poses
