"""Jitter of detected lanes: how far a line at one distance is from the mean of its places in the
frames before and after.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.learned_metrics.lanes import counted, pairs
from alpasim_plugin.lab.learned_metrics.types import FORWARD_M, Lane3D

AT_M = (40.0, 20.0)
LEAST_FRAMES = 5


def tracks(frames: Sequence[Sequence[Lane3D]]) -> list[list[tuple[int, Lane3D]]]:
    """Return lanes followed from frame to frame: the same line is at most 1.5 m to the side on
    three quarters of the common samples.

    Returns:
        Tracks of ``(frame, lane)``, in consecutive frames, of at least five.
    """
    done: list[list[tuple[int, Lane3D]]] = []
    live: list[list[tuple[int, Lane3D]]] = []
    for t, lanes in enumerate(frames):
        here = counted(lanes)
        linked = dict(pairs([track[-1][1] for track in live], here))
        done += [track for i, track in enumerate(live) if i not in linked]
        live = [[*live[i], (t, here[j])] for i, j in linked.items()] + [
            [(t, lane)] for j, lane in enumerate(here) if j not in set(linked.values())
        ]
    return [track for track in done + live if len(track) >= LEAST_FRAMES]


def lane_jitter_m(frames: Sequence[Sequence[Lane3D]], at_m: float = AT_M[0]) -> float | None:
    """Return the root mean square of ``v_t - (v_{t-1} + v_{t+1}) / 2`` over all tracks of a clip,
    metres.

    Args:
        frames: Lanes of every frame.
        at_m: Distance ahead at which ``v`` is read, linear between samples.

    Returns:
        None where no track has three consecutive frames that reach so far.
    """
    squares = [
        _second_differences(np.array([_at(lane, at_m) for _, lane in track])) ** 2
        for track in tracks(frames)
    ]
    values = np.concatenate([*squares, np.zeros(0)])
    return float(np.sqrt(values.mean())) if len(values) else None


def _at(lane: Lane3D, at_m: float) -> float:
    """Return a lane's lateral position at a distance; NaN where a sample beside it is missing."""
    k = int(np.searchsorted(FORWARD_M, at_m, side="right")) - 1
    share = (at_m - FORWARD_M[k]) / (FORWARD_M[k + 1] - FORWARD_M[k])
    return float(
        (1 - share) * lane.lateral_m[k] + (share * lane.lateral_m[k + 1] if share else 0.0)
    )


def _second_differences(v: F64) -> F64:
    if len(v) < 3:
        return np.zeros(0)
    h = v[1:-1] - (v[:-2] + v[2:]) / 2
    return np.asarray(h[np.isfinite(h)])
