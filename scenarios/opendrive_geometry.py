"""Reference lines of OpenDRIVE roads: line, arc, spiral, poly3 and paramPoly3 records at any arc length.

Source: ASAM OpenDRIVE 1.4 to 1.8, chapter on geometry: x east, y north, heading from x towards y, ``s`` along the line, ``t`` to the left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from alpasim_plugin.core.types import F64

Kind = Literal["line", "arc", "spiral", "poly3", "paramPoly3"]
KINDS: tuple[Kind, ...] = ("line", "arc", "spiral", "poly3", "paramPoly3")

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_TABLE = 257  # stations at which a cubic's arc length is tabulated before it is inverted


@dataclass(frozen=True)
class Cubic:
    """``a + b ds + c ds^2 + d ds^3`` from ``s_m`` on, where ``ds = s - s_m``."""

    s_m: float
    a: float
    b: float = 0.0
    c: float = 0.0
    d: float = 0.0


@dataclass(frozen=True)
class Geometry:
    """One record of a plan view."""

    s_m: float
    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    kind: Kind
    # line: none; arc: curvature; spiral: start and end curvature; poly3: a b c d; paramPoly3: aU bU cU dU aV bV cV dV.
    numbers: tuple[float, ...] = ()
    normalised: bool = True  # paramPoly3: the parameter runs 0..1, else 0..length

    def at(self, s_m: F64) -> F64:
        """Return ``(N, 3)`` x, y and heading at arc lengths ``(N,)`` from the record's own start."""
        if self.kind in ("line", "arc", "spiral"):
            return self._clothoid(s_m)
        u, v, heading = self._poly3(s_m) if self.kind == "poly3" else self._param_poly3(s_m)
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        return np.column_stack([self.x_m + u * c - v * s, self.y_m + u * s + v * c, self.heading_rad + heading])

    def _clothoid(self, s_m: F64) -> F64:
        """Integrate the heading, which is quadratic in s; 32-point Gauss-Legendre is exact to rounding for any road's turn."""
        start = self.numbers[0] if self.numbers else 0.0
        rate = (self.numbers[1] - start) / self.length_m if self.kind == "spiral" else 0.0
        at = 0.5 * s_m[:, None] * (1.0 + _NODES)  # (N, 32)
        heading = self.heading_rad + at * (start + 0.5 * rate * at)
        x = self.x_m + 0.5 * s_m * (np.cos(heading) @ _WEIGHTS)
        y = self.y_m + 0.5 * s_m * (np.sin(heading) @ _WEIGHTS)
        return np.column_stack([x, y, self.heading_rad + s_m * (start + 0.5 * rate * s_m)])

    def _poly3(self, s_m: F64) -> tuple[F64, F64, F64]:
        """Return u, v and heading of ``v = a + b u + c u^2 + d u^3``; u follows from the arc length."""
        a, b, c, d = self.numbers
        reach = max(self.length_m, 1e-9)
        table_u = np.linspace(0.0, reach, _TABLE)  # an arc is never shorter than its u

        def slope(u: F64) -> F64:
            return np.asarray(b + u * (2 * c + 3 * d * u))

        half = 0.5 * np.diff(table_u)[:, None]
        nodes = 0.5 * (table_u[1:] + table_u[:-1])[:, None] + half * _NODES
        lengths = np.concatenate([[0.0], np.cumsum(np.sum(half * _WEIGHTS * np.hypot(1.0, slope(nodes)), axis=1))])
        u = np.interp(s_m, lengths, table_u)
        for _ in range(3):  # Newton on the arc length from the table's station below
            below = np.clip(np.searchsorted(table_u, u, side="right") - 1, 0, _TABLE - 1)
            gap = 0.5 * (u - table_u[below])
            part = gap * (np.hypot(1.0, slope(table_u[below][:, None] + gap[:, None] * (1.0 + _NODES))) @ _WEIGHTS)
            u = u - (lengths[below] + part - s_m) / np.hypot(1.0, slope(u))
        return u, a + u * (b + u * (c + d * u)), np.arctan(slope(u))

    def _param_poly3(self, s_m: F64) -> tuple[F64, F64, F64]:
        p = s_m / self.length_m if self.normalised and self.length_m > 0 else s_m
        (au, bu, cu, du), (av, bv, cv, dv) = self.numbers[:4], self.numbers[4:]
        u, v = au + p * (bu + p * (cu + du * p)), av + p * (bv + p * (cv + dv * p))
        return u, v, np.arctan2(bv + p * (2 * cv + 3 * dv * p), bu + p * (2 * cu + 3 * du * p))


def reference_line(records: Sequence[Geometry], s_m: F64) -> F64:
    """Return ``(N, 3)`` x, y and heading (not wrapped) of a road's reference line at arc lengths ``(N,)``."""
    starts = np.array([one.s_m for one in records])
    owner = np.clip(np.searchsorted(starts, s_m, side="right") - 1, 0, len(records) - 1)
    out = np.empty((len(s_m), 3))
    for i in np.unique(owner):
        rows = owner == i
        out[rows] = records[i].at(s_m[rows] - records[i].s_m)
    return out


def cubics_at(records: Sequence[Cubic], s_m: F64) -> F64:
    """Return ``(N,)`` the value of the record in force at each arc length; before the first record that one is extended, none gives 0."""
    if not records:
        return np.zeros(len(s_m))
    table = np.array([[one.s_m, one.a, one.b, one.c, one.d] for one in records])
    s0, a, b, c, d = table[np.clip(np.searchsorted(table[:, 0], s_m, side="right") - 1, 0, len(records) - 1)].T
    ds = s_m - s0
    return np.asarray(a + ds * (b + ds * (c + d * ds)))


def beside(line: F64, t_m: F64) -> F64:
    """Return points ``(N, 2)`` at signed distances ``t_m (N,)``, left positive, across a line ``(N, 3)`` of x, y, heading."""
    return np.column_stack([line[:, 0] - t_m * np.sin(line[:, 2]), line[:, 1] + t_m * np.cos(line[:, 2])])
