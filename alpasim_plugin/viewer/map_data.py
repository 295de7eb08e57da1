"""The map of a scene for a page: lanes, paint, edges, crosswalks and the recorded drive near where somebody drove."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64
from alpasim_plugin.viewer.units import Place
from evaluators.report.birdseye import chord_angle, lane_ring, painted_edges

AROUND_M = 120.0  # what is farther from the recorded drive is not drawn
TOLERANCE_M = 0.04  # of simplified lines


def recorded_drive(content: Mapping[str, Any], scene: str) -> F64:
    """Return the recorded drive of ``scenes/SCENE.json``, ``(N, 2)`` metres, world.

    Raises:
        InputError: It has fewer than two points.
    """
    log = np.column_stack([content["ego_log"]["x_m"], content["ego_log"]["y_m"]]).astype(np.float64)
    if len(log) < 2:
        raise InputError("drawing a scene", scene, f"a recorded drive of {len(log)} points", "make the run again")
    return log


def map_data(content: Mapping[str, Any], log: F64, place: Place) -> dict[str, Any]:
    """Return the map in whole centimetres.

    Args:
        content: ``scenes/SCENE.json``.
        log: As `recorded_drive` returns it.
        place: Where numbers count from.
    """
    low, high = log.min(axis=0) - AROUND_M, log.max(axis=0) + AROUND_M
    window = shapely.box(*low, *high)

    def near(lines: Sequence[Sequence[Sequence[float]] | None], least: int) -> list[list[list[int]]]:
        """Simplify the lines of at least so many points that come near."""
        points = [np.asarray(line, dtype=np.float64)[:, :2] for line in lines if line is not None and len(line) >= least]
        shapes = shapely.simplify([shapely.linestrings(line) for line in points], TOLERANCE_M, preserve_topology=False)
        kept = {shape.wkb: shape for shape in shapes if window.intersects(shape)}  # a border shared by two lanes is drawn once
        return [place.cm(shapely.get_coordinates(shape)) for shape in kept.values()]

    lanes = content.get("lanes") or []
    return {
        "turn": round(chord_angle(log), 4),
        "lanes": near([lane_ring(lane) for lane in lanes], 3),
        "paint": near([edge for lane in lanes for edge in painted_edges(lane)], 2),
        "edges": near(content.get("road_edges") or [], 2),
        "crosswalks": near(content.get("crosswalks") or [], 3),
        "log": place.cm(log),
        "source": str(content.get("source") or ""),
    }
