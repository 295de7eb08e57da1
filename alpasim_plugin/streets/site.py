"""Rasterise a scenario's plan: where is road, how far is it to the road's edge, where have vehicles
been.

Maps come with very different content (lane edges or only centres, drivable areas or none), so
everything that is built beside or on the road is derived from one raster of the plan, in a frame
turned along the logged path. Kerbs, trees, poles and facades stand along its level lines
(`contours`).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import scipy
import shapely

from alpasim_plugin.core.geometry import (
    arc_lengths,
    heading_of,
    left_of,
    resample,
    unit,
    yaw_from_quat,
)
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64, I64, Bool, Lane, Scenario

HeightAt = Callable[[F64], F64]  # (N, 2+) world xy -> (N,) metres

CELL_M = 0.25
AHEAD_M = 40.0  # of the route behind the logged path
REACH_M = 110.0  # how far from the path the rasters reach
CLOSE_GAP_M = 1.5  # gaps between lanes narrower than twice this are road too
SHIFT_BITS = 4  # sub-pixel bits of the polygon filler
HIGHWAY_MPS = 22.0
TILE_M = 32.0  # a section owns whole tiles; all grids of the ground are cut along them
WIDEST_ISLAND_M = 100.0  # of the middle of a roundabout
ROUND = (
    0.93  # of a round island, the share that the largest circle in it covers; of a hexagon 0.907
)
HORIZON_M = 160.0  # large Gaussians lie so far around the rasters
SECTION_M = 250  # of the path
OVERLAP_M = 40  # a section's path goes on into its neighbours


@dataclass(frozen=True)
class GroundFrame:
    """A ground frame: metres along x and y after turning the world by ``-yaw_rad`` about
    ``origin_xy``.
    """

    origin_xy: F64  # (2,) metres, world
    yaw_rad: float

    def to_ground(self, xy: F64) -> F64:
        """Map world points ``(N, 2+)`` to ground coordinates ``(N, 2)``."""
        c = np.cos(self.yaw_rad)
        s = np.sin(self.yaw_rad)
        d = np.asarray(xy, dtype=np.float64)[:, :2] - self.origin_xy
        return np.column_stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]])

    def to_world(self, plan: F64) -> F64:
        """Map ground coordinates ``(N, 2)`` to world points ``(N, 2)``."""
        return self.turned(plan)[:, :2] + self.origin_xy

    def turned(self, plan: F64) -> F64:
        """Turn ground directions ``(N, 2)`` to level world directions ``(N, 3)``."""
        c = np.cos(self.yaw_rad)
        s = np.sin(self.yaw_rad)
        return np.column_stack(
            [c * plan[:, 0] - s * plan[:, 1], s * plan[:, 0] + c * plan[:, 1], np.zeros(len(plan))]
        )


@dataclass(frozen=True)
class Site:
    """The ground plan of a scene as rasters.

    Attributes:
        scenario: What is built.
        height_at: Ground height under world points.
        frame: Ground frame; cell (row i, column j) of a raster has its centre at ``low + (j + 0.5,
            i + 0.5) * CELL_M``.
        low: ``(2,)`` ground coordinates of the raster's corner, metres.
        path: ``(N, 2)`` logged path and what the route adds to it, ground coordinates, points 1 m
            apart.
        road: ``(H, W)`` bool, paved for vehicles.
        taken: ``(H, W)`` bool, ground that actors stand on or drive over at any time.
        highway: Fast road without pavements and houses at its edge.
        section: Number of the section along the path that is built; None: all of it.
        owned: ``(Ty, Tx)`` bool, which tiles of `TILE_M`, from ``low - HORIZON_M`` on, are built.
    """

    scenario: Scenario
    height_at: HeightAt
    frame: GroundFrame
    low: F64
    path: F64
    road: Bool
    taken: Bool
    highway: bool
    section: int | None
    owned: Bool

    def rng(self, component: str) -> np.random.Generator:
        """Return the random stream of one part of the scene."""
        part = "" if self.section is None else f"{self.section}/"
        return stream(self.scenario.scene_id, self.scenario.seed, f"scene/{part}{component}")

    def owns(self, plan: F64) -> Bool:
        """Return which ground points ``(N, 2)`` lie in tiles that are built."""
        return cells_at(self.owned, plan - self.low + HORIZON_M, TILE_M)

    @property
    def owned_cells(self) -> Bool:
        """Return ``(H, W)`` which cells of the rasters lie in tiles that are built."""
        first = round(HORIZON_M / TILE_M)
        cells = round(TILE_M / CELL_M)
        h, w = self.road.shape
        tiles = self.owned[first:, first:]
        return np.repeat(np.repeat(tiles, cells, axis=0), cells, axis=1)[:h, :w]

    @cached_property
    def off_road_m(self) -> F32:
        """Return ``(H, W)`` the distance of each cell to the road; 0 on it."""
        return distance_m(self.road)

    @cached_property
    def inside_m(self) -> F32:
        """Return ``(H, W)`` the distance of each road cell to the road's edge; 0 outside."""
        return distance_m(~self.road)

    @cached_property
    def path_m(self) -> F32:
        """Return ``(H, W)`` the distance of each cell to the path."""
        mask = np.zeros(self.road.shape, dtype=np.uint8)
        cv2.polylines(mask, [self.pixels(self.path)], False, 1, 1, cv2.LINE_8, SHIFT_BITS)
        return distance_m(mask.astype(bool))

    @cached_property
    def islands(self) -> Bool:
        """Return ``(H, W)`` which cells lie on islands: round land with road all around, as in the
        middle of a roundabout. Blocks of houses have corners.
        """
        count, number, stats, _ = cv2.connectedComponentsWithStats((~self.road).astype(np.uint8))
        h, w = self.road.shape
        island = np.zeros(count, dtype=bool)
        for k in range(1, count):
            left, top, width, height, cells = stats[k].tolist()
            is_enclosed = left > 0 and top > 0 and left + width < w and top + height < h
            if is_enclosed and max(width, height) * CELL_M < WIDEST_ISLAND_M:
                window = slice(top, top + height), slice(left, left + width)
                inside = number[window] == k
                radius_m = float(self.off_road_m[window][inside].max())
                island[k] = np.pi * radius_m**2 > ROUND * cells * CELL_M**2
        return island[number]

    def pixels(self, plan: F64) -> npt.NDArray[np.int32]:
        """Return ground points ``(N, 2)`` as fixed-point pixels for OpenCV's drawing functions."""
        return to_pixels(plan, self.low, CELL_M)

    def look_up(self, raster: npt.NDArray[Any], plan: F64) -> npt.NDArray[Any]:
        """Return the raster's values ``(N,)`` at ground points ``(N, 2)``; points outside take the
        border's value.
        """
        return cells_at(raster, plan - self.low, CELL_M)

    def world(self, plan: F64, above_m: float | F64 = 0.0) -> F64:
        """Return world points ``(N, 3)`` standing ``above_m`` over the ground at ground points
        ``(N, 2)``.
        """
        xy = self.frame.to_world(plan)
        return np.column_stack([xy, self.height_at(xy) + above_m])


