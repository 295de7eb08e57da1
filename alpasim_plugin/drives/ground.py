"""The ground along a drive, from triangulated or measured points: a strip that bends with the road,
robust to what stands on it.

Lengths are in units of the camera's height above the ground, which the points themselves give
first, so that the fit needs no metre.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from alpasim_plugin.core.geometry import arc_lengths, cross, resample, step_lengths
from alpasim_plugin.core.types import F64, Bool, HeightField
from alpasim_plugin.drives.source import Points

# In camera heights:
STEP = 0.3  # between the path's samples
AHEAD = 25.0  # how far the strip goes on before and beyond the path, straight on
# Points with a lateral offset less than they lie below it are on what was driven over, for the most
# part; the wider cone is for few points.
CONES = (1.0, 1.6)
STRIP = 1.6  # half the width of the strip that is fitted
KNOTS = 2.0  # between the knots of height
TILT_KNOTS = 8.0  # between the knots of cross slope
CROSS_KNOTS = 0.4  # between the knots of the road's cross section
BEND = 0.03  # usual second difference of the heights at knots, against the path
RISE = 0.02  # usual first difference of the heights at knots, against the path
TURN = 0.02  # usual difference of neighbouring cross slopes
CROSS = 0.02  # usual second difference of the cross section
NOISE = 0.015  # of a surface
LOOSE = 0.3  # where Tukey's weight ends in the first round
TIGHT = 0.06  # where Tukey's weight ends in the last rounds
ROUNDS = 10
WHEELS = 0.8  # half the width of what is driven over
LATERAL_WEIGHT = 0.02  # what points beside that count: kerbs come and go
FEWEST = 40  # points that a strip needs
SECTION = 3.0  # length of the sections that are assessed
# Offsets of the cross section's knots.
CROSS_AT: F64 = np.asarray(np.arange(-4, 5) * CROSS_KNOTS, dtype=np.float64)
CELL_M = 1.0  # of the height field
BESIDE_M = 60.0  # how far the height field reaches to both sides of the path
TILTED_M = 6.0  # lateral offset beyond which the height field goes on level


class PathFrame:
    """Places points beside a path: station along it, offset to its left, and its own height
    there.
    """

    def __init__(self, path: F64, unit: float) -> None:
        moved = np.concatenate([[True], step_lengths(path) > 1e-9])
        line = path[moved]
        s = arc_lengths(line[:, :2])
        ends = []
        first_chord = (s[0], min(s[-1], s[0] + 3 * unit))
        last_chord = (s[-1], max(s[0], s[-1] - 3 * unit))
        for end_s, inner_s in (first_chord, last_chord):
            end, inner = resample(line, [end_s, inner_s], s)
            direction = end - inner
            length = max(float(np.linalg.norm(direction[:2])), 1e-9)
            ends.append(end + direction * (AHEAD * unit) / length)
        line = np.concatenate([[ends[0]], line, [ends[1]]])
        s = arc_lengths(line[:, :2])
        stations = np.linspace(0.0, s[-1], max(2, int(s[-1] / (STEP * unit)) + 1))
        self.line = resample(line, stations, s)
        self.s = stations - AHEAD * unit
        along = np.gradient(self.line[:, :2], axis=0)
        self.along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        self._tree = scipy.spatial.KDTree(self.line[:, :2])

    def place(self, xy: F64) -> tuple[F64, F64, F64]:
        """Return station, offset and the path's height, each ``(N,)``, for points ``(N, 2+)``."""
        _, nearest = self._tree.query(xy[:, :2])
        away = xy[:, :2] - self.line[nearest, :2]
        forward = self.along[nearest]
        s = self.s[nearest] + np.einsum("ij,ij->i", away, forward)
        return s, cross(forward, away), np.interp(s, self.s, self.line[:, 2])


