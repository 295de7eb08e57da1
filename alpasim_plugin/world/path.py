"""Curves of roads (clothoids, Hermite turns), and drivable lines with arc length, heading,
curvature and fast projection onto them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy  # its submodules load on first use

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths, cross, direction_of, heading_of, step_lengths
from alpasim_plugin.core.spline import CubicSpline
from alpasim_plugin.core.types import F64, I64, Bool

ABOUT_M = 5.0  # a place whose arc length is nearly known is looked for so far to both sides
CONNECTOR_STEP_M = 0.5  # between stations of a lane through a junction
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


def smoothstep(x: npt.ArrayLike) -> F64:
    """Return the quintic blend 0..1 whose first and second derivatives vanish at both ends; clamped
    outside [0, 1].
    """
    t = np.clip(x, 0.0, 1.0)
    return t * t * t * (10.0 + t * (6.0 * t - 15.0))


def sample_clothoid(
    start: tuple[float, float, float],
    length_m: float,
    start_curvature_per_m: float,
    end_curvature_per_m: float,
    step_m: float = 1.0,
) -> F64:
    """Sample a curve whose curvature is linear in arc length (straight and arc are its special
    cases).

    The heading is exact; positions integrate ``(cos, sin)`` of it with 8-point Gauss-Legendre
    quadrature between stations, which at steps of 1 m is exact to rounding for any drivable
    curvature (compared with Fresnel integrals in the tests).

    Args:
        start: x, y in metres and heading in radians.
        length_m: Arc length, > 0.
        start_curvature_per_m: Curvature at the start, left positive.
        end_curvature_per_m: Curvature at the end.
        step_m: Largest distance between stations.

    Returns:
        ``(N, 4)``: x, y, heading (not wrapped), curvature; the first row is ``start``.
    """
    n = max(1, int(np.ceil(length_m / step_m - 1e-9)))
    s = np.linspace(0.0, length_m, n + 1)
    rate = (end_curvature_per_m - start_curvature_per_m) / length_m
    x0, y0, yaw0 = start

    def heading(s_m: F64) -> F64:
        return yaw0 + s_m * (start_curvature_per_m + 0.5 * rate * s_m)

    half = 0.5 * np.diff(s)[:, None]
    yaw_at_nodes = heading(0.5 * (s[1:] + s[:-1])[:, None] + half * _NODES)  # (N - 1, 8)
    dx = np.sum(half * _WEIGHTS * np.cos(yaw_at_nodes), axis=1)
    dy = np.sum(half * _WEIGHTS * np.sin(yaw_at_nodes), axis=1)
    x = np.concatenate([[0.0], np.cumsum(dx)]) + x0
    y = np.concatenate([[0.0], np.cumsum(dy)]) + y0
    return np.column_stack([x, y, heading(s), start_curvature_per_m + rate * s])


def connect(p0: F64, yaw0: float, p1: F64, yaw1: float) -> F64:
    """Join two poses by a quintic Hermite curve with zero curvature at both ends, and straights
    where a turn is longer on one side.

    The common tangent length is the one, out of a fixed set, with the smallest peak curvature:
    turning lanes come out as wide as the junction allows.

    Returns:
        ``(N, 3)``: x, y, heading; first and last points are ``p0`` and ``p1`` exactly.
    """
    before, after = _leads(p0, yaw0, p1, yaw1)
    q0 = p0[:2] + before * direction_of(yaw0)
    q1 = p1[:2] - after * direction_of(yaw1)
    chord = float(np.hypot(q1[0] - q0[0], q1[1] - q0[1]))
    n = max(8, int(np.ceil(1.2 * chord / CONNECTOR_STEP_M)))
    t = np.linspace(0.0, 1.0, n + 1)
    still = np.zeros(2)
    directions = direction_of([yaw0, yaw1])
    least_peak = np.inf
    for tangent_m in chord * np.linspace(0.8, 2.4, 33):
        ends = zip((q0[:2], q1[:2]), directions, strict=True)
        derivatives = [[point, tangent_m * direction, still] for point, direction in ends]
        curve = scipy.interpolate.BPoly.from_derivatives([0.0, 1.0], derivatives)
        d = curve(t, 1)
        dd = curve(t, 2)
        speed = np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-9)
        peak = float(np.max(np.abs(cross(d, dd)) / speed**3))
        if peak < least_peak - 1e-9:
            best, d_best, least_peak = curve, d, peak
    yaw = np.unwrap(heading_of(d_best))
    yaw[0], yaw[-1] = yaw0, yaw0 + (yaw1 - yaw0 + np.pi) % (2 * np.pi) - np.pi
    turn = np.column_stack([best(t), yaw])
    head = _straight(p0, q0, yaw0)[:-1]
    tail = _straight(q1, p1, float(turn[-1, 2]))[1:]
    curve = np.concatenate([head, turn, tail])
    curve[0, :2], curve[-1, :2] = p0[:2], p1[:2]
    return curve


def _leads(p0: F64, yaw0: float, p1: F64, yaw1: float) -> tuple[float, float]:
    """Return the straights before and after a turn that make what is left of it as long on one side
    as on the other.
    """
    d0, d1 = direction_of([yaw0, yaw1])
    cross = float(d0[0] * d1[1] - d0[1] * d1[0])
    if abs(cross) < 0.1:
        return 0.0, 0.0
    span = p1[:2] - p0[:2]
    a = float(span[0] * d1[1] - span[1] * d1[0]) / cross  # from p0 to where the two lines meet
    b = float(d0[0] * span[1] - d0[1] * span[0]) / cross  # and on to p1
    if a <= 0 or b <= 0:
        return 0.0, 0.0
    shorter = min(a, b)
    return a - shorter, b - shorter


def _straight(p: F64, q: F64, yaw: float) -> F64:
    """Return ``(N, 3)`` rows from p to q; the single row p where they are the same."""
    n = int(np.ceil(float(np.hypot(*(q[:2] - p[:2]))) / CONNECTOR_STEP_M - 1e-6))
    share = np.linspace(0.0, 1.0, n + 1)[:, None]
    return np.column_stack([p[:2] + share * (q[:2] - p[:2]), np.full(n + 1, yaw)])


def offset_line(curve: F64, offset_m: npt.ArrayLike) -> F64:
    """Return ``(N, 3)`` points, at height 0, beside a curve ``(N, 3+)`` of x, y, heading, at signed distances
    (left positive) along its normals.
    """
    d = np.broadcast_to(offset_m, (len(curve),))
    x = curve[:, 0] - d * np.sin(curve[:, 2])
    y = curve[:, 1] + d * np.cos(curve[:, 2])
    return np.column_stack([x, y, np.zeros(len(curve))])


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

    def at(self, s_m: float | F64, offset_m: float | F64 = 0.0) -> tuple[F64, F64]:
        """Return points ``(..., 3)`` and headings ``(...)`` at arc lengths, moved left by
        ``offset_m``; clamped to the ends.
        """
        yaw = np.asarray(np.interp(s_m, self.s, self.yaw))
        x = np.interp(s_m, self.s, self.xyz[:, 0]) - offset_m * np.sin(yaw)
        y = np.interp(s_m, self.s, self.xyz[:, 1]) + offset_m * np.cos(yaw)
        return np.stack([x, y, np.interp(s_m, self.s, self.xyz[:, 2])], axis=-1), yaw

    def project(self, xy: F64) -> tuple[F64, F64]:
        """Return arc length and signed distance (left positive) of points ``(M, 2)``.

        Points beyond an end are projected onto the tangent there, so their arc length is negative
        or larger than the length.
        """
        i = scipy.spatial.KDTree(self.xyz[:, :2]).query(xy)[1]
        along, across = _from_station(
            xy - self.xyz[i, :2],
            self.yaw[i],
            self.curvature[i],
            i == 0,
            i == len(self.s) - 1,
        )
        return self.s[i] + along, across

    def project_about(self, xy: F64, about_m: float) -> tuple[float, float]:
        """Return `project` of one point ``(2,)`` onto the part of the path within `ABOUT_M` of an arc
        length: a path may pass the same place several times.
        """
        low, high = np.searchsorted(self.s, [about_m - ABOUT_M, about_m + ABOUT_M])
        low = min(max(int(low) - 1, 0), len(self.s) - 2)
        near = slice(low, max(int(high) + 1, low + 2))
        part = Path(self.s[near], self.xyz[near], self.yaw[near], self.curvature[near])
        s_m, offset_m = part.project(xy[None])
        return float(s_m[0]), float(offset_m[0])


def _from_station(
    offset: F64, yaw: F64, curvature: F64, is_first: Bool, is_last: Bool
) -> tuple[F64, F64]:
    """Return arc length and signed distance, both from the nearest station, of points at ``offset``
    from it: on the circle of its curvature, and on its straight tangent beyond the path's ends.
    """
    c = np.cos(yaw)
    s = np.sin(yaw)
    along = c * offset[:, 0] + s * offset[:, 1]
    across = c * offset[:, 1] - s * offset[:, 0]
    beyond = (is_first & (along < 0)) | (is_last & (along > 0))
    k = np.where(beyond | (np.abs(curvature) < 1e-9), 1e-9, curvature)
    radial = 1.0 - k * across
    distance = (k * across * (2.0 - k * across) - (k * along) ** 2) / (
        k * (1.0 + np.hypot(k * along, radial))
    )
    return np.arctan2(k * along, radial) / k, np.where(beyond, across, distance)


COARSE = 4  # every so many stations are looked at first ...
DENSE_M = 2.5  # ... of lines whose stations are no farther apart


class Lines:
    """Many paths in one array, for the projection of many points onto them at once.

    A row of an argument ``line (P,)`` is the number of a path.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        counts = np.array([len(path.s) for path in paths], dtype=np.int64)
        self.end = np.cumsum(counts)
        self.begin = self.end - counts
        self.length_m = np.array([path.length_m for path in paths])
        self._base = np.concatenate([[0.0], np.cumsum(self.length_m + 1.0)[:-1]])
        self.s = np.concatenate([path.s for path in paths])
        self.xyz = np.concatenate([path.xyz for path in paths])
        self.yaw = np.concatenate([path.yaw for path in paths])
        self.curvature = np.concatenate([path.curvature for path in paths])
        self._x, self._y = np.ascontiguousarray(self.xyz[:, :2].T)
        self._key = self.s + np.repeat(self._base, counts)  # increases over all paths
        gap_m = max(float(np.diff(path.s).max()) for path in paths)
        self._coarse = COARSE if gap_m <= DENSE_M else 1

    def at(self, line: I64, s_m: F64, offset_m: float | F64 = 0.0) -> tuple[F64, F64]:
        """Return points ``(P, 3)`` and headings ``(P,)``; see `Path.at`."""
        s = np.minimum(np.maximum(s_m, 0.0), self.length_m[line])
        i = np.searchsorted(self._key, s + self._base[line], side="right") - 1
        i = np.minimum(np.maximum(i, self.begin[line]), self.end[line] - 2)
        f = (s - self.s[i]) / (self.s[i + 1] - self.s[i])
        yaw = self.yaw[i] + f * (self.yaw[i + 1] - self.yaw[i])
        xyz = self.xyz[i] + f[:, None] * (self.xyz[i + 1] - self.xyz[i])
        xyz[:, 0] -= offset_m * np.sin(yaw)
        xyz[:, 1] += offset_m * np.cos(yaw)
        return xyz, yaw

    def stations(self, line: I64, low_m: F64, high_m: F64) -> tuple[I64, I64]:
        """Return the first station and the one after the last of ranges of arc length; at least
        two.
        """
        low = np.searchsorted(self._key, np.maximum(low_m, -0.5) + self._base[line]) - 1
        top = np.minimum(high_m, self.length_m[line] + 0.25)
        high = np.searchsorted(self._key, top + self._base[line]) + 1
        low = np.minimum(np.maximum(low, self.begin[line]), self.end[line] - 2)
        return low, np.maximum(np.minimum(high, self.end[line]), low + 2)

    def project(self, line: I64, xy: F64, low: I64, high: I64) -> tuple[F64, F64]:
        """Return arc lengths and signed distances of points ``(P, 2)``, each onto its line between
        two stations; see `Path.project`.
        """
        coarse = low + self._coarse * self._squares(xy, low, high, self._coarse).argmin(axis=1)
        low = np.maximum(low, coarse - self._coarse)
        high = np.minimum(high, coarse + self._coarse + 1)
        i = low + self._squares(xy, low, high, 1).argmin(axis=1)
        along, across = _from_station(
            xy - self.xyz[i, :2],
            self.yaw[i],
            self.curvature[i],
            i == self.begin[line],
            i == self.end[line] - 1,
        )
        return self.s[i] + along, across

    def _squares(self, xy: F64, low: I64, high: I64, stride: int) -> F64:
        """Return the squared distances ``(P, n)`` of points to every n-th station of a range; the
        last station stands for those beyond it.
        """
        count = max(-(-int((high - low).max(initial=0)) // stride), 1)
        stations = np.minimum(low[:, None] + stride * np.arange(count), high[:, None] - 1)
        dx = xy[:, :1] - self._x[stations]
        dy = xy[:, 1:] - self._y[stations]
        return dx * dx + dy * dy


def thinned(line: F64, step_m: float) -> I64:
    """Return the indices of the points of a polyline ``(N, 2+)`` that are farther than a step from
    the last one that is kept, the first always.
    """
    kept = [0]
    for i in range(1, len(line)):
        if np.hypot(*(line[i, :2] - line[kept[-1], :2])) > step_m:
            kept.append(i)
    return np.array(kept, dtype=np.int64)


def polyline_path(xyz: F64) -> Path:
    """Build a path from a polyline ``(N, 2 or 3)``; repeated points are dropped.

    Raises:
        InputError: Fewer than two distinct points.
    """
    line = np.asarray(xyz, dtype=np.float64)
    if line.shape[1] == 2:
        line = np.column_stack([line, np.zeros(len(line))])
    line = line[np.concatenate([[True], step_lengths(line) > 1e-4])]
    if len(line) < 2:
        raise InputError(
            f"a line of {len(xyz)} points: fewer than two distinct points",
            "give a longer line",
        )
    s = arc_lengths(line)
    d = np.gradient(line[:, :2], s, axis=0)
    yaw = np.unwrap(heading_of(d))
    return Path(s, line, yaw, np.gradient(yaw, s))


def smooth_path(xyz: F64, step_m: float = 0.25) -> Path:
    """Build a path through the points by a cubic spline over arc length, resampled every
    ``step_m``.
    """
    coarse = polyline_path(xyz)
    spline = CubicSpline.through(coarse.s, coarse.xyz)
    fine = np.linspace(0.0, coarse.length_m, max(2, int(np.ceil(coarse.length_m / step_m)) + 1))
    d = spline.at(fine, derivative=1)
    dd = spline.at(fine, derivative=2)
    speed2 = d[:, 0] ** 2 + d[:, 1] ** 2
    line = spline.at(fine)
    return Path(
        arc_lengths(line),
        line,
        np.unwrap(heading_of(d)),
        cross(d, dd) / speed2**1.5,
    )
