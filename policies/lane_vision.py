"""Detect points of lane markings on the ground in a frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F32, F64, U8, Bool
from policies.ground_grid import CELL_M, GroundGrid

PAINT_WIDTH_M = 0.15
MIN_CONTRAST = 7.0  # grey levels
NOISE_FACTOR = 4.0
BAR_M = (0.4, 2.3)  # how far bars of a crosswalk stand from the next and the next but one
SIDE_NOT_ROAD = 0.8
BAR_HALF_M = 0.45
CROSSWALK_M = 2.5  # wider than a car, whose lights and plate are bright spots in a row as well
MERGE_M = 0.3  # ridges closer than this are one line (both strokes of a double line)


@dataclass(frozen=True)
class PaintPoints:
    """Where paint was seen: one entry per line and grid row."""

    x_m: F64  # (N,) rig
    y_m: F64  # (N,)
    strength: F64  # (N,) contrast over the row's threshold, >= 1
    sigma_m: F64  # (N,) lateral standard deviation


def brightness(ground: U8) -> F32:
    """Return the channel ``(R, C)`` in which both white and yellow paint are bright: the mean of red and green."""
    return np.asarray(cv2.addWeighted(ground[..., 0], 0.5, ground[..., 1], 0.5, 0.0), dtype=np.float32)


class RidgeFilter:
    """Contrast of each ground cell against the road on *both* sides of it.

    The stroke's width and the distance of the two flanks grow with the pixel's size on the ground, so far paint, blurred over a
    pixel or two, still stands out. A step (kerb, shadow, the side of a car) outshines one side only and gives no response.
    """

    def __init__(self, grid: GroundGrid) -> None:
        half, gap, flank = _windows(grid)
        n = len(grid.y_m)
        column, start = np.arange(n)[None, :], (n + 1) * np.arange(len(grid.x_m))[:, None]

        def window(first: F64, last: F64) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], F32]:
            a = np.clip(column + first[:, None], 0, n).astype(np.intp)
            b = np.clip(column + last[:, None] + 1, 0, n).astype(np.intp)
            return start + a, start + b, (1.0 / np.maximum(b - a, 1)).astype(np.float32)

        self._windows = window(-half, half), window(-gap - flank, -gap), window(gap, gap + flank)
        beside = np.maximum(np.rint(flank / 2), 1.0)
        self._beside = window(-gap - beside, -gap), window(gap, gap + beside)
        self._seen = _erode_rows(grid.inside, gap + flank)

    def response(self, value: F32) -> F32:
        """Return the response ``(R, C)`` of a brightness ``(R, C)``; 0 where a flank is out of the image."""
        total = np.zeros((value.shape[0], value.shape[1] + 1), dtype=np.float32)
        np.cumsum(value, axis=1, out=total[:, 1:])
        centre, left, right = ((np.take(total, b) - np.take(total, a)) * scale for a, b, scale in self._windows)
        return np.asarray(np.where(self._seen, np.maximum(centre - np.maximum(left, right), 0.0), 0.0), dtype=np.float32)

    def worse_side(self, value: U8, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp]) -> F32:
        """Return the larger mean ``(N,)`` of a map ``(R, C)`` over the near halves of the two flanks of cells."""
        total = np.zeros((value.shape[0], value.shape[1] + 1), dtype=np.float32)
        np.cumsum(value, axis=1, dtype=np.float32, out=total[:, 1:])
        flat = total.reshape(-1)
        left, right = ((flat[b[rows, columns]] - flat[a[rows, columns]]) * scale[rows, columns] for a, b, scale in self._beside)
        return np.asarray(np.maximum(left, right))


def find_paint(ground: U8, grid: GroundGrid, ridges: RidgeFilter, not_road: U8 | None = None) -> tuple[PaintPoints, Bool]:
    """Return the points of lines in a warped frame ``(R, C, 3)``, and the cells ``(R, C)`` that bars of a crosswalk cover.

    Where it is known what does not look like the road, 0..255 in ``not_road`` (R, C), a line must have road on both sides: kerbs and the
    edges of cars have it on one.

    Points are local maxima of the ridge response above each row's noise. A row of three and more that stand closer than any lane is wide
    are bars and no lines; they are taken for a crosswalk where they are at least four and reach further than a car is wide.
    """
    response = ridges.response(brightness(ground))
    # Paint is long and noise is not: average over three rows before looking for maxima.
    smooth = cv2.blur(response, (1, 3))
    near = round(MERGE_M / CELL_M)
    peak = cv2.dilate(smooth, np.ones((1, 2 * near + 1), np.uint8))
    spread = np.median(smooth, axis=1)
    threshold = np.maximum(MIN_CONTRAST, NOISE_FACTOR * spread)
    is_peak = (smooth >= peak) & (smooth > threshold[:, None])
    rows, cols = np.nonzero(is_peak)
    inner = (cols > 0) & (cols < smooth.shape[1] - 1)
    rows, cols = rows[inner], cols[inner]
    before, here, after = (smooth[rows, cols + d].astype(np.float64) for d in (-1, 0, 1))
    bend = np.maximum(2 * here - before - after, 1e-6)
    shift = np.clip(0.5 * (after - before) / bend, -0.5, 0.5)
    y = np.asarray(grid.y_m[cols] - shift * CELL_M)
    strength = here / threshold[rows]
    bar = _is_bar(rows, y)
    crosswalk = _cells_around(rows[bar], cols[bar], y[bar], smooth.shape)
    line = ~bar
    if not_road is not None:
        line &= ridges.worse_side(not_road, rows, cols) < 255 * SIDE_NOT_ROAD
    rows = rows[line]
    return PaintPoints(grid.x_m[rows], y[line], strength[line], np.hypot(0.05, 0.5 * grid.pixel_m[rows])), crosswalk


def _is_bar(rows: npt.NDArray[np.intp], y: F64) -> Bool:
    """Return which ridge points ``(N,)`` are bars of a crosswalk: at least two others lie beside them, closer than a lane width."""
    apart = np.abs(y[:, None] - y[None, :])
    beside = (rows[:, None] == rows[None, :]) & (apart > BAR_M[0]) & (apart < BAR_M[1])
    return np.asarray(beside.sum(axis=1) >= 2)


def _cells_around(rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], y: F64, shape: tuple[int, ...]) -> Bool:
    """Return the cells ``(R, C)`` within `BAR_HALF_M` of bars, on rows where they make a crosswalk."""
    mask = np.zeros(shape, dtype=np.uint8)
    if len(rows):
        count = np.bincount(rows, minlength=shape[0])
        high, low = np.full(shape[0], -np.inf), np.full(shape[0], np.inf)
        np.maximum.at(high, rows, y)
        np.minimum.at(low, rows, y)
        wide = (count >= 4) & (high - low > CROSSWALK_M)
        mask[rows[wide[rows]], columns[wide[rows]]] = 1
        mask = np.asarray(cv2.dilate(mask, np.ones((1, 2 * round(BAR_HALF_M / CELL_M) + 1), np.uint8)))
    return np.asarray(mask > 0)


def _windows(grid: GroundGrid) -> tuple[F64, F64, F64]:
    """Return, per row and in cells: half the stroke, the start of the flanks, and their length."""
    half = np.maximum(PAINT_WIDTH_M / 2, 0.5 * grid.pixel_m)
    gap = half + np.maximum(0.15, grid.pixel_m)
    flank = np.maximum(0.3, grid.pixel_m)
    return np.rint(half / CELL_M), np.rint(gap / CELL_M), np.rint(flank / CELL_M)


def _erode_rows(inside: Bool, reach: F64) -> Bool:
    """Return where the whole window of ``reach`` cells to both sides is inside the image; rows of a pinhole view are intervals."""
    n = inside.shape[1]
    any_inside = inside.any(axis=1)
    first = np.where(any_inside, np.argmax(inside, axis=1), n)
    last = np.where(any_inside, n - 1 - np.argmax(inside[:, ::-1], axis=1), -1)
    column = np.arange(n)[None, :]
    return np.asarray((column >= (first + reach)[:, None]) & (column <= (last - reach)[:, None]))
