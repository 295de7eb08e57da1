"""Group-sequential designs, as clinical trials use them: five looks at fixed shares of the ceiling,
between which the error is divided.

The share of alpha that is spent by time t is that of Lan and DeMets (Discrete sequential boundaries
for clinical trials, Biometrika 70, 1983), near the bounds of O'Brien and Fleming or of Pocock. The
bounds come from the recursion of Armitage, McPherson and Rowe (Repeated significance tests on
accumulating data, JRSS A 132, 1969). A test that refutes at level a is the e-value 1 / a where it
refutes, else 0. Sums are taken for normal: fast for rates with many changes, wrong where few scenes
are far worse (docs/sequential.md).
"""

from __future__ import annotations

import math
from functools import cache
from typing import Literal

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.types import F64, I64
from evaluators.statistics.sequential.draws import Draws
from evaluators.statistics.sequential.line import Plan

Spending = Literal["obrien-fleming", "pocock"]
LOOKS = 5
GRID, LOWEST = (
    601,
    -9.0,
)  # of the motion before a look; the motion's standard deviation at the ceiling is 1


def spent(alpha: float, t: float, spending: Spending) -> float:
    """Return how much of a one-sided ``alpha`` is spent by the share ``t`` of the ceiling, 0 < t <=
    1.
    """
    if spending == "pocock":
        return alpha * math.log(1.0 + (math.e - 1.0) * t)
    return float(2.0 * scipy.special.ndtr(scipy.special.ndtri(alpha / 2.0) / math.sqrt(t)))


@cache
def boundaries(alpha: float, times: tuple[float, ...], spending: Spending) -> tuple[float, ...]:
    """Return the z values at which a one-sided test refutes, at looks at shares of the ceiling.

    Example:
        >>> [round(z, 2) for z in boundaries(0.025, (0.2, 0.4, 0.6, 0.8, 1.0), "obrien-fleming")]
        [4.88, 3.36, 2.68, 2.29, 2.03]
    """
    x = np.zeros(1)
    weight = np.ones(1)
    before = 0.0
    used = 0.0
    out = []
    for t in times:
        step, may = math.sqrt(t - before), spent(alpha, t, spending) - used

        def over(
            bound: float, x: F64 = x, weight: F64 = weight, step: float = step, may: float = may
        ) -> float:
            return float(weight @ scipy.special.ndtr((x - bound) / step)) - may

        bound = float(scipy.optimize.brentq(over, LOWEST, 12.0))
        out.append(bound / math.sqrt(t))
        y = np.linspace(LOWEST * math.sqrt(t), bound, GRID)
        density = (
            np.exp(-0.5 * ((y[:, None] - x) / step) ** 2)
            @ weight
            / (step * math.sqrt(2.0 * math.pi))
        )
        x = y
        weight = density * np.gradient(y)
        before = t
        used = used + may
        weight[[0, -1]] /= 2.0
    return tuple(out)


def _looks(draws: Draws, plan: Plan, spending: Spending) -> tuple[I64, F64]:
    """Return after which scenes ``(L,)`` one looks, of those driven, and the bounds there as t
    values.
    """
    at = np.unique(np.ceil(plan.horizon * np.arange(1, LOOKS + 1) / LOOKS).astype(np.int64))
    at = at[at >= 3]  # fewer scenes have no spread to speak of
    z = np.array(boundaries(plan.alpha, tuple((at / plan.horizon).tolist()), spending))
    seen = at <= draws.n
    at, z = at[seen], z[seen]
    tail = scipy.special.ndtr(-z)
    return at, np.asarray(-scipy.special.stdtrit(np.maximum(draws.freedom[at - 1], 1.0), tail))


def log_evidence(draws: Draws, mean: float, plan: Plan, spending: Spending) -> F64:
    """Return the log of the e-process ``(n,)`` against "the mean is at most ``mean``": log 1 /
    alpha from the look that refutes it.
    """
    at, bounds = _looks(draws, plan, spending)
    total = np.cumsum(draws.x - draws.offset) - np.cumsum(draws.slope) * mean
    out = np.full(draws.n, -np.inf)
    for k, bound in zip(at.tolist(), bounds.tolist(), strict=True):
        if total[k - 1] > 0 and total[k - 1] >= bound * draws.spread[k - 1] * math.sqrt(k):
            out[k - 1 :] = plan.log_bar
            break
    return out


def lower_bound(draws: Draws, plan: Plan, spending: Spending) -> float:
    """Return the greatest mean that some look so far refutes as too small; -inf before the first
    look.
    """
    at, bounds = _looks(draws, plan, spending)
    total, slope = np.cumsum(draws.x - draws.offset), np.cumsum(draws.slope)
    lows = (total[at - 1] - bounds * draws.spread[at - 1] * np.sqrt(at)) / slope[at - 1]
    return float(lows.max(initial=-np.inf))
