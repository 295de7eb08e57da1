"""Reference implementations of preset ``strict``: contact between steps in 40-digit decimals, and
the off-road margin point by point.

Contact: the largest gap over the directions of both rectangles' sides is sampled densely in time,
    every dip between samples is searched
for its bottom, and the first crossing is halved down. Margin: distances to every lane for points of
the footprint, no union, no index.
"""

import math
from dataclasses import dataclass
from decimal import Context, Decimal, localcontext
from itertools import pairwise

import numpy as np

from tests.evaluators.reference_rules import point_to_segment

_C = Context(prec=40)
_TWO_PI = Decimal("6.283185307179586476925286766559005768394338798750")

# --- contact


@dataclass(frozen=True)
class Motion:
    """One rectangle over a stretch of time: centre straight, heading steady."""

    xy: tuple[float, float]
    shift: tuple[float, float]
    yaw: float
    turn: float
    size: tuple[float, float]  # length, width

    def corners(self, tau):
        """Return the corners at a share of the stretch."""
        x, y = (
            _C.add(Decimal(a), _C.multiply(Decimal(b), tau))
            for a, b in zip(self.xy, self.shift, strict=True)
        )
        sin, cos = _sin_cos(_C.add(Decimal(self.yaw), _C.multiply(Decimal(self.turn), tau)))
        length, width = (Decimal(d) / 2 for d in self.size)
        local = [(length, width), (length, -width), (-length, -width), (-length, width)]
        return [(x + cos * u - sin * v, y + sin * u + cos * v) for u, v in local]


def separation(a, b, tau):
    """Return the largest gap between two rectangles along the directions of their sides: apart if
    positive.
    """
    with localcontext(_C):
        return _separation(a, b, tau)


def _separation(a, b, tau):
    shapes = (a.corners(tau), b.corners(tau))
    best = Decimal("-Infinity")
    for (p, q), (_, r) in ((shape[:2], shape[1:3]) for shape in shapes):
        for end, start in ((p, q), (q, r)):
            dx = end[0] - start[0]
            dy = end[1] - start[1]
            length = (dx * dx + dy * dy).sqrt(_C)
            spans = [[(dx * x + dy * y) / length for x, y in shape] for shape in shapes]
            best = max(best, min(spans[0]) - max(spans[1]), min(spans[1]) - max(spans[0]))
    return best


def first_touch(a, b, samples=48):
    """Return when two rectangles first touch, as a share of the stretch; None if they stay
    apart.
    """
    with localcontext(_C):
        return _first_touch(a, b, samples)


def _first_touch(a, b, samples):
    def gap(tau):
        return _separation(a, b, tau)

    steepest = Decimal(
        math.dist(a.shift, b.shift)
        + (abs(a.turn) + abs(b.turn)) * (_reach(a, b) + math.hypot(*a.size, *b.size))
    )
    times = [Decimal(k) / samples for k in range(samples + 1)]
    gaps = [gap(t) for t in times]
    if gaps[0] <= 0:
        return 0.0
    for k in range(1, samples + 1):
        if gaps[k] > 0:
            low = times[k - 1]
            high = times[min(k + 1, samples)]
            if (
                gaps[k] >= gaps[k - 1]
                or (k < samples and gaps[k] > gaps[k + 1])
                or gaps[k] * samples > steepest
            ):
                continue
            bottom = _bottom(gap, low, high)
            if gap(bottom) > 0:
                continue
            return float(_crossing(gap, low, bottom))
        return float(_crossing(gap, times[k - 1], times[k]))
    return None


def _reach(a, b):
    """Return the greatest distance of the centres."""
    start = (b.xy[0] - a.xy[0], b.xy[1] - a.xy[1])
    return math.hypot(*start) + math.dist(a.shift, b.shift)


def _bottom(gap, low, high):
    """Return where a function with one dip is least; as soon as it is not positive, that point will
    do.
    """
    for _ in range(60):
        third = (high - low) / 3
        a = low + third
        b = high - third
        at_a = gap(a)
        at_b = gap(b)
        if at_a <= 0:
            return a
        if at_b <= 0:
            return b
        low, high = (low, b) if at_a < at_b else (a, high)
    return (low + high) / 2