@dataclass(frozen=True, eq=False)
class GroundStrip:
    """A surface along a path.

    Attributes:
        frame: The path of the camera.
        height: Of the camera above it, the median along the path.
        knots, below: ``(K,)`` stations, and how far the surface lies below the path there
            (negative).
        tilt_knots, tilt: ``(L,)`` stations, and the slope to the left there.
        used: How many points carry it.
        section_errors: ``(S,)`` medians of what the points of each section with enough of them say
            against it.
    """

    frame: PathFrame
    height: float
    knots: F64
    below: F64
    tilt_knots: F64
    tilt: F64
    used: int
    section_errors: F64

    def z(self, xy: F64, widest: float = np.inf) -> F64:
        """Return the surface's height ``(N,)`` at points ``(N, 2+)``; beyond ``widest`` beside the
        path it goes on level.
        """
        s, left, z = self.frame.place(xy)
        return (
            z
            + np.interp(s, self.knots, self.below)
            + np.interp(s, self.tilt_knots, self.tilt) * np.clip(left, -widest, widest)
        )

    def field(self) -> HeightField:
        """Return it as a height field, metres, around the whole path."""
        low = np.floor(self.frame.line[:, :2].min(axis=0) - BESIDE_M)
        nx, ny = (
            int(n) + 2
            for n in np.ceil((self.frame.line[:, :2].max(axis=0) + BESIDE_M - low) / CELL_M)
        )
        x, y = np.meshgrid(low[0] + CELL_M * np.arange(nx), low[1] + CELL_M * np.arange(ny))
        z = self.z(np.column_stack([x.ravel(), y.ravel()]), TILTED_M)
        return HeightField(float(low[0]), float(low[1]), CELL_M, z.reshape(ny, nx))


def fit_ground(points: Points, path: F64) -> GroundStrip | None:
    """Fit the ground along a camera's path.

    Args:
        points: In a frame whose z points up, roughly.
        path: ``(N, 3)`` the camera's places, in order.

    Returns:
        The strip; None where too few points lie below the path.
    """
    height = _camera_height(points, path)
    if height is None:
        return None
    frame = PathFrame(path, height)
    s, left, z = frame.place(points.xyz)
    h = (points.xyz[:, 2] - z) / height
    s = s / height
    left = left / height
    spread = points.rise_spread / height
    near = (
        (np.abs(left) < STRIP)
        & (h > -1.6)
        & (h < -0.5)
        & (s > frame.s[0] / height)
        & (s < frame.s[-1] / height)
    )
    if near.sum() < FEWEST:
        return None
    fitted = _Strip(frame.s / height)
    weight = np.where(np.abs(left[near]) < WHEELS, 1.0, LATERAL_WEIGHT) / (
        spread[near] ** 2 + NOISE**2
    )
    coefficients, kept = fitted.solve(s[near], left[near], h[near], weight)
    # The median error of every section of the strip under the wheels that has eight good points.
    error = h[near] - fitted.value(s[near], left[near], coefficients)
    under = (np.abs(left[near]) < WHEELS) & (spread[near] < 0.03) & (np.abs(error) < LOOSE)
    section = np.floor(s[near] / SECTION).astype(np.int64)
    groups = [error[under & (section == number)] for number in np.unique(section[under])]
    errors = np.array([np.median(group) for group in groups if len(group) >= 8])
    below, tilt, _ = np.split(coefficients, np.cumsum([len(fitted.knots), len(fitted.tilt_knots)]))
    depths = np.interp(PathFrame(path, height).place(path)[0] / height, fitted.knots, below)
    return GroundStrip(
        frame,
        -float(np.median(depths)) * height,
        fitted.knots * height,
        below * height,
        fitted.tilt_knots * height,
        tilt,
        int(kept.sum()),
        errors * height,
    )


def _camera_height(points: Points, path: F64) -> float | None:
    """Return the camera's height above what was driven over: where points inside a cone below the
    path crowd.
    """
    unit = float(np.median(np.linalg.norm(np.diff(path, axis=0), axis=1))) or 1.0
    frame = PathFrame(path, 3 * unit)
    for _ in range(2):  # the path's samples should be as fine as the height that is found
        s, left, z = frame.place(points.xyz)
        below = z - points.xyz[:, 2]
        good = (
            (below > 0) & (points.rise_spread < 0.1 * below) & (s > frame.s[0]) & (s < frame.s[-1])
        )
        cones = [good & (np.abs(left) < cone * below) for cone in CONES]
        inside = next((cone for cone in cones if cone.sum() >= FEWEST), None)
        if inside is None:
            return None
        logs = np.log(below[inside])
        bins = np.arange(logs.min() - 0.1, logs.max() + 0.15, 0.04)
        crowd = np.convolve(np.histogram(logs, bins)[0], np.ones(4), mode="same")
        middle = bins[int(np.argmax(crowd))] + 0.02
        height = float(np.exp(np.median(logs[np.abs(logs - middle) < 0.15])))
        frame = PathFrame(path, height)
    return height


