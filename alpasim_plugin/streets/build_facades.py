"""Build houses along the road: extruded boxes whose walls carry windows, doors and shop fronts.

A wall is a grid of bays and floors, each bay a small pattern of cells; coarser levels are averages
of it. Windows are cells, not holes: what an image shows of a facade at street distances is colour
and rhythm.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F64, I64, U8, Bool
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.scene.scene_graph import SceneNode, nodes_by_tile
from alpasim_plugin.streets.site import CELL_M, SHIFT_BITS, Site, contours, to_pixels
from alpasim_plugin.streets.surfels import (
    SPREAD,
    cell_counts,
    cloud_of,
    grid_cells,
    quats_along,
)

SETBACK_M = {False: 5.5, True: 24.0}  # by highway or not
WITHIN_M = 75.0
FLOOR_M = 3.1
BAY_M = 3.0
WIDTH_M = (9.0, 19.0)
DEPTH_M = 9.0
CLEAR_M = 2.8  # no wall stands nearer to the road
LIT_SHARE = 0.3  # of windows at night
SUNK_M = 0.2  # of a wall below the lowest ground at its foot
# Cells per bay and floor, and the cell size at which the level is chosen. Each level is the average
# of the first.
CELLS = ((12, 0.25), (6, 0.32), (3, 0.9), (1, 2.6))

WALLS = np.array(
    [
        [0.55, 0.30, 0.24],
        [0.63, 0.42, 0.33],
        [0.74, 0.68, 0.57],
        [0.80, 0.77, 0.72],
        [0.58, 0.58, 0.58],
        [0.66, 0.60, 0.50],
        [0.47, 0.50, 0.54],
        [0.70, 0.52, 0.36],
    ]
)
GLASS = np.array([[0.16, 0.20, 0.26], [0.24, 0.31, 0.38], [0.36, 0.45, 0.52], [0.58, 0.55, 0.42]])
AWNINGS = np.array(
    [
        [0.60, 0.14, 0.12],
        [0.12, 0.32, 0.22],
        [0.13, 0.22, 0.45],
        [0.72, 0.60, 0.20],
        [0.30, 0.28, 0.28],
    ]
)


class Houses(NamedTuple):
    """Boxes beside the road."""

    front: F64  # (M, 2, 2) plan: the wall's two ends, seen from the road right then left
    away: F64  # (M, 2) unit, plan
    height_m: F64  # (M,)


class _Walls(NamedTuple):
    """Walls of all houses, ground coordinates."""

    start: F64  # (W, 2)
    end: F64  # (W, 2); outward is to the right of start to end
    base: F64  # (W,) height of the foot, world
    height_m: F64  # (W,)
    house: I64  # (W,)
    is_front: Bool  # (W,)


def build_facades(site: Site) -> tuple[list[SceneNode], Houses]:
    """Return the houses' nodes and where they stand."""
    houses = place_houses(site)
    if len(houses.front) == 0:
        return [], houses
    rng = site.rng("facade-style")
    m = len(houses.front)
    style = {
        "wall": WALLS[rng.integers(len(WALLS), size=m)] * rng.uniform(0.88, 1.08, (m, 1)),
        "trim": rng.uniform(0.75, 0.95, (m, 1)) * np.array([1.0, 0.98, 0.94]),
        "shop": rng.random(m) < 0.45,
        "awning": AWNINGS[rng.integers(len(AWNINGS), size=m)],
        "wide": rng.random(m) < 0.35,
    }
    right = houses.front[:, 0]
    left = houses.front[:, 1]
    back = DEPTH_M * houses.away
    starts = np.concatenate([right, left, right + back, left + back])
    ends = np.concatenate([left, left + back, right, right + back])
    owner = np.tile(np.arange(m), 4)
    is_front = np.arange(4 * m) < m
    base = np.minimum(site.world(starts)[:, 2], site.world(ends)[:, 2])
    # On a slope the walls differ in height, the roof is level.
    top = (base[:m] + houses.height_m)[owner]
    seed = int(rng.integers(1 << 30))
    walls = _Walls(starts, ends, base, top - base, owner, is_front)
    levels = []
    for (cells, cell_m), (cloud, wall) in zip(CELLS, _walls(site, walls, style, seed), strict=True):
        roof, house = _roofs(site, houses, style["wall"], base[:m], 1.0 if cells > 3 else 3.0)
        levels.append(
            (cell_m, GaussianCloud.concatenate([cloud, roof]), np.concatenate([owner[wall], house]))
        )
    return nodes_by_tile("house", levels), houses


