"""Metrics of a clip by detectors: Cuboid F1, Lane F1, and how far the detectors are right on its clean
frames.

Every fifth frame is searched: neighbouring ones show nearly the same, and a detector sees the image at
eight times the size of ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.lab.video_metrics.cuboids import Boxes, drawn_vehicles, overlap
from alpasim_plugin.lab.video_metrics.detectors import (
    CUBOIDS,
    LANES,
    available_detectors,
    detect_boxes,
    detect_lanes,
)
from alpasim_plugin.lab.video_metrics.lanes import Lanes, lane_matches, lanes_at

EVERY = 5  # frames


@dataclass(frozen=True)
class Objects:
    """What the detectors find in the searched frames of a video; None without the detector."""

    boxes: tuple[Boxes, ...] | None
    lanes: tuple[Lanes, ...] | None


def detect_objects(video: U8, K: F64, folder: Path) -> Objects:
    """Search every fifth frame of a video.

    Args:
        video: ``(T, H, W, 3)``.
        K: ``(3, 3)``, pixels.
        folder: Of the detectors.
    """
    detectors = available_detectors(folder)
    searched = video[::EVERY]
    return Objects(
        tuple(detect_boxes(searched, K, folder)) if CUBOIDS in detectors else None,
        tuple(detect_lanes(searched, K, folder)) if LANES in detectors else None,
    )


def object_metrics(made: Objects, true: Objects) -> dict[str, float]:
    """Return the values of one clip by name; a value that is not defined is left out.

    Args:
        made: Of the video.
        true: Of the true one, by the same detectors.
    """
    values: dict[str, float | None] = {}
    if made.boxes is not None and true.boxes is not None:
        values[CUBOIDS] = overlap(
            (boxes.mask() for boxes in made.boxes), (boxes.mask() for boxes in true.boxes)
        ).f1
    if made.lanes is not None and true.lanes is not None:
        matches = lane_matches(made.lanes, true.lanes)
        values[LANES] = matches.f1
        values["lane_error_m"] = matches.error_m
    return {name: value for name, value in values.items() if value is not None}


def clean_metrics(true: Objects, sdmap: U8, lanes: Sequence[F64] | None) -> dict[str, float]:
    """Return precision and recall of the detectors on the clean frames of a clip, by name; a value that
    is not defined is left out.

    Args:
        true: Of the clean frames.
        sdmap: Semantic maps ``(T, H, W, 3)``, in which vehicles are drawn.
        lanes: Of every frame the true lines ``(L, 29)``, metres; None where nobody knows them.
    """
    values: dict[str, float | None] = {}
    if true.boxes is not None:
        masks = (boxes.mask() for boxes in true.boxes)
        vehicles = (
            drawn_vehicles(image, boxes.size)
            for image, boxes in zip(sdmap[::EVERY], true.boxes, strict=True)
        )
        clean = overlap(masks, vehicles)
        values["cuboid_clean_precision"] = clean.precision
        values["cuboid_clean_recall"] = clean.recall
    if true.lanes is not None and lanes is not None:
        matches = lane_matches(true.lanes, (lanes_at(rows) for rows in lanes[::EVERY]))
        values["lane_clean_precision"] = matches.precision
        values["lane_clean_recall"] = matches.recall
    return {name: value for name, value in values.items() if value is not None}
