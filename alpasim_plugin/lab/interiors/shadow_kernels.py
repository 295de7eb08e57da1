"""Loops over points and blocks: which points a light reaches, and how far the nearest block is."""

# Numba's decorators are untyped.
# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

import numpy as np
from numba import njit

from alpasim_plugin.core.types import F64, Bool


@njit(cache=True, nogil=True, error_model="numpy")
def reached(
    points: F64, light: F64, wanted: Bool, rotations: F64, middles: F64, halves: F64
) -> Bool:
    """Return whether nothing stands between points ``(N, 3)`` and a light ``(3,)``; False where it
    is not ``wanted (N,)``.

    Args:
        points, light: World, metres.
        wanted: Which points are asked about.
        rotations: ``(B, 3, 3)`` columns are the blocks' axes.
        middles, halves: ``(B, 3)``.
    """
    out = wanted.copy()
    for i in range(len(points)):
        if not wanted[i]:
            continue
        for b in range(len(middles)):
            enters, leaves = 0.0, 1.0
            for k in range(3):
                start, end = 0.0, 0.0
                for j in range(3):
                    start += (points[i, j] - middles[b, j]) * rotations[b, j, k]
                    end += (light[j] - middles[b, j]) * rotations[b, j, k]
                d = end - start
                if abs(d) < 1e-12:
                    if abs(start) > halves[b, k]:
                        leaves = -1.0
                    continue
                t0, t1 = (-halves[b, k] - start) / d, (halves[b, k] - start) / d
                enters, leaves = max(enters, min(t0, t1)), min(leaves, max(t0, t1))
                if enters >= leaves:
                    break
            if enters < leaves:
                out[i] = False
                break
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def nearest(points: F64, rotations: F64, middles: F64, halves: F64, most_m: float) -> F64:
    """Return the distance ``(N,)`` from points ``(N, 3)`` to the nearest block, 0 inside, at most
    ``most_m``.
    """
    out = np.full(len(points), most_m)
    for i in range(len(points)):
        for b in range(len(middles)):
            total = 0.0
            for k in range(3):
                local = 0.0
                for j in range(3):
                    local += (points[i, j] - middles[b, j]) * rotations[b, j, k]
                total += max(abs(local) - halves[b, k], 0.0) ** 2
                if total >= out[i] * out[i]:
                    break
            out[i] = min(out[i], np.sqrt(total))
    return out
