"""Paint the ground seen from above as an image: its colour, its height over the road, and how fine it must be sampled."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64, I64, U8
from alpasim_plugin.gaussians.scene.paint import WHITE, YELLOW, Strokes
from alpasim_plugin.gaussians.scene.site import CELL_M, SHIFT_BITS, Site, to_pixels

PAINT_IMAGE_RGB = {WHITE: (0.86, 0.86, 0.84), YELLOW: (0.84, 0.65, 0.17)}
ASPHALT = (0.335, 0.335, 0.345)
PAVEMENT = (0.55, 0.53, 0.50)
GRASS = (0.33, 0.40, 0.22)
KERB_M = 0.12
TRENCH_M, TRENCH_DEPTH_M = 0.16, 0.03  # asphalt this near to paint lies this much lower, see build_road
PAVEMENT_M = 2.6  # width of the pavement beside the road
FORECOURT_M = 6.5  # paved or planted strip up to the facades


@dataclass(frozen=True)
class GroundTexture:
    """The painted ground; cell (i, j) has its centre at ``low + (j + 0.5, i + 0.5) * cell_m`` in ground coordinates.

    Attributes:
        cell_m: Metres.
        low: ``(2,)`` ground coordinates of the corner.
        rgb: ``(H, W, 3)`` 0..1.
        height: ``(H, W)`` metres above the road's surface: a kerb's height beside the road, a little below zero around paint.
        level: ``(H, W)`` the largest square that may stand for the cell is ``cell_m * 2**level``.
    """

    cell_m: float
    low: F64
    rgb: F32
    height: F32
    level: I64


def paint_ground(site: Site, strokes: Strokes, cell_m: float, window: tuple[int, int, int, int] | None) -> GroundTexture:
    """Paint the ground.

    Args:
        site: What lies where.
        strokes: Road paint.
        cell_m: Cell size of the image.
        window: (first row, first column, rows, columns) in cells of ``cell_m``; None: the whole site, padded to whole tiles of 32 m.
    """
    if window is None:
        n = round(32.0 / cell_m)
        rows, columns = (int(np.ceil(s * CELL_M / 32.0)) * n for s in site.road.shape)
        window = (0, 0, rows, columns)
    i0, j0, rows, columns = window
    low = site.low + np.array([j0, i0]) * cell_m
    off, inside, path = (_sampled(d, site, low, cell_m, (rows, columns)) for d in (site.off_road_m, site.inside_m, site.path_m))
    road = inside > off
    edge = np.abs(inside - off)
    texture = site.scenario.environment.texture
    tag = f"ground-{cell_m}"
    grain = _noise(site, tag, (rows, columns), cell_m)

    rgb = np.empty((rows, columns, 3), dtype=np.float32)
    rgb[:] = _verge(site, off, grain, texture)
    tone = 1 + texture * (0.10 * grain - _wear(site, low, cell_m, (rows, columns)))
    rgb[road] = (np.array(ASPHALT, dtype=np.float32) * tone[..., None])[road]
    # Cells half covered by a thin line would alias along the crisp strokes laid over them.
    thinnest = 0.3 if cell_m < CELL_M else 0.0
    covers = [_coverage(strokes, colour, low, cell_m, (rows, columns), thinnest) for colour in (WHITE, YELLOW)]
    for colour, cover in zip((WHITE, YELLOW), covers, strict=True):
        worn = cover * (0.95 - 0.12 * texture * np.clip(grain, 0, 2))
        rgb += worn[..., None] * (np.array(PAINT_IMAGE_RGB[colour], dtype=np.float32) - rgb)

    painted = np.zeros((rows, columns), dtype=bool)
    for colour in (WHITE, YELLOW):
        painted |= _coverage(strokes, colour, low, cell_m, (rows, columns)) > 0.04
    near_paint = np.full_like(edge, 1.0e3)
    if painted.any():
        near_paint = cv2.distanceTransform((~painted).astype(np.uint8), cv2.DIST_L2, 5) * np.float32(cell_m)
    feature = np.minimum(edge, near_paint)
    if cell_m < CELL_M:
        cap = np.where(road & (path < 2.5), 0.125, np.where(road & (path < 6.0), 0.25, 0.5))
    else:
        cap = np.clip(0.06 * path, 0.5, 4.0)
    wanted = np.clip(0.6 * feature, cell_m, np.maximum(cap, cell_m))
    level = np.floor(np.log2(wanted / cell_m) + 1e-6).astype(np.int64)
    trench = (near_paint < TRENCH_M) & (edge > TRENCH_M)  # not at the kerb's foot: a gap would open there
    height = np.where(road, np.where(trench, -TRENCH_DEPTH_M, 0.0), 0.0 if site.highway else KERB_M)
    return GroundTexture(cell_m, low, np.clip(rgb, 0, 1), height.astype(np.float32), level)


def _sampled(raster: F32, site: Site, low: F64, cell_m: float, shape: tuple[int, int]) -> F32:
    """Resample one of the site's rasters, bilinear, the border continued."""
    scale = cell_m / CELL_M
    shift = (low - site.low) / CELL_M + 0.5 * scale - 0.5
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(raster.astype(np.float32), matrix, (shape[1], shape[0]), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def _noise(site: Site, tag: str, shape: tuple[int, int], cell_m: float) -> F32:
    """Return smooth noise ``(H, W)`` of about unit spread: octaves from the grain of asphalt to patches of ten metres."""
    total = np.zeros(shape, dtype=np.float32)
    rng = site.rng(tag)
    for grid_m, weight in ((0.13, 0.6), (0.4, 0.45), (1.2, 0.4), (3.0, 0.4), (12.0, 0.45)):
        step = max(grid_m, cell_m)
        small = rng.standard_normal((int(shape[0] * cell_m / step) + 3, int(shape[1] * cell_m / step) + 3)).astype(np.float32)
        total += weight * cv2.resize(small, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return total


def _verge(site: Site, off: F32, grain: F32, texture: float) -> F32:
    """Colour the ground beside the road: pavement with slabs, then forecourt or grass."""
    grass = np.array(GRASS, dtype=np.float32) * (1 + 0.20 * texture * grain[..., None])
    if site.highway:
        gravel = np.array([0.46, 0.43, 0.38], dtype=np.float32) * (1 + 0.08 * texture * grain[..., None])
        return np.where((off < 1.0)[..., None], gravel, grass)
    pavement = np.array(PAVEMENT, dtype=np.float32) * (1 + 0.06 * texture * grain[..., None])
    joint = (np.abs(off - 1.3) < 0.07)[..., None]
    pavement = np.where(joint, 0.85 * pavement, pavement)
    built = site.scenario.environment.buildings
    forecourt = np.array([0.47, 0.45, 0.42], dtype=np.float32) * (1 + 0.08 * texture * grain[..., None]) if built > 0.5 else grass
    return np.where((off < PAVEMENT_M)[..., None], pavement, np.where((off < FORECOURT_M)[..., None], forecourt, grass))


def _wear(site: Site, low: F64, cell_m: float, shape: tuple[int, int]) -> F32:
    """Return what darkens asphalt, 0..1: wheel tracks and the oil line of each lane, patches and cracks near the path."""
    dark = np.zeros(shape, dtype=np.uint8)
    high = low + np.array(shape[::-1]) * cell_m
    for lane in site.scenario.lane_map.lanes.values():
        if lane.kind not in ("vehicle", "bus") or lane.is_intersection or len(lane.centre) < 2:
            continue
        line = site.frame.to_ground(lane.centre)
        if np.any(line.max(axis=0) < low) or np.any(line.min(axis=0) > high):
            continue
        d = np.gradient(line, axis=0)
        left = np.stack([-d[:, 1], d[:, 0]], axis=1) / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9)
        for side in (-0.85, 0.85):
            points = to_pixels(line + side * left, low, cell_m)
            cv2.polylines(dark, [points], False, 26, max(1, round(0.6 / cell_m)), cv2.LINE_8, SHIFT_BITS)
        cv2.polylines(dark, [to_pixels(line, low, cell_m)], False, 14, max(1, round(0.4 / cell_m)), cv2.LINE_8, SHIFT_BITS)
    soft: U8 = cv2.GaussianBlur(dark, (0, 0), max(0.2 / cell_m, 0.5))
    if cell_m < CELL_M:
        _patches_and_cracks(site, soft, low, cell_m)
    return np.asarray(soft.astype(np.float32) / 255.0)


def _patches_and_cracks(site: Site, dark: U8, low: F64, cell_m: float) -> None:
    rng = site.rng("cracks")
    path = site.path
    for _ in range(max(2, len(path) // 12)):
        centre = path[rng.integers(len(path))] + rng.uniform(-6, 6, 2)
        half = rng.uniform([0.6, 0.4], [2.2, 1.2])
        angle = rng.normal(0.0, 0.05)
        c, s = np.cos(angle), np.sin(angle)
        ring = centre + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half) @ np.array([[c, s], [-s, c]])
        cv2.fillPoly(dark, [to_pixels(ring, low, cell_m)], int(rng.integers(28, 55)), cv2.LINE_8, SHIFT_BITS)
    for _ in range(max(3, len(path) // 6)):
        start = path[rng.integers(len(path))] + rng.uniform(-6, 6, 2)
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.35, 14))
        line = start + np.cumsum(0.35 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
        cv2.polylines(dark, [to_pixels(line, low, cell_m)], False, int(rng.integers(60, 100)), 1, cv2.LINE_AA, SHIFT_BITS)


def _coverage(strokes: Strokes, colour: int, low: F64, cell_m: float, shape: tuple[int, int], thinnest_m: float = 0.0) -> F32:
    """Return the share ``(H, W)`` of each cell under paint of one colour; strokes thinner than ``thinnest_m`` are left out."""
    mask = np.zeros(shape, dtype=np.uint8)
    high = low + np.array(shape[::-1]) * cell_m
    near = np.all((strokes.start > low - 5) & (strokes.start < high + 5), axis=1)
    mine = near & (strokes.colour == colour) & (strokes.width_m >= thinnest_m)
    start, end, width = strokes.start[mine], strokes.end[mine], strokes.width_m[mine]
    along = end - start
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / length * (width / 2)[:, None]
    along = along / length * 0.02
    rings = np.stack([start - left - along, end - left + along, end + left + along, start + left - along], axis=1)
    # Strokes of coarse images are thinner than a pixel: paint at four times the resolution would be exact, area weighting is enough.
    gain = np.minimum(1.0, width / cell_m)
    for ring, share in zip(to_pixels(rings.reshape(-1, 2), low, cell_m).reshape(-1, 4, 2), gain, strict=True):
        cv2.fillConvexPoly(mask, ring, int(255 * share), cv2.LINE_AA if share == 1.0 else cv2.LINE_8, SHIFT_BITS)
    return np.asarray(mask.astype(np.float32) / 255.0)