def cells_at(raster: npt.NDArray[Any], xy: F64, cell_m: float) -> npt.NDArray[Any]:
    """Return a raster's values ``(N,)`` at points ``(N, 2)`` relative to its corner; points outside
    take the border's value.
    """
    ij = np.floor(xy / cell_m).astype(np.int64)
    h, w = raster.shape
    return raster[np.clip(ij[:, 1], 0, h - 1), np.clip(ij[:, 0], 0, w - 1)]


def to_pixels(plan: F64, low: F64, cell_m: float) -> npt.NDArray[np.int32]:
    """Return ground points as fixed-point pixels with `SHIFT_BITS` fractional bits, pixel centres
    at integers.
    """
    return np.round(((plan - low) / cell_m - 0.5) * (1 << SHIFT_BITS)).astype(np.int32)


def distance_m(mask: Bool, cell_m: float = CELL_M) -> F32:
    """Return the distance of each cell to the nearest true cell, metres; far away where there is
    none.
    """
    if not mask.any():
        return np.full(mask.shape, 1.0e3, dtype=np.float32)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) * np.float32(cell_m)


def make_site(scenario: Scenario, height_at: HeightAt, section: int | None = None) -> Site:
    """Rasterise the ground plan of a scenario, or of a section of `SECTION_M` along its path.

    A section owns the tiles whose centres are nearest to its part of the path, so that sections
    have no ground in common and leave none out.
    """
    path_world = path_of(scenario)
    chord = path_world[-1, :2] - path_world[0, :2]
    heading = scenario.ego_log.quat[0]
    yaw = heading_of(chord) if np.hypot(*chord) > 5.0 else yaw_from_quat(heading)
    frame = GroundFrame(path_world[0, :2], float(yaw))
    whole = path = frame.to_ground(path_world)
    if section is None:
        low = np.floor(path.min(axis=0) - REACH_M)
    else:
        first = section * SECTION_M
        path = whole[max(0, first - OVERLAP_M) : first + SECTION_M + OVERLAP_M]
        low = np.floor((path.min(axis=0) - REACH_M) / TILE_M) * TILE_M
    size = np.ceil((path.max(axis=0) + REACH_M - low) / CELL_M).astype(int)
    shape = (int(size[1]), int(size[0]))

    lanes = list(scenario.lane_map.lanes.values())
    high = low + size * CELL_M
    near = []
    for lane in lanes:
        plan = frame.to_ground(lane.centre)
        if np.all(plan.max(axis=0) > low) and np.all(plan.min(axis=0) < high):
            near.append(lane)
    road = np.zeros(shape, dtype=np.uint8)
    for ring in (*_lane_rings(near), *scenario.lane_map.drivable_areas):
        if len(ring) >= 3:
            corners = to_pixels(frame.to_ground(ring), low, CELL_M)
            cv2.fillPoly(road, [corners], 1, cv2.LINE_8, SHIFT_BITS)
    half = scenario.vehicle.box.width_m / 2 + 0.6
    thickness = max(1, round(2 * half / CELL_M))
    cv2.polylines(road, [to_pixels(path, low, CELL_M)], False, 1, thickness, cv2.LINE_8, SHIFT_BITS)
    k = 2 * round(CLOSE_GAP_M / CELL_M) + 1
    road = cv2.morphologyEx(
        road, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (k, k))
    )
    # A soft edge instead of the raster's staircase: kerbs and grass follow the half-way line.
    road = (cv2.GaussianBlur(road.astype(np.float32), (0, 0), 1.5) > 0.5).astype(np.uint8)
    mask = np.zeros(shape, dtype=np.uint8)
    for actor in scenario.actors:
        radius = 0.5 * np.hypot(actor.box.length_m, actor.box.width_m) + 0.5
        points = to_pixels(frame.to_ground(actor.track.xyz), low, CELL_M)
        thickness = max(1, min(round(2 * radius / CELL_M), 60))
        cv2.polylines(mask, [points], False, 1, thickness, cv2.LINE_8, SHIFT_BITS)
    taken = mask.astype(bool)
    highway = _is_highway(scenario, near)
    owned = _owned_tiles(whole, low, high, section)
    return Site(
        scenario, height_at, frame, low, path, road.astype(bool), taken, highway, section, owned
    )


