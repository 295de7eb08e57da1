"""The road in a frame: a fixed grid of ground points with their pixels (inverse perspective
mapping), and points of lane markings on it.
"""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F32, F64, U8, Bool, CameraSpec

FAR_M = 100.0
NEAR_M = 4.5
HALF_WIDTH_M = 8.0
CELL_M = 0.05
MAX_ROWS = 72

PAINT_WIDTH_M = 0.15
MIN_CONTRAST = 7.0  # grey levels
NOISE_FACTOR = 4.0
BAR_M = (0.4, 2.3)  # how far bars of a crosswalk stand from the next and the next but one
SIDE_NOT_ROAD = 0.8
BAR_HALF_M = 0.45
CROSSWALK_M = 2.5  # wider than a car, whose lights and plate are bright spots in a row as well
MERGE_M = 0.3  # ridges closer than this are one line (both strokes of a double line)


@dataclass(frozen=True)
class GroundGrid:
    """Rows across the road, about one per image row, so that no image row is read twice and none is
    skipped.

    The ground is the plane z = 0 of the rig. ``x_m`` grows with the row index, ``y_m`` falls with
    the column index (left to right as in the image).
    """

    x_m: F64  # (R,) metres, rig
    y_m: F64  # (C,) metres, rig, from +HALF_WIDTH_M down
    map_u: F32  # (R, C) pixel column of each ground point
    map_v: F32  # (R, C)
    inside: Bool  # (R, C) the point is in the image
    pixel_m: F64  # (R,) width of one pixel on the ground
    row_m: F64  # (R,) length of one grid row along the road
    # Metres, rig: where along the rig the camera stands, and how high
    camera_xz: tuple[float, float]
    camera_y: float  # metres, rig
    focal_px: float
    # (R, U) cell of the grid, counted row by row, that image column u sees on each row
    sight_index: npt.NDArray[np.intp]

    def warp(self, image: U8) -> U8:
        """Return the image over the grid ``(R, C, 3)`` or ``(R, C)``; 0 outside the image."""
        return cv2.remap(
            image,
            self.map_u,
            self.map_v,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )

    def sight_column(self, y_m: F64, rows: npt.NDArray[np.intp]) -> F64:
        """Return the image columns ``(N, K)``, counted from the middle of `sight_index`, of lateral
        positions (N, K) on rows (N,).
        """
        distance = (self.x_m - self.camera_xz[0])[rows][:, None]
        return self.sight_index.shape[1] / 2 - (y_m - self.camera_y) / distance * self.focal_px

    def column_of(self, y_m: F64) -> F64:
        """Return fractional columns of lateral positions; may lie outside the grid."""
        return (self.y_m[0] - y_m) / CELL_M


def make_grid(camera: CameraSpec) -> GroundGrid:
    """Lay the grid for a camera.

    Raises:
        PolicyError: The camera does not see the ground between `NEAR_M` and `FAR_M` in front of the
            rear axle.
    """
    T_camera_rig = inverse(camera.T_rig_camera)
    x_camera = float(camera.T_rig_camera[0, 3])
    height = float(camera.T_rig_camera[2, 3])
    near = max(NEAR_M, x_camera + 1.0)
    candidates = np.geomspace(near, FAR_M, 2000)
    rows_v = _project(
        camera, T_camera_rig, np.column_stack([candidates, 0 * candidates, 0 * candidates])
    )[:, 1]
    v = rows_v[[0, -1]]
    if height < 0.3 or not np.isfinite(v).all() or v[0] - v[1] < 8 or v[1] > camera.height - 8:
        raise PolicyError(
            f"camera {camera.name!r} {height:.2f} m above the ground: the ground from {near:.1f} to {FAR_M:.0f} m ahead falls on image rows {v[0]:.1f} to {v[1]:.1f} of {camera.height}",
            "give the policy a front camera that sees the road",
        )
    first = min(v[0], camera.height - 1.0)
    last = v[1]
    n = int(min(MAX_ROWS, max(first - last, 8) + 1))
    # Equal steps in the image row are steps of x^2 on the ground: each grid row has its own image
    # row.
    x = np.interp(-np.linspace(first, last, n), -rows_v, candidates)
    y = HALF_WIDTH_M - CELL_M * np.arange(round(2 * HALF_WIDTH_M / CELL_M) + 1, dtype=np.float64)
    points = np.column_stack([np.repeat(x, len(y)), np.tile(y, len(x)), np.zeros(len(x) * len(y))])
    uv = _project(camera, T_camera_rig, points).reshape(len(x), len(y), 2)
    inside = np.all((uv >= 0) & (uv <= [camera.width - 1, camera.height - 1]), axis=-1)
    distance = x - x_camera
    f = float(camera.K[0, 0])
    y_camera = float(camera.T_rig_camera[1, 3])
    column = np.arange(camera.width) + 0.5 - camera.width / 2
    sight = (HALF_WIDTH_M - y_camera + column[None, :] * distance[:, None] / f) / CELL_M
    in_view = (
        np.clip(np.rint(sight), 0, len(y) - 1).astype(np.intp) + len(y) * np.arange(len(x))[:, None]
    )
    map_u = uv[..., 0].astype(np.float32)
    map_v = uv[..., 1].astype(np.float32)
    pixel_m = np.hypot(distance, height) / f
    return GroundGrid(
        x,
        y,
        map_u,
        map_v,
        inside,
        pixel_m,
        np.gradient(x),
        (x_camera, height),
        y_camera,
        f,
        in_view,
    )