def place_houses(site: Site) -> Houses:
    """Choose where houses stand: along the line at the setback, clear of the road, of actors and of
    each other, and not on the islands of roundabouts.
    """
    environment = site.scenario.environment
    rng = site.rng("houses")
    is_free = (site.off_road_m > CLEAR_M) & ~site.taken & ~site.islands & site.owned_cells
    free = is_free.astype(np.uint8)
    fronts, aways, heights = [], [], []
    low_m, high_m = environment.building_height_m
    for line in contours(site, SETBACK_M[site.highway], WITHIN_M):
        length = float(arc_lengths(line)[-1])
        s = float(rng.uniform(0, 4))
        while s + WIDTH_M[0] < length:
            width = float(rng.uniform(*WIDTH_M))
            height = float(rng.uniform(low_m, high_m))
            wanted = rng.random() < environment.buildings
            gap = float(rng.choice([0.0, 0.0, 2.5, 5.0]))
            a, b = resample(line, [s, min(s + width, length)])
            s += width + gap
            chord = b - a
            size = float(np.linalg.norm(chord))
            if not wanted or size < 0.8 * width or size < 6.0:
                continue
            away = np.array([chord[1], -chord[0]]) / size
            ring = np.stack([a, b, b + DEPTH_M * away, a + DEPTH_M * away])
            if _claim(free, ring, site):
                fronts.append(np.stack([a, b]))
                aways.append(away)
                heights.append(height)
    if not fronts:
        return Houses(np.zeros((0, 2, 2)), np.zeros((0, 2)), np.zeros(0))
    return Houses(np.stack(fronts), np.stack(aways), np.array(heights))


def lit_windows(site: Site, houses: Houses) -> tuple[float, F64, F64]:
    """Return half the size of the windows that have light at night, their middles ``(N, 3)`` and
    where they face ``(N, 3)``; shops are dark.
    """
    start = houses.front[:, 0]
    end = houses.front[:, 1]
    floors = cell_counts(houses.height_m, FLOOR_M)
    bays = cell_counts(np.linalg.norm(end - start, axis=1), BAY_M)
    house, u, v = grid_cells(bays, floors)
    is_lit = (site.rng("lit-windows").random(len(house)) < LIT_SHARE) & (v * floors[house] > 1)
    house, u, v = house[is_lit], u[is_lit, None], v[is_lit]
    middle = site.world(start[house] + u * (end - start)[house])
    base = np.minimum(site.world(start)[:, 2], site.world(end)[:, 2])  # as that of the walls
    middle[:, 2] = base[house] - SUNK_M + v * (houses.height_m + SUNK_M)[house]
    facing = -site.frame.turned(houses.away[house])
    return BAY_M / 4, middle + 0.05 * facing, facing


def _claim(free: U8, ring: F64, site: Site) -> bool:
    """Take the ground of a house if all of it is free."""
    centre = ring.mean(axis=0)
    inner = to_pixels(centre + 0.96 * (ring - centre), site.low, CELL_M)
    x0, y0 = inner.min(axis=0) >> SHIFT_BITS
    x1, y1 = (inner.max(axis=0) >> SHIFT_BITS) + 2
    h, w = free.shape
    if x0 < 0 or y0 < 0 or x1 > w or y1 > h:
        return False
    mask = np.zeros((y1 - y0, x1 - x0), dtype=np.uint8)
    shifted = inner - np.array([x0, y0]) * (1 << SHIFT_BITS)
    cv2.fillConvexPoly(mask, shifted.astype(np.int32), 1, cv2.LINE_8, SHIFT_BITS)
    part = free[y0:y1, x0:x1]
    if np.any(part[mask > 0] == 0):
        return False
    part[mask > 0] = 0
    return True


