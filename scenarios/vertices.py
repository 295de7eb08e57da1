"""Vertices as AlpaSim's map loader leaves them: its rules look for lane centres and road edges by vertex, so their places matter."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import F64

MAX_STEP_M = 2.0


def with_vertices(line: F64) -> F64:
    """Put ``floor(length / 2 m)`` equally spaced points into every segment of a polyline ``(N, 3)``; lengths are measured in 3-D.

    Unlike `alpasim_plugin.core.geometry.densify` it also splits a segment of exactly 2 m. Vertices stay as they are, and a new point is
    ``start + step * k`` with ``step = segment / pieces``, rounded in that order: neighbouring lanes share edges but not vertices, and
    rounding decides whether their union has a crack there, which a distance to its border sees.
    """
    segments = np.diff(line, axis=0)
    pieces = (np.linalg.norm(segments, axis=1) // MAX_STEP_M).astype(np.int64) + 1
    if not len(pieces) or int(pieces.max()) == 1:
        return line
    segment = np.repeat(np.arange(len(pieces)), pieces)
    nth = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 1
    points = line[segment] + (segments / pieces[:, None])[segment] * nth[:, None]
    points[nth == pieces[segment]] = line[1:]
    return np.concatenate([line[:1], points])