def _project(camera: CameraSpec, T_camera_rig: F64, points: F64) -> F64:
    """Return pixel coordinates (N, 2) of rig points (N, 3); pixel centres at integers. NaN behind
    the camera.
    """
    points_camera = points @ T_camera_rig[:3, :3].T + T_camera_rig[:3, 3]
    z = np.where(points_camera[:, 2] > 0.1, points_camera[:, 2], np.nan)
    uvw = points_camera @ camera.K.T
    return uvw[:, :2] / z[:, None] - 0.5


@dataclass(frozen=True)
class PaintPoints:
    """Where lane markings were seen: one entry per line and grid row, the nearest rows first."""

    x_m: F64  # (N,) rig
    y_m: F64  # (N,)
    strength: F64  # (N,) contrast over the row's threshold, >= 1
    sigma_m: F64  # (N,) lateral standard deviation


def brightness(ground: U8) -> U8:
    """Return the channel ``(R, C)`` in which both white and yellow lane markings are bright: the
    mean of red and green.
    """
    return cv2.addWeighted(ground[..., 0], 0.5, ground[..., 1], 0.5, 0.0)


class RidgeFilter:
    """Contrast of each ground cell against the road on *both* sides of it.

    The stroke's width and the distance of the two flanks grow with the pixel's size on the ground,
    so far markings, blurred over a pixel or two, still stand out. A step (kerb, shadow, the side of
    a car) outshines one side only and gives no response.
    """

    def __init__(self, grid: GroundGrid) -> None:
        # Per row and in cells: half the stroke, the start of the flanks, and their length.
        half_m = np.maximum(PAINT_WIDTH_M / 2, 0.5 * grid.pixel_m)
        gap_m = half_m + np.maximum(0.15, grid.pixel_m)
        flank_m = np.maximum(0.3, grid.pixel_m)
        # (R, 3) cells: half the stroke, start and length of a flank
        sizes = np.column_stack(
            (np.rint(half_m / CELL_M), np.rint(gap_m / CELL_M), np.rint(flank_m / CELL_M))
        ).astype(np.intp)
        starts = [0, *(np.flatnonzero(np.diff(sizes, axis=0).any(axis=1)) + 1).tolist(), len(sizes)]
        # Rows of equal windows are neighbours, and a few runs of them make the grid.
        self._runs = [
            (slice(begin, end), *sizes[begin].tolist()) for begin, end in itertools.pairwise(starts)
        ]
        _, self._gap, flank = sizes.T
        self._beside = np.maximum(np.rint(flank / 2), 1.0).astype(np.intp)
        inside = grid.inside
        reach = self._gap + flank
        n = inside.shape[1]
        any_inside = inside.any(axis=1)
        first = np.where(any_inside, np.argmax(inside, axis=1), n)
        last = np.where(any_inside, n - 1 - np.argmax(inside[:, ::-1], axis=1), -1)
        column = np.arange(n)[None, :]
        self._seen = (
            (column >= (first + reach)[:, None]) & (column <= (last - reach)[:, None])
        ).astype(np.float32)

    def response(self, value: U8) -> F32:
        """Return the response ``(R, C)`` of a brightness ``(R, C)``; 0 where a flank is out of the
        image.
        """
        total = _running_sums(value)
        n = value.shape[1]
        out = np.zeros(value.shape, dtype=np.float32)
        for rows, half, gap, flank in self._runs:
            reach = gap + flank
            if 2 * reach >= n:
                continue
            # Means of all flanks of a row by the column they begin at; that to the right of a cell
            # is that to the left of one further on.
            flanks = _means(total[rows], flank + 1)
            centre = _means(total[rows, reach - half : n - reach + half + 1], 2 * half + 1)
            np.subtract(
                centre,
                np.maximum(flanks[:, : n - 2 * reach], flanks[:, reach + gap :]),
                out=out[rows, reach : n - reach],
            )
        np.maximum(out, 0.0, out=out)
        out *= self._seen
        return out

    def worse_side(
        self, value: U8, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp]
    ) -> F32:
        """Return the larger mean ``(N,)`` of a map ``(R, C)`` over the near halves of the two
        flanks of cells.
        """
        total = _running_sums(value)
        n = value.shape[1]
        gap = self._gap[rows]
        beside = self._beside[rows]

        def mean(first: npt.NDArray[np.intp], last: npt.NDArray[np.intp]) -> F32:
            a = np.minimum(np.maximum(first, 0), n)
            b = np.minimum(np.maximum(last + 1, 0), n)
            return (total[rows, b] - total[rows, a]) * (1.0 / np.maximum(b - a, 1)).astype(
                np.float32
            )

        return np.maximum(
            mean(columns - gap - beside, columns - gap),
            mean(columns + gap, columns + gap + beside),
        )


