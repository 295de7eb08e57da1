"""The vector map and the ground of an Argoverse 2 log."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.geometry import centre_line, wrap_angle
from alpasim_plugin.core.types import F64, HeightField, Lane, LaneMap, Paint
from alpasim_plugin.world.ground import from_points
from scenarios.reading import SourceFiles
from scenarios.road_edges import border_lines, merge_areas

# Argoverse 2 mark types -> the paints a scene can show. Mixed lines take their solid half; double white is drawn as one line.
PAINTS: dict[str, Paint] = {
    "NONE": "none",
    "UNKNOWN": "unknown",
    "SOLID_WHITE": "solid_white",
    "DASHED_WHITE": "dashed_white",
    "DOUBLE_SOLID_WHITE": "solid_white",
    "DOUBLE_DASH_WHITE": "dashed_white",
    "DASH_SOLID_WHITE": "solid_white",
    "SOLID_DASH_WHITE": "solid_white",
    "SOLID_YELLOW": "solid_yellow",
    "DASHED_YELLOW": "dashed_yellow",
    "DOUBLE_SOLID_YELLOW": "double_yellow",
    "DOUBLE_DASH_YELLOW": "double_yellow",
    "DASH_SOLID_YELLOW": "double_yellow",
    "SOLID_DASH_YELLOW": "double_yellow",
    "SOLID_BLUE": "unknown",
}
KINDS = {"VEHICLE": "vehicle", "BIKE": "bike", "BUS": "bus"}
RASTER_BLOCK = 5  # 0.3 m pixels are averaged in blocks: float16 heights near 64 m come in steps of 0.03 to 0.06 m
GROUND_CELL_M = 1.5


def read_map(files: SourceFiles, path: Path, origin: F64) -> tuple[LaneMap, tuple[str, ...]]:
    """Read ``log_map_archive_*.json`` into a lane map around ``origin (3,)``, with notes on what could not be kept.

    Raises:
        InputError: A layer or a lane's edge is missing, or a lane type is none that Argoverse 2 knows.
    """
    document = files.read_json(path)
    layers = ("lane_segments", "drivable_areas", "pedestrian_crossings")
    raw_lanes, raw_areas, raw_crossings = (_layer(files, path, document, key) for key in layers)
    if not raw_lanes:
        raise files.fail(path, "a map without lanes", "use a log whose map has lane_segments")
    if not raw_areas:
        raise files.fail(path, "a map without drivable areas, so without road edges", "use a log whose map has drivable_areas")
    strange: Counter[str] = Counter()
    lanes: dict[str, Lane] = {}
    for key, raw in raw_lanes.items():
        where = f"{path}, lane {key}"
        left, right = (_line(files, where, raw, f"{side}_lane_boundary", origin, least=2) for side in ("left", "right"))
        kind = KINDS.get(str(raw.get("lane_type")))
        if kind is None:
            raise files.fail(where, f"lane type {raw.get('lane_type')!r}", f"use one of {', '.join(KINDS)}")
        marks = [str(raw.get(f"{side}_lane_mark_type")) for side in ("left", "right")]
        strange.update(mark for mark in marks if mark not in PAINTS)
        paints = [PAINTS.get(mark, "unknown") for mark in marks]
        lanes[str(key)] = Lane(
            lane_id=str(key),
            centre=centre_line(left, right),
            left=left,
            right=right,
            kind=kind,
            successors=tuple(str(i) for i in raw.get("successors", ())),
            left_neighbour=_optional_id(raw.get("left_neighbor_id")),
            right_neighbour=_optional_id(raw.get("right_neighbor_id")),
            left_paint=paints[0],
            right_paint=paints[1],
            is_intersection=bool(raw.get("is_intersection")),
        )
    lanes = {key: _same_way_neighbours(lane, lanes) for key, lane in lanes.items()}
    areas = tuple(_closed(_line(files, f"{path}, drivable area {k}", a, "area_boundary", origin, least=3)) for k, a in raw_areas.items())
    crossings = []
    for key, raw in raw_crossings.items():
        one, two = (_line(files, f"{path}, crossing {key}", raw, edge, origin, least=2) for edge in ("edge1", "edge2"))
        crossings.append(_closed(np.concatenate([one, two[::-1]])))
    surface = merge_areas([shapely.Polygon(a[:, :2]) for a in areas])
    edges = border_lines(surface, np.concatenate(areas))
    lane_map = LaneMap(lanes=lanes, road_edges=edges, drivable_areas=areas, crosswalks=tuple(crossings))
    notes = ["road edges are the border of the union of the drivable areas; where the map is cut off, its border is an edge too"]
    notes += [f"{count} lane edges have the mark type {mark!r}: taken as paint 'unknown'" for mark, count in sorted(strange.items())]
    return lane_map, tuple(notes)


def read_ground(files: SourceFiles, folder: Path, lane_map: LaneMap, wheels: F64, origin: F64) -> HeightField:
    """Fit the ground to the log's own height raster, the lanes' edges and the wheels' path ``(N, 3)``.

    The raster is averaged over blocks of 1.5 m; its holes are bridged by the fit. Edges and path carry centimetres where it matters.
    """
    transform_path = files.only(folder, ("*___img_Sim2_city.json",), "the raster's Sim2 transform")
    raster_path = files.only(folder, ("*_ground_height_surface____*.npy",), "the ground height raster")
    sim2 = files.read_json(transform_path)
    raster = np.asarray(files.parse_npy(files.read_bytes(raster_path), raster_path))
    try:
        scale, shift = float(sim2["s"]), np.asarray(sim2["t"], dtype=np.float64)
        rotation = np.asarray(sim2["R"], dtype=np.float64).reshape(2, 2)
    except (KeyError, TypeError, ValueError) as error:
        raise files.fail(transform_path, f"no Sim2 transform: {error}", "give the keys R, t and s") from error
    if raster.ndim != 2 or raster.dtype.kind != "f" or shift.shape != (2,) or scale <= 0:
        found = f"raster {raster.dtype} {raster.shape}, scale {scale}"
        raise files.fail(raster_path, found, "give a 2-D floating-point raster with a positive scale")
    heights, rows, columns = _block_means(raster.astype(np.float64), RASTER_BLOCK)
    # Pixel = s * (R city + t), so city = R^T (pixel / s - t); block centres lie at half-integer pixels.
    city = (np.stack([columns, rows], axis=1) / scale - shift) @ rotation
    known = np.isfinite(heights)
    grid = files.near(raster_path, np.column_stack([city[known], heights[known]]) - origin)
    edges = [e for lane in lane_map.lanes.values() for e in (lane.left, lane.right) if e is not None]
    return from_points(np.concatenate([grid, *edges, *lane_map.drivable_areas, wheels]), GROUND_CELL_M, wheels)


def _block_means(raster: F64, block: int) -> tuple[F64, F64, F64]:
    """Return means of the finite pixels of square blocks and the blocks' centres in pixels: heights, rows, columns, each ``(B,)``."""
    ny, nx = raster.shape
    padded = np.full((-(-ny // block) * block, -(-nx // block) * block), np.nan)
    padded[:ny, :nx] = raster
    tiles = padded.reshape(padded.shape[0] // block, block, -1, block)
    finite = np.isfinite(tiles)
    count = finite.sum(axis=(1, 3))
    row, column = np.meshgrid(np.arange(padded.shape[0]), np.arange(padded.shape[1]), indexing="ij")

    def mean(values: F64) -> F64:
        total = np.where(finite, values.reshape(tiles.shape), 0.0).sum(axis=(1, 3))
        return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan)).ravel()

    return mean(padded), mean(row + 0.5), mean(column + 0.5)


def _layer(files: SourceFiles, path: Path, document: Any, key: str) -> dict[str, Any]:
    layer = document.get(key) if isinstance(document, dict) else None
    if not isinstance(layer, dict) or not all(isinstance(v, dict) for v in layer.values()):
        raise files.fail(path, f"no object {key!r}", "use a log_map_archive file of the Argoverse 2 sensor set")
    return layer


def _line(files: SourceFiles, where: str, raw: dict[str, Any], key: str, origin: F64, least: int) -> F64:
    """Return a polyline ``(N, 3)`` minus the origin."""
    try:
        points = np.array([[p["x"], p["y"], p["z"]] for p in raw[key]], dtype=np.float64).reshape(-1, 3)
    except (KeyError, TypeError, ValueError) as error:
        raise files.fail(where, f"no usable {key}: {error!r}", "give a list of points with x, y and z") from error
    if len(points) < least or not np.isfinite(points).all():
        raise files.fail(where, f"{key} with {len(points)} finite points", f"give at least {least} finite points")
    return files.near(where, points - origin)


def _closed(ring: F64) -> F64:
    return ring if np.array_equal(ring[0], ring[-1]) else np.concatenate([ring, ring[:1]])


def _optional_id(value: Any) -> str | None:
    return None if value is None else str(value)


def _same_way_neighbours(lane: Lane, lanes: dict[str, Lane]) -> Lane:
    """Drop neighbours that are not in the map or run the other way."""

    def heading(line: F64) -> float:
        d = line[-1, :2] - line[0, :2]
        return float(np.arctan2(d[1], d[0]))

    def keep(other: str | None) -> str | None:
        if other is None or other not in lanes:
            return None
        return other if abs(float(wrap_angle(heading(lanes[other].centre) - heading(lane.centre)))) < np.pi / 2 else None

    left, right = keep(lane.left_neighbour), keep(lane.right_neighbour)
    if (left, right) == (lane.left_neighbour, lane.right_neighbour):
        return lane
    return Lane(**{**vars(lane), "left_neighbour": left, "right_neighbour": right})
