"""Asymptotic e-processes and confidence sequences for means of differences without bounds.

Sums of many scenes behave like a Brownian motion with the variance of a scene, at all numbers of
scenes at once (strong approximation). The chance that it reaches a line before the ceiling is a
martingale (`line.py`), which gives bounds that hold at every look once the first look is late
enough (Waudby-Smith, Arbour, Sinha, Kennedy and Ramdas, Time-uniform central limit theory and
asymptotic confidence sequences, Annals of Statistics 52, 2024). The guarantee is approximate, as
that of a t interval is. Two things keep it honest with few scenes: the t statistic of n scenes is
mapped to the normal value of equal probability, and nothing is said before the first look.
"""

from __future__ import annotations

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.types import F64, Bool
from evaluators.statistics.sequential import line
from evaluators.statistics.sequential.draws import Draws
from evaluators.statistics.sequential.line import Plan

# scenes before the first statement; the error by first look is in docs/experiments/verdict-error.md
FIRST_LOOK = 20
# of the planned distance: scenes that are all alike show no spread, which is not the absence of one
LEAST_SPREAD = 0.25
NO_SPREAD = 1e-150  # its square is above 0


def log_evidence(draws: Draws, mean: F64 | float, plan: Plan, first_look: int = FIRST_LOOK) -> F64:
    """Return the log of the e-process ``(..., n)`` against "the mean is at most ``mean``"; -inf
    before the first look.

    Args:
        draws: The scenes; their bounds are not used.
        mean: ``(...)`` or one number.
        plan: Gives the line; the spread at the first look gives its slope, and is kept.
        first_look: Scenes before the first statement, at least 2.
    """
    n = np.arange(1, draws.n + 1)
    may_say, spread, slope = _looks(draws, plan, first_look)
    total = (
        np.cumsum(draws.x - draws.offset, axis=-1)
        - np.cumsum(draws.slope, axis=-1) * np.asarray(mean, dtype=np.float64)[..., None]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        z = _normal_of_t(total / (spread * np.sqrt(n)), draws.freedom)
    w = np.where(may_say, z * np.sqrt(n / plan.horizon), -np.inf)
    return line.log_evidence(w, n / plan.horizon, slope, plan.alpha)


def lower_bound(draws: Draws, plan: Plan, first_look: int = FIRST_LOOK) -> F64:
    """Return the greatest mean ``(...)`` that the scenes refute as too small, at any look so far;
    -inf before the first look.
    """
    may_say, spread, slope = _looks(draws, plan, first_look)
    if not may_say.any():
        return np.full(draws.x.shape[:-1], -np.inf)
    n = np.arange(1, draws.n + 1)
    z = (line.height(slope, plan.alpha) + slope * n / plan.horizon) * np.sqrt(plan.horizon / n)
    t = _t_of_normal(z, draws.freedom)
    lows = (np.cumsum(draws.x - draws.offset, axis=-1) - t * spread * np.sqrt(n)) / np.cumsum(
        draws.slope, axis=-1
    )
    return np.asarray(np.where(may_say, lows, -np.inf).max(axis=-1))


def _looks(draws: Draws, plan: Plan, first_look: int) -> tuple[Bool, F64, F64]:
    """Return where something may be said ``(n,)``, the standard deviation there ``(..., n)``, and
    the slope of the line ``(..., 1)``.
    """
    may_say = draws.is_end & (np.arange(1, draws.n + 1) >= first_look) & (draws.freedom >= 1.0)
    floor = LEAST_SPREAD * plan.distance if plan.distance is not None else NO_SPREAD
    spread = np.maximum(draws.spread, floor)
    at = int(np.argmax(may_say)) if may_say.any() else draws.n - 1
    return may_say, spread, plan.slope(spread[..., at : at + 1])


def _normal_of_t(t: F64, freedom: F64) -> F64:
    tail = scipy.special.stdtr(np.maximum(freedom, 1.0), -np.abs(t))
    return np.asarray(-np.sign(t) * scipy.special.ndtri(tail))


def _t_of_normal(z: F64, freedom: F64) -> F64:
    tail = scipy.special.ndtr(-np.abs(z))
    return np.asarray(-np.sign(z) * scipy.special.stdtrit(np.maximum(freedom, 1.0), tail))
