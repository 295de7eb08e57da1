"""Build the ground: asphalt with its wear, paint, pavements and grass, as flat Gaussians whose size follows what is to be seen there.

The plan is painted as an image (0.125 m near the path, 0.5 m beyond), and a quadtree over it yields the Gaussians: small at paint and
kerbs, larger on plain surfaces and far from the path. The same quadtree with larger least cells gives the coarser levels of detail, so a
level is the average of the finer one. Road paint is drawn a second time as long thin Gaussians `LIFT_M` above the ground: Gaussians are
composited in the order of their centres, so at a grazing angle ground in front of a line would otherwise wash over it. The lift, and a
shallow trench in the ground around it, put a line in front of all ground within ``(lift + trench) * distance / camera height``, which grows
with distance as the cells do.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F32, F64, I64, Bool
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.scene.ground_texture import KERB_M, GroundTexture, paint_ground
from alpasim_plugin.gaussians.scene.nodes import SceneNode, nodes_by_tile
from alpasim_plugin.gaussians.scene.paint import WHITE, YELLOW, Strokes
from alpasim_plugin.gaussians.scene.site import Site
from alpasim_plugin.gaussians.scene.surfels import SPREAD, THICKNESS, cloud_of, grid_cells, quats_along, upright_quats

FINE_M, COARSE_M = 0.125, 0.5
TILE_M, FAR_TILE_M = 16.0, 32.0
CORRIDOR_M = 9.0  # tiles that come this near to the path get the fine levels
LIFT_M = 0.02
MAX_LEVEL = 5  # cells of one image grow up to 2**5 of its pixels
PAINT_RGB = {WHITE: (0.88, 0.88, 0.86), YELLOW: (0.86, 0.66, 0.16)}


def build_road(site: Site, strokes: Strokes) -> list[SceneNode]:
    """Return the ground's nodes: fine tiles along the path, coarse ones around, and the paint strokes."""
    fine_tiles = _corridor(site)
    fine = paint_ground(site, strokes, FINE_M, _window(site, fine_tiles, FINE_M))
    coarse = paint_ground(site, strokes, COARSE_M, None)
    nodes = _ground_nodes(site, "ground", fine, fine_tiles, TILE_M, (0, 1, 2, 3), keep_inside=True)
    nodes += _ground_nodes(site, "far-ground", coarse, fine_tiles, FAR_TILE_M, (0, 1, 2), keep_inside=False)
    return nodes + _stroke_nodes(site, strokes) + _surroundings(site)