def _owned_tiles(path: F64, low: F64, high: F64, section: int | None) -> Bool:
    """Return which tiles ``(Ty, Tx)`` of a site, and around it to the horizon, a section owns."""
    count = np.ceil((high - low + 2 * HORIZON_M) / TILE_M).astype(np.int64)
    if section is None:
        return np.ones(count[::-1], dtype=bool)
    grid = np.stack(np.meshgrid(np.arange(count[0]), np.arange(count[1])), axis=-1)
    _, nearest = scipy.spatial.KDTree(path).query(low - HORIZON_M + (grid + 0.5) * TILE_M)
    return section_of(nearest) == section


def section_of(point: I64) -> I64:
    """Return the section of points of the path, by their numbers."""
    return point // SECTION_M


def path_of(scenario: Scenario) -> F64:
    """Return the logged path and the route behind its end, ``(N, 3)`` world, one point a metre:
    40 m of it, and more where a rollout may go farther than the rasters would reach.
    """
    log = scenario.ego_log.xyz
    length = float(arc_lengths(log)[-1])
    route = scenario.route.xyz
    line = log
    if len(route) > 1:
        s = arc_lengths(route)
        end = np.argmin(np.sum((route[:, :2] - log[-1, :2]) ** 2, axis=1))
        more_m = AHEAD_M
        if len(scenario.path_beyond) > 1:
            beyond_m = float(arc_lengths(scenario.path_beyond)[-1])
            more_m = max(more_m, beyond_m - REACH_M)
        line = np.concatenate([log, route[(s > s[end] + 0.5) & (s < s[end] + more_m)]])
        length = float(arc_lengths(line)[-1])
    if length < 1.0:
        q = scenario.ego_log.quat[0]
        forward = np.array([1 - 2 * (q[2] ** 2 + q[3] ** 2), 2 * (q[1] * q[2] + q[0] * q[3]), 0.0])
        line = np.stack([log[0], log[0] + 2.0 * forward])
        length = 2.0
    return resample(line, np.linspace(0.0, length, max(2, int(np.ceil(length)) + 1)))


