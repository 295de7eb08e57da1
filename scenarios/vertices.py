"""Vertices as AlpaSim's map loader leaves them: its rules look for lane centres and road edges by vertex, so their places matter."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.types import F64

MAX_STEP_M = 2.0


def with_vertices(line: F64) -> F64:
    """Put ``floor(length / 2 m)`` equally spaced points into every segment of a polyline ``(N, 3)``; lengths are measured in 3-D.

    Unlike `alpasim_plugin.geometry_lanes.densify` it also splits a segment of exactly 2 m.
    """
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    pieces = (steps // MAX_STEP_M).astype(np.int64) + 1
    if not len(pieces) or int(pieces.max()) == 1:
        return line
    segment = np.repeat(np.arange(len(pieces)), pieces)
    nth = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 1
    share = (nth / pieces[segment])[:, None]
    start = line[segment]
    return np.concatenate([line[:1], start + (line[segment + 1] - start) * share])
