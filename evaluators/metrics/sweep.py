"""First contact of two moving rectangles, exact to one nanometre.

Each body's centre moves on a straight line and its heading turns at a constant rate. Two rectangles
are apart if and only if one of the four directions of their sides separates them (separating axis
theorem). The gap along such a direction is a smooth function of time, up to downward kinks, whose
second derivative is bounded by the speeds. A stretch of time is ruled out where one gap, less what
that curvature could hide, stays above zero; any other stretch is halved. So no contact is passed
over, however short.

Lengths are metres. Time is the share ``tau`` of the stretch, 0 to 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import F64, I64

TOUCH_M = 1e-9  # bodies this near touch; the first contact is found to this much of motion
_N_GAPS = 8  # both sides of four directions


@dataclass(frozen=True)
class Motions:
    """M pairs of rectangles in steady motion: the ego and another body."""

    start: F64  # (M, 2) centre of the other less centre of the ego, at tau = 0
    shift: F64  # (M, 2) by how much it changes until tau = 1
    yaw: F64  # (M, 2) heading of ego and other at tau = 0
    turn: F64  # (M, 2) by how much they turn
    half: F64  # (M, 2, 2) half length and width of ego and other

    def take(self, rows: I64) -> Motions:
        """Return some of the pairs."""
        return Motions(
            self.start[rows], self.shift[rows], self.yaw[rows], self.turn[rows], self.half[rows]
        )

    def distance_m(self) -> F64:
        """Return the least distance ``(M,)`` of the centres."""
        length2 = np.einsum("ij,ij->i", self.shift, self.shift)
        f = -np.einsum("ij,ij->i", self.start, self.shift)
        f = np.clip(np.divide(f, length2, out=np.zeros_like(f), where=length2 > 0), 0.0, 1.0)
        return np.linalg.norm(self.start + f[:, None] * self.shift, axis=1)

    def radius_m(self) -> F64:
        """Return the radii ``(M, 2)`` of the circles around ego and other."""
        return np.hypot(self.half[..., 0], self.half[..., 1])


def gaps(pairs: Motions, tau: F64) -> F64:
    """Return the gaps ``(M, 8)`` along the sides' directions at ``(M,)``: the bodies are apart
    where the largest is positive.
    """
    center = pairs.start + tau[:, None] * pairs.shift
    yaw = pairs.yaw + tau[:, None] * pairs.turn
    c = np.abs(np.cos(yaw[:, 1] - yaw[:, 0]))
    s = np.abs(np.sin(yaw[:, 1] - yaw[:, 0]))
    out = np.empty((len(tau), _N_GAPS))
    for body in (0, 1):
        cos = np.cos(yaw[:, body])
        sin = np.sin(yaw[:, body])
        half_size = pairs.half[:, body]
        other_half_size = pairs.half[:, 1 - body]
        offsets = (cos * center[:, 0] + sin * center[:, 1], cos * center[:, 1] - sin * center[:, 0])
        reach = (
            half_size[:, 0] + other_half_size[:, 0] * c + other_half_size[:, 1] * s,
            half_size[:, 1] + other_half_size[:, 0] * s + other_half_size[:, 1] * c,
        )
        for axis in (0, 1):
            k = 4 * body + 2 * axis
            out[:, k], out[:, k + 1] = offsets[axis] - reach[axis], -offsets[axis] - reach[axis]
    return out


def curvature(pairs: Motions) -> F64:
    """Return a bound ``(M, 8)`` on the second derivative of each gap between its kinks.

    With n turning at rate w and r moving by v: (n . r)'' = n''. r + 2 n'. v, at most w^2 |r| + 2
    |w| |v|. The other body's reach along n is a cosine of the relative heading with its half
    diagonal as amplitude.
    """
    far = np.maximum(
        np.linalg.norm(pairs.start, axis=1), np.linalg.norm(pairs.start + pairs.shift, axis=1)
    )
    speed = np.linalg.norm(pairs.shift, axis=1)
    relative = (pairs.turn[:, 1] - pairs.turn[:, 0]) ** 2
    turn = np.abs(pairs.turn)
    radius = pairs.radius_m()
    per_body = [
        turn[:, b] ** 2 * far + 2 * turn[:, b] * speed + relative * radius[:, 1 - b] for b in (0, 1)
    ]
    return np.repeat(np.stack(per_body, axis=1), _N_GAPS // 2, axis=1)


def slope(pairs: Motions) -> F64:
    """Return a bound ``(M,)`` on how fast any gap changes."""
    far = np.maximum(
        np.linalg.norm(pairs.start, axis=1), np.linalg.norm(pairs.start + pairs.shift, axis=1)
    )
    turn = np.abs(pairs.turn)
    return (
        np.linalg.norm(pairs.shift, axis=1)
        + turn.max(axis=1) * far
        + turn.sum(axis=1) * pairs.radius_m().max(axis=1)
    )


def first_contact(pairs: Motions) -> F64:
    """Return when each pair first touches.

    Returns:
        ``(M,)`` tau, inf where it never does. Where a time is given, the bodies are at most
        `TOUCH_M` apart at it, and more than zero apart until `TOUCH_M` of motion before it; where
        none is given, they are apart throughout.
    """
    n = len(pairs.start)
    first = np.full(n, np.inf)
    bend = curvature(pairs)
    steep = slope(pairs)
    owner = np.arange(n)
    low = np.zeros(n)
    width = np.ones(n)
    at_low = gaps(pairs, low)
    at_high = gaps(pairs, width)
    while len(owner):
        for tau, gap in ((low, at_low), (low + width, at_high)):
            touching = gap.max(axis=1) <= TOUCH_M
            np.minimum.at(first, owner[touching], tau[touching])
        hidden = bend[owner] * (width**2 / 8)[:, None]
        apart = np.any(np.minimum(at_low, at_high) > hidden, axis=1)
        open_ = ~apart & (low < first[owner])
        short = open_ & (steep[owner] * width <= TOUCH_M / 4)
        np.minimum.at(first, owner[short], low[short])
        rows = np.flatnonzero(open_ & ~short)
        owner = owner[rows]
        low = low[rows]
        width = width[rows] / 2
        at_low = at_low[rows]
        at_high = at_high[rows]
        at_middle = gaps(pairs.take(owner), low + width)
        owner = np.tile(owner, 2)
        low = np.concatenate([low, low + width])
        width = np.tile(width, 2)
        at_low = np.concatenate([at_low, at_middle])
        at_high = np.concatenate([at_middle, at_high])
    return first
