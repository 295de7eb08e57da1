"""Distance and heading difference between two plans for the same policy query, at times ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import interpolate, wrap_angle
from alpasim_plugin.core.types import F64, LoggedPlan, Trajectory

HORIZON_US = 3_000_000
DIVERGED_M = 0.5  # a 1.88 m car has 0.8 m to either side in a 3.5 m lane


@dataclass(frozen=True)
class Divergence:
    """The first query at which the plans of two policies, or of one policy behind two renderers, differ.

    Attributes:
        t_us: Time of the query.
        gap_m: Distance between the plans at the horizon, or at the end of the shorter plan where that comes first.
        ahead_us: How far ahead of the query that is.
    """

    t_us: int
    gap_m: float
    ahead_us: int


def plan_gap(one: Trajectory, other: Trajectory, at_us: Sequence[int]) -> tuple[F64, F64]:
    """Compare two plans of rig poses in the world.

    Args:
        one: A plan.
        other: Another one.
        at_us: ``(H,)`` absolute times.

    Returns:
        Distance ``(H,)`` in plan view, metres, and heading of ``other`` less that of ``one`` ``(H,)``, radians in (-pi, pi]; NaN at times
        that either plan does not reach.
    """
    times = np.asarray(at_us, dtype=np.int64)
    first, last = max(one.t_us[0], other.t_us[0]), min(one.t_us[-1], other.t_us[-1])
    inside = (times >= first) & (times <= last)
    gap, turn = np.full(times.shape, np.nan), np.full(times.shape, np.nan)
    if inside.any():
        a, b = interpolate(one, times[inside]), interpolate(other, times[inside])
        gap[inside] = np.linalg.norm(b[:, :2, 3] - a[:, :2, 3], axis=1)
        turn[inside] = wrap_angle(np.arctan2(b[:, 1, 0], b[:, 0, 0]) - np.arctan2(a[:, 1, 0], a[:, 0, 0]))
    return gap, turn


def first_divergence(
    one: Sequence[LoggedPlan], other: Sequence[LoggedPlan], threshold_m: float = DIVERGED_M, horizon_us: int = HORIZON_US
) -> Divergence | None:
    """Return the first query common to both at which their plans lie more than a threshold apart at the horizon; None if there is none.

    Plans that end before the horizon are compared at the end of the shorter one.
    """
    plans = {plan.now_us: plan.trajectory for plan in other if len(plan.trajectory)}
    for plan in one:
        if plan.now_us not in plans or not len(plan.trajectory):
            continue
        mine, theirs = plan.trajectory, plans[plan.now_us]
        at_us = min(plan.now_us + horizon_us, int(mine.t_us[-1]), int(theirs.t_us[-1]))
        gap = float(plan_gap(mine, theirs, [at_us])[0][0])
        if gap > threshold_m:
            return Divergence(plan.now_us, gap, at_us - plan.now_us)
    return None