def _crossing(gap, apart, touching):
    for _ in range(60):
        middle = (apart + touching) / 2
        apart, touching = (middle, touching) if gap(middle) > 0 else (apart, middle)
    return touching


def _sin_cos(angle):
    """Return sine and cosine by their power series."""
    x = _C.remainder(angle, _TWO_PI)
    sums = [Decimal(0), Decimal(0)]
    term = Decimal(1)
    n = 0
    while n < 8 or abs(term) > Decimal("1e-45"):
        sums[n % 2] += term if n % 4 < 2 else -term
        n += 1
        term = _C.divide(_C.multiply(term, x), Decimal(n))
    return sums[1], sums[0]


def side_at(a, b, tau, tie_m):
    """Return which side of the first rectangle the contact's normal leaves through: the direction
    along which they overlap least.
    """
    with localcontext(_C):
        box = a.corners(Decimal(tau))
        other = b.corners(Decimal(tau))
        ahead = (box[0][0] - box[3][0], box[0][1] - box[3][1])
        found = []
        for shape in (box, other):
            for end, start in ((0, 3), (3, 0), (0, 1), (1, 0)):
                n = (shape[end][0] - shape[start][0], shape[end][1] - shape[start][1])
                length = (n[0] ** 2 + n[1] ** 2).sqrt()
                gap = (
                    min(n[0] * x + n[1] * y for x, y in other)
                    - max(n[0] * x + n[1] * y for x, y in box)
                ) / length
                cos = (
                    (n[0] * ahead[0] + n[1] * ahead[1])
                    / length
                    / (ahead[0] ** 2 + ahead[1] ** 2).sqrt()
                )
                found.append((gap, "lateral" if 2 * cos**2 < 1 else "front" if cos > 0 else "rear"))
    best = max(gap for gap, _ in found)
    return min(
        (side for gap, side in found if gap >= best - Decimal(tie_m)),
        key=("front", "rear", "lateral").index,
    )


# --- margin


def depth_by_points(corners, rings, n=24):
    """Return the greatest distance to the rings' areas among points of a rectangle: a lower and an
    upper bound.

    A grid of points, then smaller and smaller grids around the best of them, give the lower bound;
    no point lies farther from the first grid than half the diagonal of its cells, which gives the
    upper one.
    """

    def at(u, v):
        x, y = corners[0] + u * (corners[3] - corners[0]) + v * (corners[1] - corners[0])
        return distance_to_areas(float(x), float(y), rings)

    grid = [(at(i / n, j / n), i / n, j / n) for i in range(n + 1) for j in range(n + 1)]
    sides = [float(np.linalg.norm(corners[k] - corners[0])) for k in (3, 1)]
    upper = max(grid)[0] + math.hypot(*sides) / (2 * n)
    best = 0.0
    for start in sorted(grid, reverse=True)[:3]:
        value, u, v = start
        step = 0.5 / n
        while step > 2e-8:
            around = [
                (min(max(u + i * step, 0.0), 1.0), min(max(v + j * step, 0.0), 1.0))
                for i in (-1, 0, 1)
                for j in (-1, 0, 1)
            ]
            value, u, v = max((at(p, q), p, q) for p, q in around)
            step /= 2
        best = max(best, value)
    return best, upper


def distance_to_areas(x, y, rings):
    """Return the distance of a point to the nearest area, 0 inside one."""
    return (
        0.0
        if any(inside_ring(x, y, ring) for ring in rings)
        else min(distance_to_ring(x, y, ring) for ring in rings)
    )


def distance_to_ring(x, y, ring):
    """Return the distance of a point to a closed polyline."""
    return min(point_to_segment((x, y), a, b)[0] for a, b in pairwise([*ring, ring[0]]))


def inside_ring(x, y, ring):
    """Return whether a point lies inside a ring by the even-odd rule; a ring may cross itself."""
    inside = False
    for (x0, y0), (x1, y1) in pairwise([*ring, ring[0]]):
        if (y0 > y) != (y1 > y) and x < (x1 - x0) * (y - y0) / (y1 - y0) + x0:
            inside = not inside
    return inside