def _walls(
    site: Site, walls: _Walls, style: dict[str, npt.NDArray[Any]], seed: int
) -> list[tuple[GaussianCloud, I64]]:
    """Cover walls with Gaussians at each level of `CELLS`, and return clouds and each Gaussian's
    wall.
    """
    starts, ends, _, height, owner, is_front = walls
    length = np.linalg.norm(ends - starts, axis=1)
    bays = cell_counts(length, BAY_M)
    floors = cell_counts(height, FLOOR_M)
    finest = CELLS[0][0]
    wall, u, v = grid_cells(bays * finest, floors * finest)
    column = (u * (bays * finest)[wall]).astype(np.int64)
    row = (v * (floors * finest)[wall]).astype(np.int64)
    bay = column // finest
    floor = row // finest
    fu = (column % finest + 0.5) / finest
    fv = (row % finest + 0.5) / finest
    house = owner[wall]
    front = is_front[wall]
    # One number per window.
    key = (wall * 7919 + bay * 104_729 + floor * 1_299_709 + seed) % 2_147_483_647
    pick = (key * 48_271 % 2_147_483_647) / 2_147_483_647
    glass = GLASS[np.minimum((pick * pick * 4).astype(np.int64), 3)]
    first = np.where(style["wide"][house], 0.17, 0.33)
    in_window = (fu > first) & (fu < 0.83)
    shop = (floor == 0) & front & style["shop"][house]
    entrance = (floor == 0) & front & ~style["shop"][house] & (bay == bays[wall] // 2)
    sill = in_window & (fv > 0.25) & (fv < 0.33) & front
    awning = shop & (fv > 0.66) & (fv < 0.83)
    door = entrance & (fu > 0.33) & (fu < 0.66) & (fv < 0.66)
    glazing_bar = (np.abs(fu - (first + 0.83) / 2) < 0.04) | (np.abs(fv - 0.62) < 0.04)
    share = np.where(in_window & (fv > 0.33) & (fv < 0.83), np.where(glazing_bar, 0.55, 1.0), 0.0)
    # Walls away from the street have fewer windows.
    share = np.where(front, share, 0.6 * share * (bay % 2 == 0))
    share = np.where(shop, (fu > 0.12) & (fv < 0.66), share)
    shade = np.where(front, 1.0, 0.80) * (0.86 + 0.14 * np.clip(v * 2.5, 0, 1))
    texture = site.scenario.environment.texture
    grain = 0.035 * texture * site.rng("facade-grain").standard_normal(len(wall))
    rgb = style["wall"][house] * (shade + grain)[:, None]
    trim = style["trim"][house] * shade[:, None]
    rgb[sill] = trim[sill]
    cornice = row == (floors * finest)[wall] - 1
    rgb[cornice] = 0.92 * trim[cornice]
    rgb += share[:, None] * (glass * np.where(front, 1.0, 0.85)[:, None] - rgb)
    rgb[awning] = style["awning"][house[awning]]
    rgb[door] = style["awning"][house[door]] * 0.6

    levels = []
    for cells, _ in CELLS:
        across = bays * cells
        up = floors * cells
        begin = np.cumsum(across * up) - across * up
        block = finest // cells
        cell = begin[wall] + row // block * across[wall] + column // block
        mean = np.column_stack([np.bincount(cell, channel) for channel in rgb.T]) / block**2
        levels.append(_covered(site, walls, across, up, mean))
    return levels


def _covered(
    site: Site, walls: _Walls, across: I64, up: I64, rgb: F64
) -> tuple[GaussianCloud, I64]:
    """Cover walls with a grid of Gaussians, and return them and each one's wall.

    Args:
        site: The scene.
        walls: All walls.
        across, up: ``(W,)`` Gaussians along and above one another on each wall.
        rgb: ``(N, 3)`` their colours, wall by wall and row by row.
    """
    starts, ends, base, height, _, _ = walls
    length = np.linalg.norm(ends - starts, axis=1)
    wall, u, v = grid_cells(across, up)
    plan = starts[wall] + u[:, None] * (ends - starts)[wall]
    z = base[wall] - SUNK_M + v * (height[wall] + SUNK_M)
    scales = (
        SPREAD * (length / across)[wall],
        np.full(len(wall), 0.05),
        SPREAD * ((height + SUNK_M) / up)[wall],
    )
    means = np.column_stack([site.frame.to_world(plan), z])
    quats = _facing(site, starts, ends)[wall]
    return cloud_of(means, quats, np.column_stack(scales), rgb), wall


def _facing(site: Site, start: F64, end: F64) -> F64:
    """Return the rotations ``(N, 4)`` whose x axis runs along walls on the plan."""
    heading = site.frame.to_world(end) - site.frame.to_world(start)
    return quats_along(np.column_stack([heading, np.zeros(len(heading))]))


def _roofs(
    site: Site, houses: Houses, wall_rgb: F64, base: F64, cell_m: float
) -> tuple[GaussianCloud, I64]:
    """Cover the flat roofs, so that a house seen from above or afar is closed."""
    a = houses.front[:, 0]
    b = houses.front[:, 1]
    length = np.linalg.norm(b - a, axis=1)
    n_u = cell_counts(length, 2 * cell_m)
    n_v = np.full(len(a), max(1, round(DEPTH_M / cell_m / 2)), dtype=np.int64)
    house, u, v = grid_cells(n_u, n_v)
    plan = a[house] + u[:, None] * (b - a)[house] + v[:, None] * DEPTH_M * houses.away[house]
    xy = site.frame.to_world(plan)
    scales = (
        SPREAD * (length / n_u)[house],
        SPREAD * DEPTH_M / n_v[house],
        np.full(len(house), 0.05),
    )
    means = np.column_stack([xy, (base + houses.height_m)[house] - 0.05])
    quats = _facing(site, a, b)[house]
    return cloud_of(means, quats, np.column_stack(scales), 0.55 * wall_rgb[house]), house
