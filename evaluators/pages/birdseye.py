"""What every view from above draws of a scene: its map, and the direction of the logged drive."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.geometry import heading_of
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.core.types import F64


def chord_angle(log: F64) -> float:
    """Return the direction in radians from the first to the last of ``(N, 2)`` points; 0 where they
    are hardly apart.
    """
    chord = log[-1] - log[0]
    return float(heading_of(chord)) if float(np.hypot(*chord)) > 1.0 else 0.0


def drawn_map(content: JsonView) -> dict[str, list[F64]]:
    """Return what every view from above draws of a map: ``lanes``, ``markings`` (edges of lanes
    that carry some), ``edges`` and ``crosswalks``.

    Args:
        content: ``scenes/SCENE.json``.

    Returns:
        Lines, and rings of areas without their first point again, each ``(N, 2)`` metres, world.
    """
    rings = []
    marked = []
    for lane in content.get("lanes") or []:
        left = lane.get("left")
        right = lane.get("right")
        if left and right:
            rings.append([*left, *reversed(right)])
        edges = zip((left, right), lane["markings"], strict=True)
        marked += [edge for edge, kind in edges if kind != "none"]

    def arrays(lines: Sequence[Any], least: int) -> list[F64]:
        """Return the lines of at least so many points."""
        return [
            np.asarray(line, dtype=np.float64)[:, :2]
            for line in lines
            if line is not None and len(line) >= least
        ]

    return {
        "lanes": arrays(rings, 3),
        "markings": arrays(marked, 2),
        "edges": arrays(content.get("road_edges") or [], 2),
        "crosswalks": arrays(content.get("crosswalks") or [], 3),
    }
