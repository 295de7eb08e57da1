"""Obstacles from pixels: regions in front of the car that do not look like the road, from their
ground contact up.

An obstacle of height ``H`` at distance ``d`` from a camera of height ``h`` hides the ground behind
it up to ``d h / (h - H)``. On the ground grid it is therefore a long patch that starts at its foot
(the ground contact point); paint, a shadow or new asphalt makes a short one. The foot gives the
distance by the ground plane.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64, I64, U8
from policies.road_vision import CELL_M, GroundGrid

STRIPS = 4
CORRIDOR_HALF_M = 1.05  # half the ego's width: what stands outside can be passed
# Of the strips, to the left of the path
EDGES_M = np.linspace(CORRIDOR_HALF_M, -CORRIDOR_HALF_M, STRIPS + 1)
TALL = 0.8  # how high to look, as a share of the camera's height
LOW = 0.35  # the least share required where a curve ends the line of sight
LEAVE_LANE_M = 2.6
# Thinner patches are lane markings: lines, and the bars of a crosswalk
NARROW_M = 0.35
WIDE_M = 0.8
ROAD_NEAR_M = 5.5
ROAD_FAR_M = 12.0
ROAD_HALF_M = 0.9
LEARN = 0.1
FILLED = 0.7
FILLED_TOP = 0.55
CLEAR = 0.35


@dataclass(frozen=True)
class RoadColour:
    """Colour model of the road: centre and tolerance per Lab channel."""

    centre: F64  # (3,)
    tolerance: F64  # (3,)


def learn_road(
    colour: RoadColour | None, lab: U8, grid: GroundGrid, centre_y: F64, free_to_m: float
) -> RoadColour | None:
    """Refine the road's colour from the patch in front of the car, as far as it is known to be
    free.

    Args:
        colour: Current estimate.
        lab: ``(R, C, 3)`` warped frame in Lab.
        grid: The grid of the frame.
        centre_y: ``(R,)`` lateral position of the ego's path.
        free_to_m: Nothing stands nearer than this.
    """
    rows = np.flatnonzero(
        (grid.x_m >= ROAD_NEAR_M) & (grid.x_m <= min(ROAD_FAR_M, free_to_m - 2.0))
    )
    if len(rows) < 3:
        return colour
    columns = (
        grid.column_of(centre_y[rows])[:, None]
        + np.arange(-ROAD_HALF_M, ROAD_HALF_M, 2 * CELL_M) / CELL_M
    )
    index = np.minimum(np.maximum(np.rint(columns).astype(np.intp), 0), lab.shape[1] - 1)
    patch = lab[rows[:, None], index].reshape(-1, 3)
    patch = patch[grid.inside[rows[:, None], index].reshape(-1)]
    if len(patch) < 50:
        return colour
    middle = np.median(patch, axis=0)
    spread = 1.4826 * np.median(np.abs(patch - middle), axis=0)
    new = RoadColour(middle, np.maximum(np.array([22.0, 7.0, 7.0]), 4.0 * spread))
    if colour is None:
        return new
    # A sudden change is more likely an obstacle than a new road surface: adapt slowly.
    step = np.clip(new.centre - colour.centre, -20.0, 20.0)
    return RoadColour(
        colour.centre + LEARN * step, colour.tolerance + LEARN * (new.tolerance - colour.tolerance)
    )


def anomaly(lab: U8, colour: RoadColour, grid: GroundGrid) -> U8:
    """Return 0..255 per cell ``(R, C)``: how far its colour is from the road's, by the worst
    channel.
    """
    level = np.arange(256, dtype=np.float64)[:, None]
    away = np.abs(level - colour.centre) / colour.tolerance
    table = (255 * np.clip((away - 0.7) / 0.6, 0.0, 1.0)).astype(np.uint8)
    light, a, b = (
        cv2.LUT(channel, column)
        for channel, column in zip(cv2.split(lab), np.ascontiguousarray(table.T), strict=True)
    )
    return cv2.max(light, cv2.max(a, b)) * grid.inside.view(np.uint8)


def find_foot(
    value: U8, grid: GroundGrid, centre_y: F64, min_x_m: float, max_x_m: float
) -> tuple[float, float] | None:
    """Return (distance, its standard deviation) of the nearest obstacle in the corridor along
    ``centre_y`` (R,), or None.

    The corridor is cut into strips. In each, a row is a foot if the ground in front of it is clear
    and what lies behind it on the camera's line of sight is filled, up to where an obstacle of
    `TALL` times the camera's height would hide the ground: a crosswalk does not reach that far, so
    the furthest quarter must be filled as well. In a curve the line of sight leaves the lane, and
    what is seen there is not evidence; such a row must be filled by something wider than the bars
    of a crosswalk, and it is no candidate where even an object of `LOW` could not be detected.

    Args:
        value: `anomaly` of the frame.
        grid: The grid of the frame.
        centre_y: Lateral position of the ego's path at each row.
        min_x_m: Nearest candidate.
        max_x_m: Furthest candidate.
    """
    x_camera, _ = grid.camera_xz
    distance = grid.x_m - x_camera
    rows = np.arange(len(distance))
    full = np.searchsorted(distance, distance / (1 - TALL))
    least = np.searchsorted(distance, distance / (1 - LOW))
    left_at = _lane_left_at(distance, centre_y, grid)
    last = np.minimum(full[:, None], np.where(left_at > 0, left_at, len(rows)))
    candidate = ((grid.x_m >= min_x_m) & (grid.x_m <= max_x_m))[:, None]
    usable = (
        candidate & (last >= np.minimum(least, len(rows))[:, None]) & (last - rows[:, None] >= 3)
    )
    u = np.rint(grid.sight_column(centre_y[:, None] + EDGES_M, rows)).astype(np.intp)
    u = np.minimum(np.maximum(u, 0), grid.sight_index.shape[1])
    begin = rows[:, None]
    narrow = _sums_along_sight(value, NARROW_M, grid)
    in_curve = last < full[:, None]
    filled = _box_mean(narrow, begin, last, u)
    if (in_curve & usable).any():
        filled = np.where(
            in_curve, _box_mean(_sums_along_sight(value, WIDE_M, grid), begin, last, u), filled
        )
    hit = (filled > FILLED) & usable
    if not hit.any():
        return None
    front = np.searchsorted(distance, 0.82 * distance)[:, None]
    clear = _box_mean(narrow, front, np.maximum(begin - 1, front), u)
    up_to_top = _box_mean(narrow, last - np.maximum((last - begin) // 4, 1), last, u)
    hit &= (up_to_top > FILLED_TOP) & (clear < CLEAR)
    if not hit.any():
        return None
    first = int(np.argmax(hit.any(axis=1)))
    strips = np.flatnonzero(hit[first])
    # A box that is mostly filled may begin before the obstacle does: the foot is where its rows
    # become anomalous.
    behind = np.arange(first, int(last[first, strips].max()))[:, None]
    level = _box_mean(narrow, behind, behind + 1, u[first : first + 1])[:, strips].mean(axis=1)
    i = first + int(np.argmax(level > 0.5))
    return float(grid.x_m[i]), float(np.hypot(0.3, 0.6 * grid.row_m[i]))


def _lane_left_at(distance: F64, centre_y: F64, grid: GroundGrid) -> I64:
    """Return the row ``(R, STRIPS)`` at which the line of sight through each strip of a row leaves
    the lane, in a curve and to the sides; 0 where it does not.
    """
    rows = np.arange(len(distance))
    middle = centre_y[:, None] + 0.5 * (EDGES_M[1:] + EDGES_M[:-1]) - grid.camera_y
    # (R, STRIPS, R); in place from here on, as it is large
    sight = middle[:, :, None] * (distance / distance[:, None, None])
    sight += grid.camera_y
    sight -= centre_y
    has_left = np.abs(sight, out=sight) > LEAVE_LANE_M
    has_left &= rows > rows[:, None, None]
    return np.argmax(has_left, axis=2)  # no row is later than itself, so 0 stands for none


def _sums_along_sight(value: U8, width_m: float, grid: GroundGrid) -> F64:
    """Return the integral image ``(R + 1, U + 1)``, over grid rows and image columns, of the
    anomaly in 0..1 that is at least so wide.
    """
    bar = np.ones((1, round(width_m / CELL_M) | 1), dtype=np.uint8)
    sight_values = np.take(cv2.morphologyEx(value, cv2.MORPH_OPEN, bar), grid.sight_index)
    table = cv2.integral(sight_values, sdepth=cv2.CV_64F)
    return np.divide(table, 255.0, out=table)


def _box_mean(
    table: F64, first: npt.NDArray[np.intp], last: npt.NDArray[np.intp], u: npt.NDArray[np.intp]
) -> F64:
    """Return the means ``(N, STRIPS)`` over rows first..last-1 and columns between neighbouring
    edges ``u``.

    Args:
        table: From `_sums_along_sight`.
        first: ``(N, STRIPS)`` or ``(N, 1)``.
        last: The same.
        u: ``(N, STRIPS + 1)``, or ``(1, STRIPS + 1)`` for all rows.
    """
    width = table.shape[1]
    left = u[:, :-1]
    right = np.minimum(np.maximum(u[:, 1:], left + 1), width - 1)
    a = first * width
    b = last * width
    total = (
        table.take(b + right) - table.take(a + right) - table.take(b + left) + table.take(a + left)
    )
    return total / np.maximum((last - first) * (right - left), 1)


@dataclass(frozen=True)
class ObstacleTrack:
    """Track of the obstacle ahead: distance from the rear axle and its own speed."""

    distance_m: float
    speed_mps: float  # along the ego's path, over ground
    cov: F64  # (2, 2)
    hits: int = 1
    misses: int = 0

    @property
    def confirmed(self) -> bool:
        """Return whether it was seen often enough to act on."""
        return self.hits >= 3


def track_obstacle(
    track: ObstacleTrack | None,
    foot: tuple[float, float] | None,
    ego_mps: float,
    dt_s: float,
    nearest_m: float = 0.0,
) -> ObstacleTrack | None:
    """Predict the track over ``dt_s`` and correct it by a new detection; None where there is no
    obstacle.

    A foot at ``nearest_m``, the lower edge of the image, may be nearer than that: it confirms a
    track that says so.
    """
    if track is not None:
        transition = np.array([[1.0, dt_s], [0.0, 1.0]])
        q = 3.0**2 * np.array([[dt_s**4 / 4, dt_s**3 / 2], [dt_s**3 / 2, dt_s**2]])
        track = replace(
            track,
            distance_m=track.distance_m + (track.speed_mps - ego_mps) * dt_s,
            cov=transition @ track.cov @ transition.T + q,
        )
    if foot is None:
        if track is None:
            return None
        track = replace(track, misses=track.misses + 1)
        return None if track.misses > (8 if track.confirmed else 2) else track
    measured, sigma = foot
    if track is not None and measured <= nearest_m + 0.1 and track.distance_m < measured:
        return replace(track, hits=track.hits + 1, misses=0)
    if (
        track is None
        or abs(measured - track.distance_m) > 4.0 * np.sqrt(track.cov[0, 0] + sigma**2) + 2.0
    ):
        # Nothing is known of its speed: as fast as the ego, give or take 5 m/s, until it is
        # watched.
        return ObstacleTrack(
            measured, 0.6 * ego_mps, np.diag([sigma**2, (2.0 + 0.4 * ego_mps) ** 2])
        )
    gain = track.cov[:, 0] / (track.cov[0, 0] + sigma**2)
    surprise = measured - track.distance_m
    cov = track.cov - np.outer(gain, track.cov[0])
    return ObstacleTrack(
        track.distance_m + float(gain[0]) * surprise,
        max(track.speed_mps + float(gain[1]) * surprise, -2.0),
        cov,
        track.hits + 1,
        0,
    )
