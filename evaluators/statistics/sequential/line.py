"""How far the truth is expected from the threshold, and the capital of a test that stops where a
motion reaches a rising line.

The plan makes a decision fast, never wrong. Time runs from 0 to 1 at the ceiling, and the motion W
has variance 1 there. The test refutes "no drift" where W reaches ``height + slope * time``. The
chance of that, given W now, is a martingale; over alpha it begins at 1 and is 1 / alpha on the
line. So it is the e-process that spends all of alpha before the ceiling: far from it a bet on the
drift 2 slope (Wald's test), near it bolder where little is left. Wald's line with a ceiling needs
about as few scenes as any group-sequential test of equal power (docs/experiments/verdict-error.md).

Source: Siegmund, Sequential Analysis, 1985, equation 3.15 (first passage of Brownian motion to a
    line).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.types import F64

# Half of the distance that is bet on, in standard deviations of the sum over all scenes up to the
# ceiling. A test with a ceiling that is just large enough for 80 % power has 1.4; smaller bets gain
# nothing, whatever the plan.
USUAL_SLOPE, LEAST_SLOPE = 1.4, 1.0


@dataclass(frozen=True)
class Plan:
    """How large bets are.

    Attributes:
        distance: Expected distance of the true mean from the threshold, in the metric's unit; None:
            such that ``horizon`` just suffices.
        horizon: Most scenes that can be driven.
        alpha: Evidence of 1 / alpha is aimed at: the chance of a wrong decision, divided by the
            number of answers that share it.
    """

    distance: float | None
    horizon: int
    alpha: float

    @property
    def log_bar(self) -> float:
        """Give the log of the e-value that is aimed at: 1 / alpha."""
        return -math.log(self.alpha)

    def slope(self, spread: F64) -> F64:
        """Return the slope of the line that is bet on, for standard deviations of a scene of any
        shape.
        """
        if self.distance is None:
            return np.full_like(spread, USUAL_SLOPE)
        return np.asarray(
            np.maximum(LEAST_SLOPE, 0.5 * self.distance * math.sqrt(self.horizon) / spread)
        )


NEWTON_STEPS = 12
LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)
# The table of `relative_slope`: roots of -log chance (chances down to exp(-42)), and slopes.
ROOTS = np.linspace(0.0, 6.5, 131)
SLOPES = np.linspace(0.0, 10.0, 101)
GAPS = np.linspace(0.0, 10.0, 4001)


def log_chance(gap: F64, left: F64, slope: F64) -> F64:
    """Return the log of the chance that the line is reached, for a motion below it.

    Args:
        gap: ``(...)`` line less motion, now; at least 0.
        left: ``(...)`` time to the ceiling; 0: reached only where the gap is 0.
        slope: ``(...)`` of the line.

    Example:
        >>> round(float(np.exp(log_chance(np.array(1.0), np.array(1.0), np.array(0.0)))), 4)  # 2 Phi(-1)
        0.3173
    """
    root = np.sqrt(left)
    with np.errstate(divide="ignore", invalid="ignore"):
        below = scipy.special.log_ndtr(-(gap + slope * left) / root)
        beyond = scipy.special.log_ndtr((slope * left - gap) / root) - 2.0 * slope * gap
        found = np.minimum(np.logaddexp(below, beyond), 0.0)
    return np.where(left > 0.0, found, np.where(gap > 0.0, -np.inf, 0.0))


def log_rate(gap: F64, slope: F64) -> F64:
    """Return the log of how fast the chance falls with the gap, where the time left is 1."""
    at_line = math.log(2.0) - LOG_SQRT_2PI - 0.5 * (gap + slope) ** 2
    with np.errstate(divide="ignore"):
        drift = np.log(2.0 * slope) - 2.0 * slope * gap + scipy.special.log_ndtr(slope - gap)
    return np.asarray(np.logaddexp(at_line, drift))


def height(slope: F64, alpha: float) -> F64:
    """Return where lines of slopes ``(...)`` begin that are reached with the chance alpha.

    By Newton's method: the log chance is concave in the gap, so the steps come from above and
    cannot overshoot.
    """
    one = np.ones_like(slope, dtype=np.float64)
    gap = np.zeros_like(one)
    for _ in range(NEWTON_STEPS):
        log_p = log_chance(gap, one, slope)
        gap = gap + (log_p - math.log(alpha)) / np.exp(log_rate(gap, slope) - log_p)
    return gap


def log_evidence(w: F64, time: F64, slope: F64, alpha: float) -> F64:
    """Return the log of the chance over alpha, ``(..., n)``; once the line is reached, that of
    Wald's test, which goes on.

    Args:
        w: ``(..., n)`` the motion at every look; -inf before the first.
        time: ``(n,)`` of the looks, as shares of the ceiling.
        slope: ``(..., 1)`` of the line.
        alpha: Chance of reaching it.
    """
    gap = height(slope, alpha) + slope * time - w
    before = log_chance(np.maximum(gap, 0.0), np.maximum(1.0 - time, 0.0), slope)
    is_past = np.maximum.accumulate(gap <= 0.0, axis=-1)
    return np.asarray(np.where(is_past, -2.0 * slope * gap, before) - math.log(alpha))


@cache
def _table() -> F64:
    """Return the log of `relative_slope` by slope and root of -log chance, ``(101, 131)``."""
    rows = []
    for slope in SLOPES:
        log_p = log_chance(GAPS, np.ones_like(GAPS), slope)
        rows.append(np.interp(ROOTS, np.sqrt(-log_p), log_rate(GAPS, slope) - log_p))
    return np.array(rows)


def relative_slope(log_p: F64, slope: F64) -> F64:
    """Return how fast the chance grows with the motion, relative to itself, where the time left is
    1: d log chance / d W.

    With another time left, give ``slope * sqrt(left)`` and divide the result by ``sqrt(left)``.
    Past the line it is that of Wald's test.

    Args:
        log_p: ``(...)`` log of the chance now.
        slope: ``(...)`` of the line.
    """
    table = _table()
    column = np.minimum(np.sqrt(np.maximum(-log_p, 0.0)) / ROOTS[1], len(ROOTS) - 1.001)
    row = np.minimum(slope / SLOPES[1], len(SLOPES) - 1.001)
    i, j = row.astype(np.int64), column.astype(np.int64)
    f, g = row - i, column - j
    found = (1 - f) * ((1 - g) * table[i, j] + g * table[i, j + 1]) + f * (
        (1 - g) * table[i + 1, j] + g * table[i + 1, j + 1]
    )
    beyond = 2.0 * np.maximum(
        slope - SLOPES[-1], 0.0
    )  # far from the ceiling the chance is exp(-2 slope gap)
    return np.asarray(np.where(log_p >= 0.0, 2.0 * slope, np.exp(found) + beyond))