def _lane_rings(lanes: Iterable[Lane]) -> list[F64]:
    rings = []
    for lane in lanes:
        areas = [
            part
            for part in shapely.get_parts(lane_polygon(lane))
            if shapely.get_dimensions(part) == 2 and not shapely.is_empty(part)
        ]
        rings += [shapely.get_coordinates(shapely.get_exterior_ring(area)) for area in areas]
    return rings


def _is_highway(scenario: Scenario, near: list[Lane]) -> bool:
    """Return whether the road is a highway: by what the map calls its roads, else by speed limits, or
    without them by four parallel lanes and no crossing.
    """
    driven = [lane.is_motorway for lane in near if lane.kind == "vehicle"]
    if 2 * sum(driven) > len(driven):
        return True
    if (
        scenario.lane_map.crosswalks
        or any(lane.is_intersection for lane in near)
        or scenario.lane_map.stop_lines
    ):
        return False
    limits = [lane.speed_limit_mps for lane in near if lane.speed_limit_mps is not None]
    if limits:
        return float(np.median(limits)) >= HIGHWAY_MPS
    lanes = scenario.lane_map.lanes

    def abreast(lane: Lane) -> int:
        count = 1
        visited = {lane.lane_id}
        for side in ("left_neighbour", "right_neighbour"):
            neighbour: Lane | None = lane
            while (
                neighbour is not None
                and (name := getattr(neighbour, side)) in lanes
                and name not in visited
            ):
                visited.add(name)
                neighbour = lanes[name]
                count = count + 1
        return count

    return max((abreast(lane) for lane in near), default=1) >= 4


SMOOTH = 9  # points of the moving average that takes the raster's steps out of a contour


class Roadside(NamedTuple):
    """Places along a line beside the road, ground coordinates."""

    xy: F64  # (N, 2) metres
    along: F64  # (N, 2) unit, road on the left
    away: F64  # (N, 2) unit, from the road


def contours(site: Site, beyond_m: float, within_path_m: float) -> list[F64]:
    """Return the lines ``(N, 2)`` where the distance to the road is ``beyond_m``, in ground
    coordinates, the road on their left.

    Args:
        site: What lies where.
        beyond_m: Distance from the road's edge, metres.
        within_path_m: Lines are cut where they are farther than this from the path.
    """
    off = site.off_road_m if beyond_m > 0 else site.off_road_m - site.inside_m
    mask = (off > beyond_m).astype(np.uint8)
    rings, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    near = site.path_m < within_path_m
    lines = []
    for ring in rings:
        pixels = ring[:, 0, :]
        if len(pixels) < 4 * SMOOTH:
            continue
        plan = site.low + (pixels + 0.5) * CELL_M
        wrapped = np.concatenate([plan[-SMOOTH:], plan, plan[:SMOOTH]])
        kernel = np.ones(SMOOTH) / SMOOTH
        smooth = np.column_stack(
            [np.convolve(wrapped[:, axis], kernel, mode="same") for axis in range(2)]
        )[SMOOTH:-SMOOTH]
        h, w = mask.shape
        inner = (
            (pixels[:, 0] > 1)
            & (pixels[:, 0] < w - 2)
            & (pixels[:, 1] > 1)
            & (pixels[:, 1] < h - 2)
        )
        keep = inner & near[pixels[:, 1], pixels[:, 0]]
        lines += [_road_on_left(site, part) for part in _runs(smooth, keep) if len(part) > 8]
    return lines


def _runs(points: F64, keep: Bool) -> list[F64]:
    """Cut a closed line into the pieces where ``keep`` holds."""
    if keep.all():
        return [np.concatenate([points, points[:1]])]
    start = int(np.argmin(keep))
    points = np.roll(points, -start, axis=0)
    keep = np.roll(keep, -start)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], keep.astype(np.int8), [0]])))
    return [points[begin:end] for begin, end in zip(edges[::2], edges[1::2], strict=True)]


def _road_on_left(site: Site, line: F64) -> F64:
    """Turn a line so that the road lies to its left; which side it is on is voted by all points."""
    left = left_of(unit(np.gradient(line, axis=0)))
    signed = site.off_road_m - site.inside_m
    nearer = site.look_up(signed, line + left) < site.look_up(signed, line - left)
    return line if np.mean(nearer) >= 0.5 else line[::-1].copy()


def places(line: F64, spacing_m: float, first_m: float = 0.0) -> Roadside:
    """Return places every ``spacing_m`` along a line that has the road on its left."""
    s = np.arange(first_m, float(arc_lengths(line)[-1]), spacing_m)
    xy = resample(line, s)
    along = unit(resample(line, s + 0.5) - resample(line, s - 0.5))
    return Roadside(xy, along, -left_of(along))
