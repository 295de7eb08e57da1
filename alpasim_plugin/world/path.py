"""A drivable line with arc length, heading and curvature, and fast projection onto it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths
from alpasim_plugin.core.types import F64, I64

FEW_DISTANCES = 200_000  # above it, a tree over the stations is quicker than all distances, and takes no memory


@dataclass(frozen=True)
class Path:
    """A line in the world, densely sampled."""

    s: F64  # (N,) metres, strictly increasing from 0
    xyz: F64  # (N, 3) metres, world
    yaw: F64  # (N,) radians, not wrapped
    curvature: F64  # (N,) per metre, left positive

    @property
    def length_m(self) -> float:
        """Length in the xy plane."""
        return float(self.s[-1])

    def at(self, s_m: npt.ArrayLike, offset_m: npt.ArrayLike = 0.0) -> tuple[F64, F64]:
        """Return points ``(..., 3)`` and headings ``(...)`` at arc lengths, moved left by ``offset_m``; clamped to the ends."""
        s = np.asarray(s_m, dtype=np.float64)
        yaw = np.interp(s, self.s, self.yaw)
        d = np.asarray(offset_m, dtype=np.float64)
        x = np.interp(s, self.s, self.xyz[:, 0]) - d * np.sin(yaw)
        y = np.interp(s, self.s, self.xyz[:, 1]) + d * np.cos(yaw)
        return np.stack([x, y, np.interp(s, self.s, self.xyz[:, 2])], axis=-1), yaw

    def coarser(self, every: int) -> Path:
        """Return the path with every n-th station (and the last), for quicker projection."""
        keep = np.unique(np.append(np.arange(0, len(self.s), every), len(self.s) - 1))
        return Path(self.s[keep], self.xyz[keep], self.yaw[keep], self.curvature[keep])

    def project(self, xy: F64, window_m: tuple[float, float] | None = None) -> tuple[F64, F64]:
        """Return arc length and signed distance (left positive) of points ``(M, 2)``.

        ``window_m`` limits the search to a range of arc lengths. Points beyond an end are projected onto the tangent there, so their
        arc length is negative or larger than the length.
        """
        lo, hi = 0, len(self.s)
        if window_m is not None:
            lo = max(0, int(np.searchsorted(self.s, window_m[0])) - 1)
            hi = min(len(self.s), int(np.searchsorted(self.s, window_m[1])) + 1)
            lo, hi = min(lo, len(self.s) - 2), max(hi, lo + 2)
        i = lo + nearest(np.asarray(xy, dtype=np.float64)[:, :2], self.xyz[lo:hi, :2])
        rest = xy[:, :2] - self.xyz[i, :2]
        c, s = np.cos(self.yaw[i]), np.sin(self.yaw[i])
        along, across = c * rest[:, 0] + s * rest[:, 1], c * rest[:, 1] - s * rest[:, 0]
        # On the circle of curvature k through the nearest station; a straight tangent beyond the ends.
        beyond = ((i == 0) & (along < 0)) | ((i == len(self.s) - 1) & (along > 0))
        k = np.where(beyond | (np.abs(self.curvature[i]) < 1e-9), 1e-9, self.curvature[i])
        radial = 1.0 - k * across
        distance = (k * across * (2.0 - k * across) - (k * along) ** 2) / (k * (1.0 + np.hypot(k * along, radial)))
        return self.s[i] + np.arctan2(k * along, radial) / k, np.where(beyond, across, distance)


def nearest(xy: F64, stations: F64) -> I64:
    """Return for each of ``(M, 2)`` points the first of the nearest of ``(N, 2)`` stations.

    All distances are compared where they are few; a tree finds them where they are many, and its answer is compared with the neighbours,
    since of two equally near stations it may name either.
    """
    n = len(stations)
    if len(xy) * n <= FEW_DISTANCES:
        delta = xy[:, None] - stations
        return np.asarray(np.argmin(np.einsum("mnk,mnk->mn", delta, delta), axis=1))
    found = scipy.spatial.KDTree(stations).query(xy)[1]
    around = np.clip(found[:, None] + np.array([-1, 0, 1]), 0, n - 1)
    delta = xy[:, None] - stations[around]
    best = np.argmin(np.einsum("mnk,mnk->mn", delta, delta), axis=1)
    return np.asarray(np.take_along_axis(around, best[:, None], axis=1)[:, 0])


def polyline_path(xyz: F64, doing: str = "building a path") -> Path:
    """Build a path from a polyline ``(N, 2 or 3)``; repeated points are dropped.

    Raises:
        InputError: Fewer than two distinct points.
    """
    line = np.asarray(xyz, dtype=np.float64)
    if line.shape[1] == 2:
        line = np.column_stack([line, np.zeros(len(line))])
    line = line[np.concatenate([[True], np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1) > 1e-4])]
    if len(line) < 2:
        raise InputError(doing, f"a line of {len(xyz)} points", "fewer than two distinct points", "give a longer line")
    s = arc_lengths(line)
    d = np.gradient(line[:, :2], s, axis=0)
    yaw = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
    return Path(s, line, yaw, np.gradient(yaw, s))


def smooth_path(xyz: F64, step_m: float = 0.25) -> Path:
    """Build a path through the points by a cubic spline over arc length, resampled every ``step_m``."""
    coarse = polyline_path(xyz)
    spline = scipy.interpolate.CubicSpline(coarse.s, coarse.xyz, axis=0)
    fine = np.linspace(0.0, coarse.length_m, max(2, int(np.ceil(coarse.length_m / step_m)) + 1))
    d, dd = spline(fine, 1), spline(fine, 2)
    speed2 = d[:, 0] ** 2 + d[:, 1] ** 2
    line = spline(fine)
    return Path(arc_lengths(line), line, np.unwrap(np.arctan2(d[:, 1], d[:, 0])), (d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / speed2**1.5)
