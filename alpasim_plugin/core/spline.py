"""Cubic splines through points, without a knot at the second and the last but one.

It is `scipy.interpolate.CubicSpline`, whose import takes a third of a second of every run.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64

DEGREE = 3


@dataclass(frozen=True, eq=False)
class CubicSpline:
    """A curve whose second derivative is continuous, made of a cubic polynomial for each interval.

    Attributes:
        s: ``(N,)`` where the points lie, ascending; metres for a line.
        coefficients: ``(4, N - 1, K)`` of ``1, s - s_i, (s - s_i)^2, (s - s_i)^3`` in interval i.
    """

    s: F64
    coefficients: F64

    @classmethod
    def through(cls, s: F64, points: F64) -> "CubicSpline":
        """Return the spline through points ``(N, K)`` at ``(N,)``: a straight line through two, a
        parabola through three, and the "not-a-knot" spline through more (C. de Boor, A Practical
        Guide to Splines, 1978, chapter IV).

        Raises:
            ValueError: There are fewer than two points, or ``s`` does not ascend.
        """
        step = np.diff(s)
        if len(s) < 2 or not np.all(step > 0.0):
            raise ValueError(f"{len(s)} places of points, wanted two at least, ascending")
        chord = np.diff(points, axis=0) / step[:, None]  # (N - 1, K), slopes of the chords
        slope = _slopes(s, chord)
        bend = (slope[:-1] + slope[1:] - 2 * chord) / step[:, None]
        quadratic = (chord - slope[:-1]) / step[:, None] - bend
        cubic = bend / step[:, None]
        return cls(s, np.stack([points[:-1], slope[:-1], quadratic, cubic]))

    def at(self, s: npt.ArrayLike, derivative: int = 0) -> F64:
        """Return points ``(M, K)`` of the curve at ``(M,)``, or their first or second derivative;
        beyond an end the polynomial of the last interval counts.
        """
        places = np.asarray(s, dtype=np.float64)
        interval = np.searchsorted(self.s[1:-1], places, side="right")
        offset = (places - self.s[interval])[:, None]
        value = np.zeros((len(places), self.coefficients.shape[2]))
        power = np.ones_like(offset)
        for exponent in range(derivative, DEGREE + 1):
            factor = np.prod(np.arange(exponent - derivative + 1, exponent + 1, dtype=np.float64))
            value = value + self.coefficients[exponent, interval] * power * factor
            power = power * offset
        return value


def _slopes(s: F64, chord: F64) -> F64:
    """Return the derivatives ``(N, K)`` at the points, by which the second derivative is continuous.

    Args:
        s: ``(N,)`` where the points lie.
        chord: ``(N - 1, K)`` slopes of the lines between them.
    """
    n = len(s)
    if n == 2:
        return np.concatenate([chord, chord])
    step = np.diff(s)
    h = step[:, None]
    inner = 3 * (h[1:] * chord[:-1] + h[:-1] * chord[1:])
    if n == 3:  # both ends say the same: a parabola
        matrix = [[1.0, 1.0, 0.0], [step[1], 2 * (step[0] + step[1]), step[0]], [0.0, 1.0, 1.0]]
        return np.linalg.solve(matrix, np.concatenate([2 * chord[:1], inner, 2 * chord[1:]]))
    first = s[2] - s[0]
    last = s[-1] - s[-3]
    right = np.empty((n, chord.shape[1]))
    right[0] = ((h[0] + 2 * first) * h[1] * chord[0] + h[0] ** 2 * chord[1]) / first
    right[1:-1] = inner
    right[-1] = (h[-1] ** 2 * chord[-2] + (2 * last + h[-1]) * h[-2] * chord[-1]) / last
    below = np.append(step[1:], last)
    diagonal = np.concatenate([step[1:2], 2 * (step[:-1] + step[1:]), step[-2:-1]])
    above = np.append(first, step[:-1])
    return solve_tridiagonal(below, diagonal, above, right)


def solve_tridiagonal(below: F64, diagonal: F64, above: F64, right: F64) -> F64:
    """Return x ``(N, K)`` of a tridiagonal system, by elimination with a choice between two
    neighbouring rows, in the order of operations of LAPACK's ``dgtsv``.

    Args:
        below, above: ``(N - 1,)`` beside the diagonal.
        diagonal: ``(N,)``.
        right: ``(N, K)``.
    """
    n = len(diagonal)
    low: list[float] = below.tolist()
    d: list[float] = diagonal.tolist()
    up: list[float] = above.tolist()
    up2 = [0.0] * n  # a second diagonal above, which exchanged rows fill
    x: list[list[float]] = right.tolist()
    for i in range(n - 1):
        if abs(d[i]) >= abs(low[i]):
            factor = low[i] / d[i]
            d[i + 1] -= factor * up[i]
            x[i + 1] = [b - factor * a for a, b in zip(x[i], x[i + 1], strict=True)]
            continue
        factor = d[i] / low[i]
        d[i], up[i], d[i + 1] = low[i], d[i + 1], up[i] - factor * d[i + 1]
        if i < n - 2:
            up2[i] = up[i + 1]
            up[i + 1] = -factor * up2[i]
        x[i], x[i + 1] = x[i + 1], [a - factor * b for a, b in zip(x[i], x[i + 1], strict=True)]
    x[-1] = [value / d[-1] for value in x[-1]]
    x[-2] = [(a - up[-1] * b) / d[-2] for a, b in zip(x[-2], x[-1], strict=True)]
    for i in range(n - 3, -1, -1):
        rows = zip(x[i], x[i + 1], x[i + 2], strict=True)
        x[i] = [(a - up[i] * b - up2[i] * c) / d[i] for a, b, c in rows]
    return np.array(x)
