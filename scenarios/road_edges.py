"""Borders of the drivable surface, derived from areas where a source gives areas and no borders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy
import shapely

from alpasim_plugin.core.geometry import densify
from alpasim_plugin.core.types import F64

SEAM_M = 0.1  # neighbouring areas drawn with gaps up to this wide are one surface
MIN_HOLE_M2 = 0.5  # smaller holes are seams too
STEP_M = 2.0  # AlpaSim's loaders keep the vertices of edges at most this far apart


def merge_areas(areas: Sequence[Any], seam_m: float = SEAM_M) -> Any:
    """Return the union of shapely areas with seams up to ``seam_m`` closed and tiny holes filled.

    Closing is a mitred offset outwards and back, which moves no straight border.
    """
    half = seam_m / 2
    merged = shapely.union_all([shapely.make_valid(a) for a in areas])
    closed = shapely.buffer(merged, half, join_style="mitre", mitre_limit=2.0)
    closed = shapely.union_all([merged, shapely.buffer(closed, -half, join_style="mitre", mitre_limit=2.0)])
    parts = [p for p in shapely.get_parts(closed) if shapely.get_type_id(p) == 3]
    filled = [shapely.Polygon(p.exterior, [h for h in p.interiors if shapely.Polygon(h).area >= MIN_HOLE_M2]) for p in parts]
    return shapely.union_all(filled)


def border_lines(area: Any, heights: F64, step_m: float = STEP_M) -> tuple[F64, ...]:
    """Return the borders of a shapely area as closed polylines ``(N, 3)``, exterior rings first in each part.

    Args:
        area: Polygon or MultiPolygon.
        heights: ``(M, 3)`` points of the source; a border vertex takes the height of the nearest one.
        step_m: Largest distance between neighbouring vertices.
    """
    tree = scipy.spatial.KDTree(heights[:, :2])
    lines: list[F64] = []
    for part in shapely.get_parts(area):
        for ring in (part.exterior, *part.interiors):
            xy = densify(np.asarray(shapely.get_coordinates(ring), dtype=np.float64), step_m)
            lines.append(np.column_stack([xy, heights[tree.query(xy)[1], 2]]))
    return tuple(lines)
