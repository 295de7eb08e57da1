"""Asymptotic e-processes and confidence sequences for means of differences without bounds.

Sums of many scenes behave like a Brownian motion with the variance of a scene, at all numbers of scenes at once (strong approximation).
A mixture of likelihood ratios of Brownian motions is a martingale, which gives bounds that hold at every look once the first look is late
enough (Waudby-Smith, Arbour, Sinha, Kennedy and Ramdas, Time-uniform central limit theory and asymptotic confidence sequences, Annals of
Statistics 52, 2024). The guarantee is approximate, as that of a t interval is. Two things keep it honest with few scenes: the t statistic
of n scenes is mapped to the normal value of equal probability, and nothing is said before the first look.
"""

from __future__ import annotations

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.types import F64, I64
from evaluators.sequential.draws import Draws
from evaluators.sequential.plan import LOG_SHARES as SHARES_OF_BETS
from evaluators.sequential.plan import MULTIPLES as BETS
from evaluators.sequential.plan import Plan

FIRST_LOOK = 20  # scenes before the first statement; the error by first look is in docs/experiments/sequential.md
LEAST_SPREAD = 0.25  # of the planned distance: scenes that are all alike show no spread, which is not the absence of one
NO_SPREAD = 1e-150  # its square is above 0
HALVINGS = 60
# The largest bet is for bounded differences that hardly ever occur; here the others share what it would begin with.
MULTIPLES = BETS[:-1]
LOG_SHARES = SHARES_OF_BETS[:-1] - np.logaddexp.reduce(SHARES_OF_BETS[:-1])


def log_evidence(draws: Draws, mean: F64 | float, plan: Plan, first_look: int = FIRST_LOOK) -> F64:
    """Return the log of the e-process ``(..., n)`` against "the mean is at most ``mean``"; -inf before the first look.

    Args:
        draws: The scenes; their bounds are not used.
        mean: ``(...)`` or one number.
        plan: Where the mixture is centred; the spread at the first look gives it its scale, and is kept.
        first_look: Scenes before the first statement, at least 2.
    """
    n = np.arange(1, draws.n + 1)
    spread, rate = _scales(draws, plan, first_look)
    total = np.cumsum(draws.x - draws.offset, axis=-1) - np.cumsum(draws.slope, axis=-1) * np.asarray(mean, dtype=np.float64)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = _normal_of_t(total / (spread * np.sqrt(n)), n)
    return np.where(n >= first_look, _log_mixture(z, rate, n), -np.inf)


def lower_bound(draws: Draws, plan: Plan, first_look: int = FIRST_LOOK) -> F64:
    """Return the greatest mean ``(...)`` that the scenes refute as too small, at any look so far; -inf before the first look."""
    if draws.n < first_look:
        return np.full(draws.x.shape[:-1], -np.inf)
    n = np.arange(1, draws.n + 1)
    spread, rate = _scales(draws, plan, first_look)
    bar = _bar(rate, n, plan.log_bar)
    t = _t_of_normal(bar, n)
    lows = (np.cumsum(draws.x - draws.offset, axis=-1) - t * spread * np.sqrt(n)) / np.cumsum(draws.slope, axis=-1)
    return np.asarray(np.where(n >= first_look, lows, -np.inf).max(axis=-1))


def _scales(draws: Draws, plan: Plan, first_look: int) -> tuple[F64, F64]:
    """Return the standard deviation after every scene ``(..., n)``, and the rate of the mixture ``(..., 1)``."""
    n = np.arange(1, draws.n + 1)
    # About the first value: sums of squares of large values that hardly differ would lose all digits.
    x = draws.x - draws.x[..., :1]
    square = np.cumsum(x * x, axis=-1) - np.cumsum(x, axis=-1) ** 2 / n
    spread = np.sqrt(np.maximum(square, 0.0) / np.maximum(n - 1, 1))
    floor = LEAST_SPREAD * plan.distance if plan.distance is not None else NO_SPREAD
    spread = np.maximum(spread, floor)
    at = min(first_look, draws.n) - 1
    scale = spread[..., at : at + 1]
    return spread, plan.rate(scale**2) * scale


def _log_mixture(z: F64, rate: F64, n: I64) -> F64:
    """Return the log of the mixture of likelihood ratios of a Brownian motion at z sqrt(n)."""
    with np.errstate(invalid="ignore"):
        slopes = [multiple * rate * np.sqrt(n) for multiple in MULTIPLES]
        logs = [share + slope * z - 0.5 * slope**2 for slope, share in zip(slopes, LOG_SHARES, strict=True)]
    return np.asarray(np.logaddexp.reduce(np.stack(logs), axis=0))


def _bar(rate: F64, n: I64, log_bar: float) -> F64:
    """Return the z ``(..., n)`` at which the mixture reaches the bar."""
    shape = np.broadcast_shapes(rate.shape, n.shape)
    low, high = np.full(shape, -100.0), np.full(shape, 100.0)
    # One rate alone reaches the bar at (log_bar - log share) / (rate sqrt n) + rate sqrt n / 2: no z above the least of them is needed.
    for multiple, share in zip(MULTIPLES, LOG_SHARES, strict=True):
        slope = multiple * rate * np.sqrt(n)
        high = np.minimum(high, (log_bar - share) / slope + 0.5 * slope)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        is_over = _log_mixture(middle, rate, n) >= log_bar
        low, high = np.where(is_over, low, middle), np.where(is_over, middle, high)
    return high


def _normal_of_t(t: F64, n: I64) -> F64:
    tail = scipy.special.stdtr(np.maximum(n - 1, 1), -np.abs(t))
    return np.asarray(-np.sign(t) * scipy.special.ndtri(tail))


def _t_of_normal(z: F64, n: I64) -> F64:
    tail = scipy.special.ndtr(-np.abs(z))
    return np.asarray(-np.sign(z) * scipy.special.stdtrit(np.maximum(n - 1, 1), tail))
