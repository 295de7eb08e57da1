"""Metrics of a clip by the user's detectors: Cuboid F1, Lane F1, and how far the cuboid detector is
right on clean frames.
"""

from __future__ import annotations

from pathlib import Path

from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.lab.video_metrics.cuboids import drawn_vehicles, overlap
from alpasim_plugin.lab.video_metrics.detectors import (
    CUBOIDS,
    LANES,
    available_detectors,
    detect_boxes,
    detect_lanes,
)
from alpasim_plugin.lab.video_metrics.lanes import lane_matches


def object_metrics(made: U8, truth: U8, sdmap: U8, K: F64, folder: Path) -> dict[str, float]:
    """Return the values of one clip by name; a value that is not defined is left out.

    Args:
        made, truth: ``(T, H, W, 3)``.
        sdmap: Semantic maps ``(T, H, W, 3)``, in which vehicles are drawn.
        K: ``(3, 3)``, pixels.
        folder: Of the detectors.
    """
    values: dict[str, float | None] = {}
    detectors = available_detectors(folder)
    if CUBOIDS in detectors:
        made_masks = (boxes.mask() for boxes in detect_boxes(made, K, folder))
        true_masks = [boxes.mask() for boxes in detect_boxes(truth, K, folder)]
        map_masks = (drawn_vehicles(image, true_masks[0].shape) for image in sdmap)
        clean = overlap(true_masks, map_masks)
        values[CUBOIDS] = overlap(made_masks, true_masks).f1
        values["cuboid_clean_precision"] = clean.precision
        values["cuboid_clean_recall"] = clean.recall
    if LANES in detectors:
        matches = lane_matches(detect_lanes(made, K, folder), detect_lanes(truth, K, folder))
        values[LANES] = matches.f1
        values["lane_error_m"] = matches.error_m
    return {name: value for name, value in values.items() if value is not None}
