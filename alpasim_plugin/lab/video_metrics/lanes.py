"""Lane F1 and lateral error: whether the same detector finds the same lanes in a video and in the
true one (the paper's appendix on metrics).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from alpasim_plugin.core.types import F64, Bool

SCORE = 0.50
FEWEST_POINTS = 3
SHORTEST_M = 10.0  # from a lane's first to its last visible point, and of what two have in common
SUPPORT_M = 20.0  # of a lane
FARTHEST_M = 10.0  # mean lateral distance
GATE_M = 1.5
GATE_SHARE = 0.75  # of common samples within the gate
SAMPLES_M = np.arange(3.0, 60.0, 2.0)  # ahead
STEP_M = 2.0
FORBIDDEN = 1e6  # cost of a pair that is not allowed


@dataclass(frozen=True)
class Lanes:
    """What a detector finds in a frame: ``points`` ``(N, S, 3)`` metres (x right, y forward, z up),
    ``visible`` ``(N, S)``, ``scores`` ``(N,)``.
    """

    points: F64
    visible: Bool
    scores: F64

    def resampled(self) -> F64:
        """Return the lateral positions ``(M, 29)`` of the lanes that count, at 3, 5, ... 59 m
        ahead, metres; NaN beyond a lane's visible ends.
        """
        rows = [
            _resample(points[visible])
            for points, visible, score in zip(self.points, self.visible, self.scores, strict=True)
            if score >= SCORE and visible.sum() >= FEWEST_POINTS
        ]
        kept = [row for row in rows if _is_counted(row)]
        return np.array(kept).reshape(-1, len(SAMPLES_M))


def lanes_at(positions: F64) -> Lanes:
    """Return lanes by their lateral positions ``(L, 29)`` at `SAMPLES_M` ahead, metres; NaN where they
    are not.
    """
    visible = ~np.isnan(positions)
    points = np.zeros((*positions.shape, 3))
    points[..., 0] = np.where(visible, positions, 0.0)
    points[..., 1] = SAMPLES_M
    return Lanes(points, visible, np.ones(len(positions)))


@dataclass(frozen=True)
class LaneMatches:
    """Lanes of a clip: matched, of the video alone, of the truth alone; mean lateral error, metres,
    None without a match.
    """

    matched: int
    extra: int
    missed: int
    error_m: float | None

    @property
    def f1(self) -> float | None:
        """``2 TP / (2 TP + FP + FN)``; None where neither has a lane."""
        total = 2 * self.matched + self.extra + self.missed
        return 2 * self.matched / total if total else None

    @property
    def precision(self) -> float | None:
        """``TP / (TP + FP)``; None where the video has no lane."""
        total = self.matched + self.extra
        return self.matched / total if total else None

    @property
    def recall(self) -> float | None:
        """``TP / (TP + FN)``; None where the truth has no lane."""
        total = self.matched + self.missed
        return self.matched / total if total else None


def lane_matches(made: Iterable[Lanes], true: Iterable[Lanes]) -> LaneMatches:
    """Match the lanes of every frame and pool them over a clip."""
    matched = extra = missed = 0
    errors: list[F64] = []
    for frame, truth in zip(made, true, strict=True):
        a, b = frame.resampled(), truth.resampled()
        pairs = match(a, b)
        matched += len(pairs)
        extra += len(a) - len(pairs)
        missed += len(b) - len(pairs)
        errors += [_common_difference(a[i], b[j]) for i, j in pairs]
    error = float(np.concatenate(errors).mean()) if errors else None
    return LaneMatches(matched, extra, missed, error)


def match(a: F64, b: F64) -> list[tuple[int, int]]:
    """Return the pairs of lanes ``(N, 29)`` and ``(M, 29)`` with the least sum of mean lateral
    differences, of those that are allowed: 10 m in common, three quarters within 1.5 m.
    """
    cost = np.full((len(a), len(b)), FORBIDDEN)
    for i, lane in enumerate(a):
        for j, other in enumerate(b):
            difference = _common_difference(lane, other)
            long_enough = (len(difference) - 1) * STEP_M >= SHORTEST_M
            if long_enough and np.mean(difference <= GATE_M) >= GATE_SHARE:
                cost[i, j] = difference.mean()
    rows, columns = linear_sum_assignment(cost)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return [(i, j) for i, j in pairs if cost[i, j] < FORBIDDEN]


def _resample(points: F64) -> F64:
    """Return x at the samples, linear between visible points ``(P, 3)``; NaN outside and for lanes
    shorter than 10 m.
    """
    ahead = points[:, 1]
    if np.any(np.diff(ahead) <= 0):
        points = points[np.argsort(ahead, kind="stable")]
        ahead = points[:, 1]
    if ahead[-1] - ahead[0] < SHORTEST_M:
        return np.full(len(SAMPLES_M), np.nan)
    return np.interp(SAMPLES_M, ahead, points[:, 0], left=np.nan, right=np.nan)


def _is_counted(row: F64) -> bool:
    has = ~np.isnan(row)
    support_m = (has.sum() - 1) * STEP_M
    return bool(support_m >= SUPPORT_M and abs(row[has].mean()) <= FARTHEST_M)


def _common_difference(a: F64, b: F64) -> F64:
    common = ~np.isnan(a) & ~np.isnan(b)
    return np.abs(a[common] - b[common])
