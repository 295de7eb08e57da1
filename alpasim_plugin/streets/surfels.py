"""Turn surfaces into flat Gaussians (surfels), of which every built scene consists.

A rectangle is covered by a grid of flat Gaussians with a standard deviation of `SPREAD` cells. At
0.64 cells the weakest point of the grid (a cell corner) still accumulates an opacity of about 0.97
while the outline stays within a quarter of a cell of the true edge.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.geometry import quat_from_matrix, quat_from_yaw, unit
from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.gaussians.cloud import GaussianCloud, quat_multiply
from alpasim_plugin.gaussians.sh import C1, dc_from_rgb

SPREAD = 0.64  # standard deviation per cell size
THICKNESS = 0.08  # standard deviation across the surface, per cell size
OPACITY = 0.985
IDENTITY = (1.0, 0.0, 0.0, 0.0)  # a quaternion along the axes


def cloud_of(
    means: npt.ArrayLike,
    quats: npt.ArrayLike,
    scales: npt.ArrayLike,
    rgb: npt.ArrayLike,
    opacity: npt.ArrayLike = OPACITY,
) -> GaussianCloud:
    """Return Gaussians of one colour each.

    Args:
        means: ``(N, 3)`` metres.
        quats: ``(N, 4)`` wxyz; this and what follows may be one for all.
        scales: ``(N, 3)`` metres.
        rgb: ``(N, 3)`` 0..1.
        opacity: ``(N,)``.
    """
    centres = np.asarray(means, dtype=np.float64)
    n = len(centres)
    colours = np.clip(np.broadcast_to(rgb, (n, 3)), 0.0, 1.0)
    return GaussianCloud(
        centres,
        np.array(np.broadcast_to(quats, (n, 4)), dtype=np.float32),
        np.array(np.broadcast_to(scales, (n, 3)), dtype=np.float32),
        np.array(np.broadcast_to(opacity, (n,)), dtype=np.float32),
        dc_from_rgb(colours)[:, None, :].astype(np.float32),
    )


def with_sheen(
    cloud: GaussianCloud, normals: F64, strength: F64, sky_rgb: Sequence[float]
) -> GaussianCloud:
    """Return the cloud with first-degree colour: surfaces seen at a glancing angle show more of the
    sky.

    The share of sky added is ``strength * (1 + d . n)`` for view direction d and normal n, the
    linear part of what varnish and glass do.

    Args:
        cloud: Gaussians of constant colour.
        normals: ``(N, 3)`` outward, the cloud's frame.
        strength: ``(N,)``, 0 for matt.
        sky_rgb: Colour that is mirrored.
    """
    add = np.outer(strength, sky_rgb)  # (N, 3)
    sh = np.zeros((len(cloud), 4, 3), dtype=np.float32)
    sh[:, 0] = cloud.sh[:, 0] + dc_from_rgb(0.5 + add)
    for k, axis, sign in ((1, 1, -1.0), (2, 2, 1.0), (3, 0, -1.0)):
        sh[:, k] = sign * normals[:, axis, None] * add / C1
    return replace(cloud, sh=sh)


def upright_quats(normals: F64, yaw_rad: npt.ArrayLike) -> F64:
    """Return ``(N, 4)`` rotations that lay the xy plane across nearly vertical normals ``(N, 3)``
    after turning it by a heading.
    """
    nx, ny, nz = normals.T
    tilt = np.column_stack([1 + nz, -ny, nx, np.zeros_like(nz)])
    tilt = unit(tilt)
    return quat_multiply(tilt, np.broadcast_to(quat_from_yaw(yaw_rad), tilt.shape))


def quats_along(direction: F64, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> F64:
    """Return ``(N, 4)`` rotations whose x axis is ``direction (N, 3)`` and whose z axis is as near
    to ``up`` as can be.
    """
    x = unit(direction)
    ups = np.broadcast_to(up, x.shape)
    steep = np.abs(np.sum(x * ups, axis=1, keepdims=True)) > 0.99
    y = np.cross(np.where(steep, np.array([1.0, 0.0, 0.0]), ups), x)
    y = unit(y)
    return quat_from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))


def cell_counts(length_m: F64, cell_m: float | F64) -> I64:
    """Return how many cells of a size cover lengths, at least one each."""
    return np.maximum(np.round(length_m / cell_m), 1).astype(np.int64)


def grid_cells(n_u: I64, n_v: I64) -> tuple[I64, F64, F64]:
    """Enumerate the cells of M grids at once.

    Args:
        n_u: ``(M,)`` cells along the first edge.
        n_v: ``(M,)`` cells along the second.

    Returns:
        Per cell: the grid's index, and the cell centre as shares ``u, v`` of the two edges, 0..1.
    """
    count = n_u * n_v
    owner = np.repeat(np.arange(len(count)), count)
    first = np.concatenate([[0], np.cumsum(count)[:-1]]) if len(count) else count
    k = np.arange(len(owner)) - first[owner]
    return owner, (k % n_u[owner] + 0.5) / n_u[owner], (k // n_u[owner] + 0.5) / n_v[owner]


def quad_surfels(
    corners: F64, rgb: F64, cell_m: float | F64, noise: F64 | None = None, spread: float = SPREAD
) -> tuple[GaussianCloud, I64, F64]:
    """Cover quadrilaterals with flat Gaussians.

    Args:
        corners: ``(M, 4, 3)``: start, end of the first edge, opposite corner, end of the second
            edge; outward is first x second edge.
        rgb: ``(M, 3)`` 0..1.
        cell_m: Cell size, one for all or ``(M,)``.
        noise: Standard normal numbers, reused where they are fewer than Gaussians; brightness
            varies by 2.5 % of them. None: no variation.
        spread: Standard deviation per cell; wider closes dark surfaces against bright ones behind,
            at the price of a softer outline.

    Returns:
        The cloud, each Gaussian's quadrilateral ``(N,)``, and each quadrilateral's normal ``(M,
        3)``.
    """
    c = corners.reshape(-1, 4, 3)
    edge_u = (c[:, 1] - c[:, 0] + c[:, 2] - c[:, 3]) / 2
    edge_v = (c[:, 3] - c[:, 0] + c[:, 2] - c[:, 1]) / 2
    len_u = np.linalg.norm(edge_u, axis=1)
    len_v = np.linalg.norm(edge_v, axis=1)
    n_u = cell_counts(len_u, cell_m)
    n_v = cell_counts(len_v, cell_m)
    x = edge_u / np.maximum(len_u, 1e-9)[:, None]
    normal = np.cross(edge_u, edge_v)
    normal = unit(normal)
    quats = quat_from_matrix(np.stack([x, np.cross(normal, x), normal], axis=-1))
    size_u = len_u / n_u
    size_v = len_v / n_v
    scales = np.column_stack(
        [spread * size_u, spread * size_v, THICKNESS * np.minimum(size_u, size_v) + 0.004]
    )
    owner, u, v = grid_cells(n_u, n_v)
    u = u[:, None]
    v = v[:, None]
    corner = c[owner]
    means = (corner[:, 0] * (1 - u) + corner[:, 1] * u) * (1 - v) + (
        corner[:, 3] * (1 - u) + corner[:, 2] * u
    ) * v
    colour = rgb[owner]
    if noise is not None:
        colour = colour * (1 + 0.025 * np.resize(noise, len(owner))[:, None])
    return cloud_of(means, quats[owner], scales[owner], colour), owner, normal


def rods(
    start: F64, end: F64, radius_m: npt.ArrayLike, rgb: npt.ArrayLike, step_m: float
) -> GaussianCloud:
    """Draw straight rods as chains of long Gaussians.

    Args:
        start: ``(M, 3)`` metres.
        end: ``(M, 3)`` metres.
        radius_m: One for all or ``(M,)``.
        rgb: One for all or ``(M, 3)``, 0..1.
        step_m: Length of one link.
    """
    length = np.linalg.norm(end - start, axis=1)
    n = cell_counts(length, step_m)
    owner, s, _ = grid_cells(n, np.ones_like(n))
    radius = 0.75 * np.broadcast_to(radius_m, (len(n),))[owner]
    along = (end - start)[owner]
    scales = np.column_stack([SPREAD * (length / n)[owner], radius, radius])
    colours = np.broadcast_to(rgb, (len(n), 3))[owner]
    return cloud_of(start[owner] + s[:, None] * along, quats_along(along), scales, colours)
