"""Cut simple polygons into triangles by clipping ears (Meisters, 1975): quadratic, and rings of a map are short."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.types import F64, I64


def ear_clip(ring: F64) -> I64:
    """Return the triangles ``(N - 2, 3)`` of a ring ``(N, 2)`` as indices of its points, wound like the ring.

    A ring that crosses itself has no triangulation; corners that are no ears are then clipped as well, so the call always ends.
    """
    left = list(range(len(ring)))
    x, y = ring[:, 0], ring[:, 1]
    turn = 1.0 if np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)) >= 0 else -1.0
    triangles: list[tuple[int, int, int]] = []
    while len(left) > 3:
        corners = [(left[k - 1], left[k], left[(k + 1) % len(left)]) for k in range(len(left))]
        k = next((k for k, (a, b, c) in enumerate(corners) if _is_ear(ring, left, a, b, c, turn)), 0)
        triangles.append(corners[k])
        del left[k]
    triangles.append((left[0], left[1], left[2]))
    return np.array(triangles, dtype=np.int64)


def _is_ear(ring: F64, left: list[int], a: int, b: int, c: int, turn: float) -> bool:
    """Tell whether the corner b bulges outwards and no other point lies in its triangle; a straight corner is an ear of no area."""
    p, q, r = ring[a], ring[b], ring[c]
    area = turn * _cross(q - p, r - q)
    if area <= 0:
        return bool(area == 0)
    others = ring[[i for i in left if i not in (a, b, c)]]
    inside = [turn * _cross(v - u, others - u) for u, v in ((p, q), (q, r), (r, p))]
    touching = np.all(np.stack(inside) >= 0, axis=0)
    same = np.any([np.all(others == corner, axis=1) for corner in (p, q, r)], axis=0)  # a ring may touch itself in a corner
    return not bool(np.any(touching & ~same))


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
