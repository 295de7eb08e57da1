"""Build the ground: asphalt with its wear, lane markings, pavements and grass, as flat Gaussians
whose size follows what is to be seen there.

The plan is painted as an image (0.125 m near the path, 0.5 m beyond), and a quadtree over it yields
the Gaussians: small at lane markings and kerbs, larger on plain surfaces and far from the path. The
same quadtree with larger least cells gives the coarser levels of detail, so a level is the average
of the finer one. Lane markings are drawn a second time as long thin Gaussians `LIFT_M` above the
ground: Gaussians are composited in the order of their centres, so at a grazing angle ground in
front of a line would otherwise wash over it. The lift, and a shallow trench in the ground around
it, put a line in front of all ground within ``(lift + trench) * distance / camera height``, which
grows with distance as the cells do.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from alpasim_plugin.core.detail import halvings
from alpasim_plugin.core.geometry import direction_of, left_of, unit
from alpasim_plugin.core.types import F32, F64, I64, U8, Bool, FloatArray
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.scene.scene_graph import SceneNode, nodes_by_tile, tile_numbers
from alpasim_plugin.streets.markings import WHITE, YELLOW, Strokes
from alpasim_plugin.streets.site import (
    CELL_M,
    HORIZON_M,
    SHIFT_BITS,
    Site,
    cells_at,
    distance_m,
    to_pixels,
)
from alpasim_plugin.streets.surfels import (
    SPREAD,
    THICKNESS,
    cell_counts,
    cloud_of,
    grid_cells,
    quats_along,
    upright_quats,
)

MARKING_IMAGE_RGB = {WHITE: (0.86, 0.86, 0.84), YELLOW: (0.84, 0.65, 0.17)}
ASPHALT = (0.335, 0.335, 0.345)
PAVEMENT = (0.55, 0.53, 0.50)
GRASS = (0.33, 0.40, 0.22)
GRAVEL = (0.46, 0.43, 0.38)
FORECOURT = (0.47, 0.45, 0.42)
KERB_M = 0.12
# Asphalt this near to lane markings lies this much lower, see build_road.
TRENCH_M = 0.16
TRENCH_DEPTH_M = 0.03
PAVEMENT_M = 2.6  # width of the pavement beside the road
FORECOURT_M = 6.5  # paved or planted strip up to the facades


@dataclass(frozen=True)
class GroundTexture:
    """The painted ground; cell (i, j) has its centre at ``low + (j + 0.5, i + 0.5) * cell_m`` in
    ground coordinates.

    Attributes:
        cell_m: Metres.
        low: ``(2,)`` ground coordinates of the corner.
        rgb: ``(H, W, 3)`` 0..1.
        height: ``(H, W)`` metres above the road's surface: a kerb's height beside the road, a
            little below zero around lane markings.
        level: ``(H, W)`` the largest square that may stand for the cell is ``cell_m * 2**level``.
    """

    cell_m: float
    low: F64
    rgb: F32
    height: F32
    level: I64


def paint_ground(
    site: Site, strokes: Strokes, cell_m: float, window: tuple[int, int, int, int] | None
) -> GroundTexture:
    """Paint the ground.

    Args:
        site: What lies where.
        strokes: Lane markings.
        cell_m: Cell size of the image.
        window: (first row, first column, rows, columns) in cells of ``cell_m``; None: the whole
            site, padded to whole tiles of 32 m.
    """
    if window is None:
        n = round(32.0 / cell_m)
        rows, columns = (int(np.ceil(s * CELL_M / 32.0)) * n for s in site.road.shape)
        window = (0, 0, rows, columns)
    i0, j0, rows, columns = window
    low = site.low + np.array([j0, i0]) * cell_m
    off, inside, path = (
        _sampled(d, site, low, cell_m, (rows, columns))
        for d in (site.off_road_m, site.inside_m, site.path_m)
    )
    road = inside > off
    edge = np.abs(inside - off)
    texture = site.scenario.environment.texture
    tag = f"ground-{cell_m}"
    grain = _noise(site, tag, (rows, columns), cell_m)

    rgb = np.empty((rows, columns, 3), dtype=np.float32)
    verge = ~road
    rgb[verge] = _verge(site, off[verge], grain[verge], texture)
    tone = 1 + texture * (0.10 * grain - _wear(site, low, cell_m, (rows, columns)))
    rgb[road] = np.array(ASPHALT, dtype=np.float32) * tone[road][:, None]
    # Cells half covered by a thin line would alias along the crisp strokes laid over them.
    thinnest = 0.3 if cell_m < CELL_M else 0.0
    covers = [
        _coverage(strokes, colour, low, cell_m, (rows, columns), thinnest)
        for colour in (WHITE, YELLOW)
    ]
    for colour, cover in zip((WHITE, YELLOW), covers, strict=True):
        on = cover > 0
        worn = cover[on] * (0.95 - 0.12 * texture * np.clip(grain[on], 0, 2))
        rgb[on] += worn[:, None] * (np.array(MARKING_IMAGE_RGB[colour], dtype=np.float32) - rgb[on])

    marked = np.zeros((rows, columns), dtype=bool)
    for colour in (WHITE, YELLOW):
        marked |= _coverage(strokes, colour, low, cell_m, (rows, columns)) > 0.04
    near_marking = distance_m(marked, cell_m)
    feature = np.minimum(edge, near_marking)
    if cell_m < CELL_M:
        cap = np.where(road & (path < 2.5), 0.125, np.where(road & (path < 6.0), 0.25, 0.5))
    else:
        cap = np.clip(0.06 * path, 0.5, 4.0)
    wanted = np.clip(0.6 * feature, cell_m, np.maximum(cap, cell_m))
    level = np.floor(np.log2(wanted / cell_m) + 1e-6).astype(np.int64)
    # Not at the kerb's foot: a gap would open there
    trench = (near_marking < TRENCH_M) & (edge > TRENCH_M)
    height = np.where(road, np.where(trench, -TRENCH_DEPTH_M, 0.0), 0.0 if site.highway else KERB_M)
    return GroundTexture(cell_m, low, np.clip(rgb, 0, 1), height.astype(np.float32), level)


def _sampled(raster: F32, site: Site, low: F64, cell_m: float, shape: tuple[int, int]) -> F32:
    """Resample one of the site's rasters, bilinear, the border continued."""
    scale = cell_m / CELL_M
    shift = (low - site.low) / CELL_M + 0.5 * scale - 0.5
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(
        raster.astype(np.float32),
        matrix,
        (shape[1], shape[0]),
        flags=flags,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _noise(site: Site, tag: str, shape: tuple[int, int], cell_m: float) -> F32:
    """Return smooth noise ``(H, W)`` of about unit spread: octaves from the grain of asphalt to
    patches of ten metres.
    """
    total = np.zeros(shape, dtype=np.float32)
    rng = site.rng(tag)
    for grid_m, weight in ((0.13, 0.6), (0.4, 0.45), (1.2, 0.4), (3.0, 0.4), (12.0, 0.45)):
        step = max(grid_m, cell_m)
        small = rng.standard_normal(
            (int(shape[0] * cell_m / step) + 3, int(shape[1] * cell_m / step) + 3)
        ).astype(np.float32)
        total += weight * cv2.resize(small, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return total


def _verge(site: Site, off: F32, grain: F32, texture: float) -> F64:
    """Colour cells ``(N,)`` of the ground beside the road, ``(N, 3)``: pavement with slabs, then
    forecourt or grass.
    """
    colour = np.tile(GRASS, (len(off), 1))
    contrast = np.full(len(off), 0.20)
    if site.highway:
        zones = [(1.0, GRAVEL, 0.08)]
    else:
        has_forecourt = site.scenario.environment.buildings > 0.5
        zones = [(FORECOURT_M, FORECOURT, 0.08)] if has_forecourt else []
        zones.append((PAVEMENT_M, PAVEMENT, 0.06))
    for reach_m, zone_rgb, zone_contrast in zones:
        colour[off < reach_m], contrast[off < reach_m] = zone_rgb, zone_contrast
    rgb = colour * (1 + texture * contrast * grain)[:, None]
    if not site.highway:
        rgb[np.abs(off - 1.3) < 0.07] *= 0.85
    return rgb


def _wear(site: Site, low: F64, cell_m: float, shape: tuple[int, int]) -> F32:
    """Return what darkens asphalt, 0..1: wheel tracks and the oil line of each lane, patches and
    cracks near the path.
    """
    dark = np.zeros(shape, dtype=np.uint8)
    high = low + np.array(shape[::-1]) * cell_m
    for lane in site.scenario.lane_map.lanes.values():
        if lane.kind not in ("vehicle", "bus") or lane.is_intersection or len(lane.centre) < 2:
            continue
        line = site.frame.to_ground(lane.centre)
        if np.any(line.max(axis=0) < low) or np.any(line.min(axis=0) > high):
            continue
        left = left_of(unit(np.gradient(line, axis=0)))
        for side in (-0.85, 0.85):
            points = to_pixels(line + side * left, low, cell_m)
            cv2.polylines(
                dark, [points], False, 26, max(1, round(0.6 / cell_m)), cv2.LINE_8, SHIFT_BITS
            )
        cv2.polylines(
            dark,
            [to_pixels(line, low, cell_m)],
            False,
            14,
            max(1, round(0.4 / cell_m)),
            cv2.LINE_8,
            SHIFT_BITS,
        )
    soft: U8 = cv2.GaussianBlur(dark, (0, 0), max(0.2 / cell_m, 0.5))
    if cell_m < CELL_M:
        _patches_and_cracks(site, soft, low, cell_m)
    return soft.astype(np.float32) / 255.0


def _patches_and_cracks(site: Site, dark: U8, low: F64, cell_m: float) -> None:
    rng = site.rng("cracks")
    path = site.path
    for _ in range(max(2, len(path) // 12)):
        centre = path[rng.integers(len(path))] + rng.uniform(-6, 6, 2)
        half = rng.uniform([0.6, 0.4], [2.2, 1.2])
        angle = rng.normal(0.0, 0.05)
        c = np.cos(angle)
        s = np.sin(angle)
        ring = centre + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half) @ np.array(
            [[c, s], [-s, c]]
        )
        cv2.fillPoly(
            dark, [to_pixels(ring, low, cell_m)], int(rng.integers(28, 55)), cv2.LINE_8, SHIFT_BITS
        )
    for _ in range(max(3, len(path) // 6)):
        start = path[rng.integers(len(path))] + rng.uniform(-6, 6, 2)
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.35, 14))
        line = start + np.cumsum(0.35 * direction_of(heading), axis=0)
        cv2.polylines(
            dark,
            [to_pixels(line, low, cell_m)],
            False,
            int(rng.integers(60, 100)),
            1,
            cv2.LINE_AA,
            SHIFT_BITS,
        )


def _coverage(
    strokes: Strokes,
    colour: int,
    low: F64,
    cell_m: float,
    shape: tuple[int, int],
    thinnest_m: float = 0.0,
) -> F32:
    """Return the share ``(H, W)`` of each cell under markings of one colour; strokes thinner than
    ``thinnest_m`` are left out.
    """
    mask = np.zeros(shape, dtype=np.uint8)
    high = low + np.array(shape[::-1]) * cell_m
    near = np.all((strokes.start > low - 5) & (strokes.start < high + 5), axis=1)
    chosen = near & (strokes.colour == colour) & (strokes.width_m >= thinnest_m)
    start = strokes.start[chosen]
    end = strokes.end[chosen]
    width = strokes.width_m[chosen]
    direction = unit(end - start)
    left = left_of(direction) * (width / 2)[:, None]
    along = direction * 0.02
    rings = np.stack(
        [start - left - along, end - left + along, end + left + along, start + left - along], axis=1
    )
    # Strokes of coarse images are thinner than a pixel: drawing at four times the resolution would
    # be exact, area weighting is enough.
    gain = np.minimum(1.0, width / cell_m)
    for ring, share in zip(
        to_pixels(rings.reshape(-1, 2), low, cell_m).reshape(-1, 4, 2), gain, strict=True
    ):
        cv2.fillConvexPoly(
            mask, ring, int(255 * share), cv2.LINE_AA if share == 1.0 else cv2.LINE_8, SHIFT_BITS
        )
    return mask.astype(np.float32) / 255.0


FINE_M = 0.125
COARSE_M = 0.5
TILE_M = 16.0
FAR_TILE_M = 32.0
CORRIDOR_M = 9.0  # tiles that come this near to the path get the fine levels
LIFT_M = 0.02
STROKE_M = 0.125  # length of the finest cells of lane markings for usual cameras
MAX_LEVEL = 5  # cells of one image grow up to 2**5 of its pixels
MARKING_RGB = {WHITE: (0.88, 0.88, 0.86), YELLOW: (0.86, 0.66, 0.16)}


def build_road(site: Site, strokes: Strokes) -> list[SceneNode]:
    """Return the ground's nodes: fine tiles along the path, coarse ones around, and the markings'
    strokes.
    """
    # Tiles of the site's raster that come near the path.
    d = site.path_m
    n = round(TILE_M / 0.25)
    h = -(-d.shape[0] // n)
    w = -(-d.shape[1] // n)
    padded = np.full((h * n, w * n), np.inf, dtype=np.float32)
    padded[: d.shape[0], : d.shape[1]] = d
    fine_tiles = padded.reshape(h, n, w, n).min(axis=(1, 3)) < CORRIDOR_M
    # The fine tiles in cells of the image.
    rows = np.flatnonzero(fine_tiles.any(axis=1))
    columns = np.flatnonzero(fine_tiles.any(axis=0))
    n = round(TILE_M / FINE_M)
    fine = paint_ground(
        site,
        strokes,
        FINE_M,
        (
            int(rows[0]) * n,
            int(columns[0]) * n,
            int(rows[-1] - rows[0] + 1) * n,
            int(columns[-1] - columns[0] + 1) * n,
        ),
    )
    coarse = paint_ground(site, strokes, COARSE_M, None)
    nodes = _ground_nodes(site, "ground", fine, fine_tiles, TILE_M, (0, 1, 2, 3), keep_inside=True)
    nodes += _ground_nodes(
        site, "far-ground", coarse, fine_tiles, FAR_TILE_M, (0, 1, 2), keep_inside=False
    )
    return nodes + _stroke_nodes(site, strokes) + _surroundings(site)


def _ground_nodes(
    site: Site,
    name: str,
    image: GroundTexture,
    fine_tiles: Bool,
    tile_m: float,
    floors: tuple[int, ...],
    keep_inside: bool,
) -> list[SceneNode]:
    averages = _pyramid(np.dstack([image.rgb, image.height]))
    levels = []
    for floor in floors:
        parts = []
        for k, leaf in enumerate(_leaves(np.maximum(image.level, floor))):
            i, j = np.nonzero(leaf)
            size = image.cell_m * (1 << k)
            plan = image.low + np.column_stack([(j + 0.5) * size, (i + 0.5) * size])
            inside = cells_at(fine_tiles, plan - site.low, TILE_M)
            keep = (inside == keep_inside) & site.owns(plan)
            parts.append((plan[keep], np.full(keep.sum(), size), averages[k][i, j][keep]))
        plan, size_m, averaged = (np.concatenate(column) for column in zip(*parts, strict=True))
        above = averaged[:, 3]
        height_m = np.where(above > KERB_M / 2, KERB_M, np.minimum(above, 0.0))
        cloud = _flat(site, plan, size_m, averaged[:, :3], height_m)
        levels.append((image.cell_m * (1 << floor), cloud, tile_numbers(plan - site.low, tile_m)))
    return nodes_by_tile(name, levels)


def _pyramid(image: F32) -> list[F32]:
    """Return an image ``(H, W, C)`` and its averages over squares of 2, 4, ... cells."""
    out = [image]
    for _ in range(MAX_LEVEL):
        height, width = out[-1].shape[:2]
        size = (width // 2, height // 2)
        out.append(cv2.resize(out[-1], size, interpolation=cv2.INTER_AREA))
    return out


def _leaves(level: I64) -> list[Bool]:
    """Return per quadtree level which squares are leaves: the largest ones in which no cell needs a
    smaller square.
    """
    can = []
    for k in range(MAX_LEVEL + 1):
        can.append(level >= k)
        level = np.minimum(level[0::2], level[1::2])
        level = np.minimum(level[:, 0::2], level[:, 1::2])
    leaves = [
        mask & ~np.repeat(np.repeat(larger, 2, axis=0), 2, axis=1) for mask, larger in pairwise(can)
    ]
    return [*leaves, can[-1]]


def _flat(site: Site, plan: F64, size_m: F64, rgb: FloatArray, above_m: F64) -> GaussianCloud:
    """Lay flat Gaussians on the ground."""
    means, normals = _on_ground(site, plan, above_m)
    quats = upright_quats(normals, site.frame.yaw_rad)
    s = SPREAD * size_m
    return cloud_of(means, quats, np.column_stack([s, s, THICKNESS * size_m]), rgb)


def _on_ground(site: Site, plan: F64, above_m: F64 | float) -> tuple[F64, F64]:
    """Return world points ``(N, 3)`` above the ground and the ground's normals ``(N, 3)``, slopes
    taken over 2 m.
    """
    xy = site.frame.to_world(plan)
    z = site.height_at(xy)
    east = np.array([1.0, 0.0])
    north = np.array([0.0, 1.0])
    dx = site.height_at(xy + east) - site.height_at(xy - east)
    dy = site.height_at(xy + north) - site.height_at(xy - north)
    normals = np.column_stack([-dx / 2, -dy / 2, np.ones_like(z)])
    normals = unit(normals)
    return np.column_stack([xy, z + above_m]), normals


def _stroke_nodes(site: Site, everywhere: Strokes) -> list[SceneNode]:
    owned = site.owns((everywhere.start + everywhere.end) / 2)
    strokes = Strokes._make(column[owned] for column in everywhere)
    if len(strokes.start) == 0:
        return []
    rng = site.rng("paint-wear")
    wear = 1 - 0.16 * rng.random((len(strokes.start), 1)) * site.scenario.environment.texture
    middle = (strokes.start + strokes.end) / 2
    tile = tile_numbers(middle - site.low, TILE_M)
    rgb = np.array([MARKING_RGB[WHITE], MARKING_RGB[YELLOW]])[strokes.colour] * wear
    length = np.linalg.norm(strokes.end - strokes.start, axis=1)
    direction = unit(strokes.end - strokes.start)
    levels = []
    finer = [(STROKE_M / 2**n, 0.19 / 2**n, 0.10 / 2**n) for n in halvings(site.scenario)]
    for cell_m, link_m, across_m in (
        *finer,
        (STROKE_M, 0.19, 0.15),
        (0.3, 0.75, 0.25),
        (0.8, 1.5, 0.5),
    ):
        n_u = cell_counts(length, link_m)
        n_v = cell_counts(strokes.width_m, across_m)
        owner, u, v = grid_cells(n_u, n_v)
        along = direction[owner]
        left = left_of(along)
        plan = (
            strokes.start[owner]
            + along * (u * length[owner])[:, None]
            + left * ((v - 0.5) * strokes.width_m[owner])[:, None]
        )
        means, normals = _on_ground(site, plan, LIFT_M)
        xy = site.frame.to_world(np.concatenate([plan, plan + along]))
        heading = xy[len(plan) :] - xy[: len(plan)]
        uphill = np.column_stack(
            [heading, -np.sum(heading * normals[:, :2], axis=1) / normals[:, 2]]
        )
        single = (n_v == 1)[owner]
        # A lone row is half as strong at its own edge (sigma 0.42 of the width); rows side by side
        # must close the gap between them.
        across = np.where(single, 0.42, SPREAD) * (strokes.width_m / n_v)[owner]
        scales = np.column_stack([0.75 * (length / n_u)[owner], across, np.full(len(owner), 0.004)])
        levels.append(
            (
                cell_m,
                cloud_of(means, quats_along(uphill, normals), scales, rgb[owner], 0.97),
                tile[owner],
            )
        )
    return nodes_by_tile("markings", levels, far_m=140.0, usual_cell_m=STROKE_M)


def _surroundings(site: Site) -> list[SceneNode]:
    """Lay large Gaussians from the raster's border to the horizon, so that the ground does not end
    in mid-air.
    """
    h, w = site.road.shape
    size = np.array([w, h]) * 0.25
    cell = 12.0
    n = np.ceil((size + 2 * HORIZON_M) / cell).astype(int)
    grid = np.stack(np.meshgrid(np.arange(n[0]), np.arange(n[1])), axis=-1).reshape(-1, 2)
    plan = site.low - HORIZON_M + (grid + 0.5) * cell
    outside = np.any((plan < site.low - 0.3 * cell) | (plan > site.low + size + 0.3 * cell), axis=1)
    plan = plan[outside & site.owns(plan)]
    rgb = np.array([0.36, 0.40, 0.26]) * (
        1 + 0.08 * site.rng("far-field").standard_normal((len(plan), 1))
    )
    cloud = _flat(site, plan, np.full(len(plan), cell), rgb, np.zeros(len(plan)))
    return nodes_by_tile("surroundings", [(cell, cloud, tile_numbers(plan, 120.0))])
