"""What detections of one clip are worth: the values of the lane and cuboid metrics, None where one
is undefined.
"""

from __future__ import annotations

from collections.abc import Sequence

from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.learned_metrics.cuboids import cuboid_f1
from alpasim_plugin.lab.learned_metrics.facts import (
    CUBOID_F1,
    LANE_F1,
    LANE_F1_30,
    LANE_JITTER,
    LANE_JITTER_20,
    LANE_XERR,
    LANE_XERR_30,
)
from alpasim_plugin.lab.learned_metrics.lane_jitter import AT_M, lane_jitter_m
from alpasim_plugin.lab.learned_metrics.lanes import NEAR_M, score_clip, up_to
from alpasim_plugin.lab.learned_metrics.types import Cuboid, Lane3D

Lanes = Sequence[Sequence[Lane3D]]
Cuboids = Sequence[Sequence[Cuboid]]


def lane_values(made: Lanes, reference: Lanes | None) -> dict[str, float | None]:
    """Return F1 and x-error against the reference (not without one), to 59 m and to 30 m, and the
    jitter at 40 and 20 m.
    """
    out = {LANE_JITTER: lane_jitter_m(made, AT_M[0]), LANE_JITTER_20: lane_jitter_m(made, AT_M[1])}
    if reference is None:
        return out
    far = score_clip(made, reference)
    near = score_clip(
        [up_to(lanes, NEAR_M) for lanes in made], [up_to(lanes, NEAR_M) for lanes in reference]
    )
    return {
        LANE_F1: far.f1,
        LANE_F1_30: near.f1,
        LANE_XERR: far.xerr_m,
        LANE_XERR_30: near.xerr_m,
        **out,
    }


def cuboid_values(
    made: Cuboids, reference: Cuboids, K: F64, size: tuple[int, int]
) -> dict[str, float | None]:
    """Return the Cuboid F1 of a clip."""
    return {CUBOID_F1: cuboid_f1(made, reference, K, size)}
