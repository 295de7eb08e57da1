"""What stands in a reconstruction and can be hit: upright boxes around opaque Gaussians between 0.3
and 2 m above the ground.

A splat has no bodies: without these a car drives through a parked one and nothing is measured. What
the recorded car drove through is free by that fact; opaque Gaussians there are errors of the fit,
are left out, and are counted.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from alpasim_plugin.core.geometry import heading_of, left_of, matrix_from_quat
from alpasim_plugin.core.types import (
    F64,
    I64,
    STANDING_ID,
    Bool,
    Box,
    HeightField,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.drives.ground import PathFrame
from alpasim_plugin.drives.source import Points
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.world.ground import height_at
from scenarios.drive import Obstacle

LOW_M = 0.3  # above the ground: below is kerb and grass
HIGH_M = 2.0  # above the ground: a car passes under what is higher
OPAQUE = 0.3  # least opacity of a Gaussian that counts
LARGEST_M = 0.6  # of a Gaussian that counts; larger ones are background, or blur
CELL_M = 0.2  # of the grid
PIECE_M = 1.0  # of the path: a box does not reach beyond its piece
REACH_M = 9.0  # from the path
LEAST_M2 = 0.06  # of opaque surface in a column of a cell: a wall has 0.34
FEWEST = 3  # cells of something that stands
# a gap in something that no car fits into is closed: dark doors and windows leave some in parked
# cars
GAP_M = 1.2
SPARE_M = 0.1  # beside the recorded car that it drove through unhurt
UNSEEN_M = 0.5  # uncertainty where no point is near
NEAR_M = 1.0


@dataclass(frozen=True, eq=False)
class Standing:
    """Obstacles, and how many cells of the driven path were opaque by mistake."""

    obstacles: tuple[Obstacle, ...]
    cleared: int


def standing_obstacles(
    cloud: GaussianCloud, points: Points, ground: HeightField, ego: Trajectory, vehicle: Vehicle
) -> Standing:
    """Return what stands beside a driven path.

    Args:
        cloud: The reconstruction's background, world.
        points: Triangulated or measured points, world; their spread near an obstacle is its
            uncertainty.
        ground: Height field.
        ego: Recorded rig poses.
        vehicle: The recorded car, which hit nothing.
    """
    places, area = _samples(cloud)
    frame = PathFrame(ego.xyz, 1.0)
    s, left, _ = frame.place(places)
    above = places[:, 2] - height_at(ground, places)
    near = (
        (above > LOW_M)
        & (above < HIGH_M)
        & (np.abs(left) < REACH_M)
        & (s > frame.s[0])
        & (s < frame.s[-1])
    )
    places, area, above = places[near], area[near], above[near]
    low = ego.xyz[:, :2].min(axis=0) - REACH_M - 30.0
    cells = np.floor((places[:, :2] - low) / CELL_M).astype(np.int64)
    if not len(cells):
        return Standing((), 0)
    grid = np.zeros(cells.max(axis=0) + 3)
    np.add.at(grid, (cells[:, 0] + 1, cells[:, 1] + 1), area)
    occupied = grid > LEAST_M2
    # The cells that the recorded car drove over.
    x, y = np.meshgrid(
        np.arange(grid.shape[0]) - 0.5, np.arange(grid.shape[1]) - 0.5, indexing="ij"
    )
    s, left, _ = frame.place(low + np.column_stack([x.ravel(), y.ravel()]) * CELL_M)
    end_m = frame.s[-1] + frame.s[0] + vehicle.box.length_m
    inside = (np.abs(left) < vehicle.box.width_m / 2 + SPARE_M) & (s > -1.0) & (s < end_m)
    driven = inside.reshape(grid.shape)
    cleared = int((occupied & driven).sum())
    occupied = scipy.ndimage.binary_closing(occupied, _disc(GAP_M / 2)) & ~driven
    label, _ = scipy.ndimage.label(occupied, structure=np.ones((3, 3)))
    sizes = np.bincount(label.ravel())
    sizes[0] = 0
    kept = np.argwhere((sizes >= FEWEST)[label] & occupied)
    centres = low + (kept - 0.5) * CELL_M  # the cells' middles: the grid has a border of one cell
    tops = np.zeros(grid.shape)
    cells = np.floor((places[:, :2] - low) / CELL_M).astype(np.int64) + 1
    np.maximum.at(tops, (cells[:, 0], cells[:, 1]), above)
    tops = np.where(tops > 0, tops, scipy.ndimage.grey_dilation(tops, footprint=_disc(GAP_M / 2)))[
        kept[:, 0], kept[:, 1]
    ]
    return Standing(tuple(_boxes(centres, kept, tops, frame, ground, points)), cleared)


def _disc(radius_m: float) -> Bool:
    n = int(radius_m / CELL_M)
    x, y = np.mgrid[-n : n + 1, -n : n + 1]
    return np.hypot(x, y) <= radius_m / CELL_M


def _samples(cloud: GaussianCloud) -> tuple[F64, F64]:
    """Return points ``(N, 3)`` on the opaque Gaussians, their middles and their ends, and the
    surface ``(N,)`` that each stands for.
    """
    cloud = cloud.take((cloud.opacities > OPAQUE) & (cloud.scales.max(axis=1) < LARGEST_M))
    means, quats, scales, opacities = (
        np.asarray(array, dtype=np.float64)
        for array in (cloud.means, cloud.quats, cloud.scales, cloud.opacities)
    )
    order = np.argsort(-scales, axis=1)[:, :2]
    axes = np.take_along_axis(matrix_from_quat(quats), order[:, None, :], axis=2)  # (N, 3, 2)
    sizes = np.take_along_axis(scales, order, axis=1)
    ends = np.moveaxis(axes * sizes[:, None, :], 2, 0)
    positions = [means, *(means + sign * end for end in ends for sign in (1, -1))]
    surface = np.pi * sizes[:, 0] * sizes[:, 1] * opacities / len(positions)
    return np.concatenate(positions), np.tile(surface, len(positions))


def _boxes(
    centres: F64, cells: I64, tops: F64, frame: PathFrame, ground: HeightField, points: Points
) -> list[Obstacle]:
    """Return boxes around cells ``(N, 2)`` that are connected within a piece of the path, along the
    path's own direction.
    """
    s, left, _ = frame.place(centres)
    group = np.stack([np.floor(s / PIECE_M), left > 0], axis=1)
    pairs = scipy.spatial.KDTree(cells).query_pairs(1.5, output_type="ndarray")
    pairs = pairs[(group[pairs[:, 0]] == group[pairs[:, 1]]).all(axis=1)]
    near = scipy.sparse.coo_matrix(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells))
    )
    count, label = scipy.sparse.csgraph.connected_components(near, directed=False)
    tree = scipy.spatial.KDTree(points.xyz[:, :2]) if len(points) else None
    out: list[Obstacle] = []
    for number in range(count):
        in_group = label == number
        k = int(np.clip(np.searchsorted(frame.s, s[in_group].mean()), 0, len(frame.s) - 1))
        along = frame.along[k]
        across = left_of(along)
        u = centres[in_group] @ along
        v = centres[in_group] @ across
        middle = along * (u.max() + u.min()) / 2 + across * (v.max() + v.min()) / 2
        top = float(tops[in_group].max())
        base = float(height_at(ground, middle[None])[0])
        spread = UNSEEN_M
        if tree is not None:
            close = tree.query_ball_point(middle, NEAR_M + float(np.ptp(v)) / 2)
            spread = float(np.median(points.spread[close])) if close else UNSEEN_M
        uncertainty = round(float(np.hypot(CELL_M / 2, spread)), 2)
        box = Box(float(np.ptp(u)) + CELL_M, float(np.ptp(v)) + CELL_M, top)
        name = f"{STANDING_ID}{len(out) + 1:03d}-within-{uncertainty:g}m"
        heading_rad = float(heading_of(along))
        xyz = np.array([*middle, base + top / 2])
        out.append(Obstacle(name, box, xyz, heading_rad, uncertainty))
    return out