class _Strip:
    """Height and cross slope along the way, and one cross section: piecewise linear, with a prior
    of smoothness.
    """

    def __init__(self, stations: F64) -> None:
        span = stations[-1] - stations[0]
        self.knots = np.linspace(stations[0], stations[-1], max(3, round(span / KNOTS) + 1))
        self.tilt_knots = np.linspace(
            stations[0], stations[-1], max(2, round(span / TILT_KNOTS) + 1)
        )
        n = len(self.knots)
        m = len(self.tilt_knots)
        bend = scipy.sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(n - 2, n)) / BEND
        rise = scipy.sparse.diags([1.0, -1.0], [0, 1], shape=(n - 1, n)) / RISE
        turn = scipy.sparse.diags([1.0, -1.0], [0, 1], shape=(m - 1, m)) / TURN
        level = scipy.sparse.eye(m) / 0.1
        prior = scipy.sparse.block_diag(
            [scipy.sparse.vstack([bend, rise]), scipy.sparse.vstack([turn, level])]
        ).tocsr()
        k = len(CROSS_AT)
        arched = scipy.sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(k - 2, k)) / CROSS
        # The height of the path itself is that of the knots, and the slope is the tilt's.
        middle = scipy.sparse.csr_matrix(np.abs(CROSS_AT)[None] < CROSS_KNOTS / 2) / 1e-4
        slope = scipy.sparse.csr_matrix(CROSS_AT[None]) / 0.1
        cross = scipy.sparse.vstack([arched, middle, slope])
        prior = scipy.sparse.block_diag([prior, cross]).tocsr()
        self.prior = (prior.T @ prior).tocsc()

    def rows(self, s: F64, left: F64) -> scipy.sparse.csr_matrix:
        """Return the matrix that maps coefficients to heights at points."""
        parts = [
            _hats(s, self.knots),
            scipy.sparse.diags(left) @ _hats(s, self.tilt_knots),
            _hats(left, CROSS_AT),
        ]
        return scipy.sparse.hstack(parts).tocsr()

    def value(self, s: F64, left: F64, coefficients: F64) -> F64:
        """Return the heights at points."""
        return self.rows(s, left) @ coefficients

    def solve(self, s: F64, left: F64, h: F64, weight: F64) -> tuple[F64, Bool]:
        """Return the coefficients, and which points carry them: Tukey's weights, ever tighter."""
        A = self.rows(s, left)
        coefficients = np.concatenate(
            [np.full(len(self.knots), -1.0), np.zeros(len(self.tilt_knots) + len(CROSS_AT))]
        )
        robust = np.ones(len(h))
        for i in range(ROUNDS):
            end = max(TIGHT, LOOSE * 0.75**i)
            error = h - A @ coefficients
            slack = end + 2 / np.sqrt(weight)  # a far point is assessed by its own spread
            robust = np.where(np.abs(error) < slack, (1 - (error / slack) ** 2) ** 2, 0.0)
            W = scipy.sparse.diags(weight * robust)
            coefficients = scipy.sparse.linalg.spsolve(
                (A.T @ W @ A + self.prior).tocsc(), A.T @ (weight * robust * h)
            )
        return coefficients, robust > 0.1


def _hats(s: F64, knots: F64) -> scipy.sparse.csr_matrix:
    """Return the weights ``(N, K)`` of linear interpolation between knots, which are evenly
    spaced.
    """
    u = np.clip((s - knots[0]) / (knots[1] - knots[0]), 0, len(knots) - 1 - 1e-9)
    low = u.astype(np.int64)
    rows = np.arange(len(s))
    values = np.concatenate([1 - (u - low), u - low])
    return scipy.sparse.csr_matrix(
        (values, (np.concatenate([rows, rows]), np.concatenate([low, low + 1]))),
        shape=(len(s), len(knots)),
    )
