"""Distances between the videos of a variant and the true ones, over all clips: FVD and motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.video_metrics.frechet import set_distance
from alpasim_plugin.lab.video_metrics.video_features import options

Row = Mapping[str, Any]
FEATURES = "features"  # of a row: name of a metric to vectors


def set_distances(made: Mapping[str, Row], truth: Mapping[str, Row]) -> dict[str, Any]:
    """Return the Frechet distances of a variant's clips from the true ones.

    Args:
        made: Rows by clip; ``features`` as `video_features.video_features` returns them.
        truth: The same of the true frames.

    Returns:
        METRIC -> ``value`` (None with ``reason``), ``vectors``, ``dimensions``, ``options``,
        ``windows``: the same numbers of every window, by its first frame. Metrics that not every
        clip carries are left out.
    """
    clips = [clip for clip in made if clip in truth]
    pairs = [(made[clip], truth[clip]) for clip in clips]
    names = _carried([row for pair in pairs for row in pair])
    out: dict[str, Any] = {}
    for name in names:
        made_vectors, true_vectors = (
            _stacked([pair[side] for pair in pairs], name) for side in (0, 1)
        )
        if min(len(made_vectors), len(true_vectors)) < 2:
            continue  # one vector has no covariance at all
        distance = asdict(set_distance(made_vectors, true_vectors))
        metric, _, first_frame = name.partition("@")
        if first_frame:
            out[metric]["windows"].append({"first_frame": int(first_frame), **distance})
        else:
            out[metric] = {**distance, "options": options(metric), "windows": []}
    return out


def _carried(rows: Sequence[Row]) -> list[str]:
    """Return the metrics whose vectors every row carries, windows after their metric."""
    if not rows:
        return []
    names = set.intersection(*(set(row.get(FEATURES, {})) for row in rows))
    return sorted(names, key=_order)


def _order(name: str) -> tuple[str, int]:
    metric, _, first_frame = name.partition("@")
    return metric, int(first_frame or -1)


def _stacked(rows: Sequence[Row], name: str) -> F64:
    return np.concatenate([np.asarray(row[FEATURES][name], dtype=np.float64) for row in rows])