def _corridor(site: Site) -> Bool:
    """Return ``(Ty, Tx)`` which tiles of the site's raster come near the path."""
    d = site.path_m
    n = round(TILE_M / 0.25)
    h, w = -(-d.shape[0] // n), -(-d.shape[1] // n)
    padded = np.full((h * n, w * n), np.inf, dtype=np.float32)
    padded[: d.shape[0], : d.shape[1]] = d
    return np.asarray(padded.reshape(h, n, w, n).min(axis=(1, 3)) < CORRIDOR_M)


def _window(site: Site, tiles: Bool, cell_m: float) -> tuple[int, int, int, int]:
    """Return (first row, first column, rows, columns) in cells of ``cell_m`` that hold all fine tiles."""
    rows, columns = np.flatnonzero(tiles.any(axis=1)), np.flatnonzero(tiles.any(axis=0))
    n = round(TILE_M / cell_m)
    return int(rows[0]) * n, int(columns[0]) * n, int(rows[-1] - rows[0] + 1) * n, int(columns[-1] - columns[0] + 1) * n


def _ground_nodes(
    site: Site, name: str, image: GroundTexture, fine_tiles: Bool, tile_m: float, floors: tuple[int, ...], keep_inside: bool
) -> list[SceneNode]:
    means = _pyramid(image.rgb)
    heights = _pyramid(image.height[:, :, None])
    levels = []
    for floor in floors:
        parts = []
        wanted = np.maximum(image.level, floor)
        for k, leaf in enumerate(_leaves(wanted, floor)):
            if leaf is None or not leaf.any():
                continue
            i, j = np.nonzero(leaf)
            size = image.cell_m * (1 << k)
            plan = image.low + np.stack([(j + 0.5) * size, (i + 0.5) * size], axis=1)
            t = np.floor((plan - site.low) / TILE_M).astype(np.int64)
            inside = fine_tiles[np.clip(t[:, 1], 0, fine_tiles.shape[0] - 1), np.clip(t[:, 0], 0, fine_tiles.shape[1] - 1)]
            keep = inside if keep_inside else ~inside
            parts.append((plan[keep], np.full(int(keep.sum()), size), means[k][i, j][keep], heights[k][i, j, 0][keep].astype(np.float64)))
        if not parts:
            continue
        plan, size_m, rgb, above = (np.concatenate(c) for c in zip(*parts, strict=True))
        cloud = _flat(site, plan, size_m, rgb, np.where(above > KERB_M / 2, KERB_M, np.minimum(above, 0.0)))
        tile = np.floor((plan - site.low) / tile_m).astype(np.int64)
        levels.append((image.cell_m * (1 << floor), cloud, tile[:, 1] * 100_000 + tile[:, 0]))
    return nodes_by_tile(name, levels)


def _pyramid(image: F32) -> list[F32]:
    """Return the image and its averages over squares of 2, 4, ... cells."""
    out = [image]
    for _ in range(MAX_LEVEL):
        h, w, c = out[-1].shape
        if h % 2 or w % 2:
            break
        out.append(np.asarray(out[-1].reshape(h // 2, 2, w // 2, 2, c).mean(axis=(1, 3))))
    return out


def _leaves(level: I64, floor: int) -> list[Bool | None]:
    """Return per quadtree level which squares are leaves: the largest ones in which no cell needs a smaller square."""
    can: list[Bool] = []
    least = level
    for k in range(MAX_LEVEL + 1):
        can.append(np.asarray(least >= k))
        h, w = least.shape
        if h % 2 or w % 2:
            break
        least = least.reshape(h // 2, 2, w // 2, 2).min(axis=(1, 3))
    leaves: list[Bool | None] = []
    for k, mask in enumerate(can):
        if k < floor:
            leaves.append(None)
            continue
        if k + 1 < len(can):
            mask = mask & ~np.repeat(np.repeat(can[k + 1], 2, axis=0), 2, axis=1)
        leaves.append(mask)
    return leaves


def _flat(site: Site, plan: F64, size_m: F64, rgb: npt.NDArray[np.floating], above_m: F64) -> GaussianCloud:
    """Lay flat Gaussians on the ground."""
    means, normals = _on_ground(site, plan, above_m)
    quats = upright_quats(normals, site.frame.yaw_rad)
    s = SPREAD * size_m
    return cloud_of(means, quats, np.stack([s, s, THICKNESS * size_m], axis=1), rgb.astype(np.float64))


def _on_ground(site: Site, plan: F64, above_m: F64 | float) -> tuple[F64, F64]:
    """Return world points ``(N, 3)`` above the ground and the ground's normals ``(N, 3)``, slopes taken over 2 m."""
    xy = site.frame.to_world(plan)
    z = site.height_at(xy)
    east, north = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    dx = site.height_at(xy + east) - site.height_at(xy - east)
    dy = site.height_at(xy + north) - site.height_at(xy - north)
    normals = np.stack([-dx / 2, -dy / 2, np.ones_like(z)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([xy, z + above_m]), normals


def _stroke_nodes(site: Site, strokes: Strokes) -> list[SceneNode]:
    if len(strokes.start) == 0:
        return []
    rng = site.rng("paint-wear")
    wear = 1 - 0.16 * rng.random((len(strokes.start), 1)) * site.scenario.environment.texture
    middle = (strokes.start + strokes.end) / 2
    tile = np.floor((middle - site.low) / TILE_M).astype(np.int64)
    tile_of = tile[:, 1] * 100_000 + tile[:, 0]
    rgb = np.array([PAINT_RGB[WHITE], PAINT_RGB[YELLOW]])[strokes.colour] * wear
    length = np.linalg.norm(strokes.end - strokes.start, axis=1)
    levels = []
    for cell_m, link_m, across_m in ((0.125, 0.19, 0.15), (0.3, 0.75, 0.25), (0.8, 1.5, 0.5)):
        n_u = np.maximum(np.round(length / link_m), 1).astype(np.int64)
        n_v = np.maximum(np.round(strokes.width_m / across_m), 1).astype(np.int64)
        owner, u, v = grid_cells(n_u, n_v)
        along = (strokes.end - strokes.start)[owner] / np.maximum(length[owner], 1e-9)[:, None]
        left = np.stack([-along[:, 1], along[:, 0]], axis=1)
        plan = strokes.start[owner] + along * (u * length[owner])[:, None] + left * ((v - 0.5) * strokes.width_m[owner])[:, None]
        means, normals = _on_ground(site, plan, LIFT_M)
        xy = site.frame.to_world(np.concatenate([plan, plan + along]))
        heading = xy[len(plan) :] - xy[: len(plan)]
        direction = np.column_stack([heading, -np.sum(heading * normals[:, :2], axis=1) / normals[:, 2]])
        single = (n_v == 1)[owner]
        # A lone row is half as strong at its own edge (sigma 0.42 of the width); rows side by side must close the gap between them.
        across = np.where(single, 0.42, SPREAD) * (strokes.width_m / n_v)[owner]
        scales = np.stack([0.75 * (length / n_u)[owner], across, np.full(len(owner), 0.004)], axis=1)
        levels.append((cell_m, cloud_of(means, quats_along(direction, normals), scales, rgb[owner], 0.97), tile_of[owner]))
    return nodes_by_tile("paint", levels, far_m=140.0)


def _surroundings(site: Site) -> list[SceneNode]:
    """Lay large Gaussians from the raster's border to the horizon, so that the ground does not end in mid-air."""
    h, w = site.road.shape
    size = np.array([w, h]) * 0.25
    cell = 12.0
    n = np.ceil((size + 2 * 160.0) / cell).astype(int)
    grid = np.stack(np.meshgrid(np.arange(n[0]), np.arange(n[1])), axis=-1).reshape(-1, 2)
    plan = site.low - 160.0 + (grid + 0.5) * cell
    outside = np.any((plan < site.low - 0.3 * cell) | (plan > site.low + size + 0.3 * cell), axis=1)
    plan = plan[outside]
    rgb = np.array([0.36, 0.40, 0.26]) * (1 + 0.08 * site.rng("far-field").standard_normal((len(plan), 1)))
    cloud = _flat(site, plan, np.full(len(plan), cell), rgb, np.zeros(len(plan)))
    tile = np.floor(plan / 120.0).astype(np.int64)
    return nodes_by_tile("surroundings", [(cell, cloud, tile[:, 1] * 100_000 + tile[:, 0])])