def _running_sums(value: U8) -> F32:
    """Return the sums ``(R, C + 1)`` of each row up to a column: exact, as float32 holds the sum of
    all 72 x 321 bytes of a grid.
    """
    table = cv2.integral(value, sdepth=cv2.CV_32F)
    return table[1:] - table[:-1]


def _means(total: F32, width: int) -> F32:
    """Return the means ``(R, C + 1 - width)`` over ``width`` cells, by the first of them, of
    `_running_sums` ``(R, C + 1)``.
    """
    return (total[:, width:] - total[:, :-width]) * np.float32(1.0 / width)


def find_paint(
    ground: U8, grid: GroundGrid, ridges: RidgeFilter, not_road: U8 | None = None
) -> tuple[PaintPoints, Bool]:
    """Return the points of lines in a warped frame ``(R, C, 3)``, and the cells ``(R, C)`` that
    bars of a crosswalk cover.

    Where it is known what does not look like the road, 0..255 in ``not_road`` (R, C), a line must
    have road on both sides: kerbs and the edges of cars have it on one.

    Points are local maxima of the ridge response above each row's noise. A row of three and more
    that stand closer than any lane is wide are bars and no lines; they are taken for a crosswalk
    where they are at least four and reach further than a car is wide.
    """
    response = ridges.response(brightness(ground))
    # Lane markings are long and noise is not: average over three rows before looking for maxima.
    smooth = cv2.blur(response, (1, 3))
    near = round(MERGE_M / CELL_M)
    peak = cv2.dilate(smooth, np.ones((1, 2 * near + 1), dtype=np.uint8))
    # The median, of an odd number of columns
    spread = np.sort(smooth, axis=1)[:, smooth.shape[1] // 2]
    threshold = np.maximum(MIN_CONTRAST, NOISE_FACTOR * spread)
    is_peak = (smooth >= peak) & (smooth > threshold[:, None])
    rows, cols = np.divmod(np.flatnonzero(is_peak), smooth.shape[1])
    inner = (cols > 0) & (cols < smooth.shape[1] - 1)
    rows = rows[inner]
    cols = cols[inner]
    before, centre, after = (smooth[rows, cols + shift].astype(np.float64) for shift in (-1, 0, 1))
    bend = np.maximum(2 * centre - before - after, 1e-6)
    shift = np.minimum(np.maximum(0.5 * (after - before) / bend, -0.5), 0.5)
    y = grid.y_m[cols] - shift * CELL_M
    strength = centre / threshold[rows]
    # A bar of a crosswalk has at least two others beside it, closer than a lane width.
    apart = np.abs(y[:, None] - y[None, :])
    beside = (rows[:, None] == rows[None, :]) & (apart > BAR_M[0]) & (apart < BAR_M[1])
    bar = beside.sum(axis=1) >= 2
    crosswalk = _cells_around(rows[bar], cols[bar], y[bar], smooth.shape)
    line = ~bar
    if not_road is not None:
        line &= ridges.worse_side(not_road, rows, cols) < 255 * SIDE_NOT_ROAD
    rows = rows[line]
    return PaintPoints(
        grid.x_m[rows], y[line], strength[line], np.hypot(0.05, 0.5 * grid.pixel_m[rows])
    ), crosswalk


def _cells_around(
    rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], y: F64, shape: tuple[int, ...]
) -> Bool:
    """Return the cells ``(R, C)`` within `BAR_HALF_M` of bars, on rows where they make a
    crosswalk.
    """
    mask = np.zeros(shape, dtype=np.uint8)
    if len(rows):
        count = np.bincount(rows, minlength=shape[0])
        high = np.full(shape[0], -np.inf)
        low = np.full(shape[0], np.inf)
        np.maximum.at(high, rows, y)
        np.minimum.at(low, rows, y)
        wide = (count >= 4) & (high - low > CROSSWALK_M)
        mask[rows[wide[rows]], columns[wide[rows]]] = 1
        mask = cv2.dilate(mask, np.ones((1, 2 * round(BAR_HALF_M / CELL_M) + 1), dtype=np.uint8))
    return mask > 0
