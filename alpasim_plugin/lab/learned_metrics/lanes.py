"""Lanes of a video against lanes of its reference, by the paper's protocol (App. on metrics, after
OpenLane).

A lane counts with a score of at least 0.5, three visible points and 20 m of support, unless it lies
more than 10 m to the side on average. Two lanes may be paired with 10 m of common support and at
most 1.5 m apart on three quarters of their common samples; of those the assignment with the least
mean distance is taken. Instances are pooled over a clip: ``F1 = 2 TP / (2 TP + FP + FN)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from alpasim_plugin.core.types import F64, Bool
from alpasim_plugin.lab.learned_metrics.types import FORWARD_M, Lane3D

LEAST_SCORE = 0.5
LEAST_POINTS = 3
LEAST_SUPPORT_M = 20.0
MOST_ASIDE_M = 10.0
COMMON_M = 10.0
NEAR_ENOUGH_M = 1.5
NEAR_SHARE = 0.75
NEAR_M = 30.0  # the x-error's near range ends before this
NEVER = 1e6  # cost of a forbidden pair; infinite ones make the solver fail
STEP_M = float(FORWARD_M[1] - FORWARD_M[0])


@dataclass(frozen=True)
class LaneScore:
    """Sums over frames; `LaneScore() + ...` pools them over a clip.

    Args:
        matched, made, reference: Numbers of lanes.
        near_m, far_m: Sums of absolute lateral differences at matched samples, metres.
        near, far: Numbers of those samples.
    """

    matched: int = 0
    made: int = 0
    reference: int = 0
    near_m: float = 0.0
    far_m: float = 0.0
    near: int = 0
    far: int = 0

    def __add__(self, other: LaneScore) -> LaneScore:
        """Return the sums of both."""
        return LaneScore(
            self.matched + other.matched,
            self.made + other.made,
            self.reference + other.reference,
            self.near_m + other.near_m,
            self.far_m + other.far_m,
            self.near + other.near,
            self.far + other.far,
        )

    @property
    def f1(self) -> float | None:
        """F1; 0 where only one side has lanes, None where neither has."""
        both = self.made + self.reference
        return 2 * self.matched / both if both else None

    @property
    def xerr_m(self) -> float | None:
        """Mean absolute lateral difference of matched lanes; None without a match."""
        count = self.near + self.far
        return (self.near_m + self.far_m) / count if count else None

    @property
    def xerr_near_m(self) -> float | None:
        """The same below 30 m."""
        return self.near_m / self.near if self.near else None

    @property
    def xerr_far_m(self) -> float | None:
        """The same from 30 m on."""
        return self.far_m / self.far if self.far else None


def resampled(forward_m: F64, lateral_m: F64, score: float) -> Lane3D:
    """Return a lane of any detector at the protocol's distances: linear between its points, nothing
    beyond them.

    Example:
        >>> resampled(np.array([4.0, 10.0]), np.array([1.0, 2.5]), 0.9).lateral_m[:5]
        array([ nan, 1.25, 1.75, 2.25,  nan])
    """
    order = np.argsort(forward_m, kind="stable")
    return Lane3D(
        np.interp(FORWARD_M, forward_m[order], lateral_m[order], left=np.nan, right=np.nan), score
    )


def up_to(lanes: Sequence[Lane3D], forward_m: float) -> list[Lane3D]:
    """Return the lanes cut at a distance: the ``_30`` values, since lines are about a pixel wide
    farther away.
    """
    return [
        replace(lane, lateral_m=np.where(forward_m >= FORWARD_M, lane.lateral_m, np.nan))
        for lane in lanes
    ]


def counted(lanes: Sequence[Lane3D]) -> list[Lane3D]:
    """Return the lanes that take part."""
    return [lane for lane in lanes if _counts(lane)]


def _counts(lane: Lane3D) -> bool:
    visible = np.isfinite(lane.lateral_m)
    if lane.score < LEAST_SCORE or visible.sum() < LEAST_POINTS:
        return False
    return (
        _support_m(visible) >= LEAST_SUPPORT_M
        and abs(float(np.mean(lane.lateral_m[visible]))) <= MOST_ASIDE_M
    )


def _support_m(visible: Bool) -> float:
    return STEP_M * (int(visible.sum()) - 1)


def pairs(
    made: Sequence[Lane3D], reference: Sequence[Lane3D], near_share: float = NEAR_SHARE
) -> list[tuple[int, int]]:
    """Return which lanes belong together: the assignment of least mean distance among allowed
    pairs.
    """
    if not made or not reference:
        return []
    cost = np.full((len(made), len(reference)), NEVER)
    for i, a in enumerate(made):
        for j, b in enumerate(reference):
            common = np.isfinite(a.lateral_m) & np.isfinite(b.lateral_m)
            if _support_m(common) < COMMON_M:
                continue
            apart = np.abs(a.lateral_m - b.lateral_m)[common]
            if (apart <= NEAR_ENOUGH_M).mean() >= near_share:
                cost[i, j] = apart.mean()
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] < NEVER]


def score_frame(made: Sequence[Lane3D], reference: Sequence[Lane3D]) -> LaneScore:
    """Return one frame's sums."""
    made, reference = counted(made), counted(reference)
    found = pairs(made, reference)
    near = FORWARD_M < NEAR_M
    apart = np.array(
        [np.abs(made[i].lateral_m - reference[j].lateral_m) for i, j in found]
    ).reshape(len(found), len(FORWARD_M))
    sums = [
        (float(np.nansum(apart[:, which])), int(np.isfinite(apart[:, which]).sum()))
        for which in (near, ~near)
    ]
    return LaneScore(
        len(found), len(made), len(reference), sums[0][0], sums[1][0], sums[0][1], sums[1][1]
    )


def score_clip(
    made: Sequence[Sequence[Lane3D]], reference: Sequence[Sequence[Lane3D]]
) -> LaneScore:
    """Return a clip's sums over its frames."""
    total = LaneScore()
    for a, b in zip(made, reference, strict=True):
        total = total + score_frame(a, b)
    return total
