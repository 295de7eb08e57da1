"""E-processes and confidence sequences for means of bounded differences, by betting.

A gambler bets against "the mean is at most m": after every scene the capital is multiplied by 1 +
bet (x - m). Under the hypothesis the capital is a nonnegative supermartingale that starts at 1, so
the chance that it ever reaches 1 / alpha is at most alpha (Ville's inequality), at whatever scene
one stops. All m that are not refuted make the confidence sequence (Waudby-Smith and Ramdas,
Estimating means of bounded random variables by betting, JRSS B 86, 2024).

The bet is that of a test which stops at a line before the ceiling (`line.py`), as if scenes were
normal: from the capital so far, the scenes that are left, and the variance so far. It depends on
earlier scenes only, and is cut where it would risk more than `AT_RISK` of the capital, so the
guarantee holds for every distribution; only the speed depends on how normal scenes are.
"""

from __future__ import annotations

import math

import numpy as np

from alpasim_plugin.core.types import F64
from evaluators.statistics.sequential.draws import Draws
from evaluators.statistics.sequential.line import Plan, relative_slope

PRIOR_SCENES, PRIOR_WIDTH = (
    10.0,
    0.15,
)  # the first bets assume so many scenes with this standard deviation, as a share of the range
AT_RISK = 0.95  # of the capital, on one scene
HALVINGS = 32


def bet_sizes(draws: Draws, threshold: float, plan: Plan) -> F64:
    """Return the bet on every scene ``(..., n)``, from the scenes before its batch; it is the same
    on all scenes of a batch.

    The variance is the mean square about the threshold of the scenes so far, and of `PRIOR_SCENES`
    imagined ones with the standard deviation `PRIOR_WIDTH` times the range.
    """
    gain = draws.x - draws.offset - draws.slope * threshold
    half_range = 0.5 * (draws.high[..., :1] - draws.low[..., :1])
    imagined = PRIOR_SCENES * (2.0 * PRIOR_WIDTH * half_range) ** 2
    count = PRIOR_SCENES + draws.begin
    square = gain**2
    variance = (imagined + (np.cumsum(square, axis=-1) - square)[..., draws.begin]) / count
    fourth = (
        imagined * half_range**2 + (np.cumsum(square**2, axis=-1) - square**2)[..., draws.begin]
    ) / count
    spread, left = (
        np.sqrt(variance),
        np.sqrt(np.maximum(plan.horizon - draws.begin, 1) / plan.horizon),
    )
    slope, scale = plan.slope(spread) * left, spread * left * math.sqrt(plan.horizon)
    most = _most(gain + draws.low - draws.x)
    capital, bet = np.zeros(draws.x.shape[:-1]), np.zeros(draws.x.shape[:-1])
    bets = np.empty_like(gain)
    for i in range(draws.n):
        if draws.begin[i] == i:
            wanted = relative_slope(capital - plan.log_bar, slope[..., i]) / scale[..., i]
            bet = np.minimum(growing(wanted, fourth[..., i] / variance[..., i]), most[..., i])
        bets[..., i] = bet
        capital = capital + np.log1p(bet * gain[..., i])
    return bets


def growing(wanted: F64, tail: F64) -> F64:
    """Return the bet for jumps that grows the capital as ``wanted`` does for small steps: the root
    of bet + tail bet^3 = wanted.

    The mean growth of a bet on x is about bet E x - bet^2 E x^2 / 2 - bet^4 E x^4 / 4.

    Args:
        wanted: ``(...)`` bet without the last term.
        tail: ``(...)`` E x^4 / E x^2, above 0.

    Example:
        >>> float(growing(np.array(10.0), np.array(1.0)))
        2.0
    """
    half, third = 0.5 * wanted / tail, 1.0 / (3.0 * tail)
    root = np.sqrt(half**2 + third**3)
    return np.asarray(np.cbrt(half + root) - np.cbrt(root - half))


def log_capital(draws: Draws, mean: F64 | float, sizes: F64) -> F64:
    """Return the log of the capital ``(..., n)`` of one who bets that the mean is above ``mean``;
    -inf (nothing said) within a batch.

    It falls with ``mean``, for every course of the values. A mean that is impossible, since all
    scenes left could not make up for it, has an infinite capital against it.

    Args:
        draws: The scenes.
        mean: ``(...)`` or one number: the hypothesis is that the mean is at most this.
        sizes: From `bet_sizes`.
    """
    gain = draws.x - draws.offset - draws.slope * np.asarray(mean, dtype=np.float64)[..., None]
    lost = gain + draws.low - draws.x
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.where(lost > 0.0, np.inf, np.log1p(np.minimum(sizes, _most(lost)) * gain))
    return np.where(draws.is_end, np.cumsum(steps, axis=-1), -np.inf)


def _most(lost: F64) -> F64:
    """Return the largest bets, where ``lost`` is the least possible gain of one unit."""
    with np.errstate(divide="ignore"):
        return np.where(lost < 0.0, AT_RISK / np.abs(lost), np.inf)


def lower_bound(draws: Draws, sizes: F64, log_bar: float, least: float, most: float) -> F64:
    """Return the greatest mean ``(...)`` that the scenes refute as too small, at any scene so far;
    ``least`` where none is.

    Args:
        draws: The scenes.
        sizes: From `bet_sizes`.
        log_bar: Log of the capital that refutes.
        least: Least possible mean.
        most: Greatest possible mean.
    """
    shape = draws.x.shape[:-1]
    low, high = np.full(shape, least), np.full(shape, most)
    refuted = log_capital(draws, low, sizes).max(axis=-1) >= log_bar
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        is_out = log_capital(draws, middle, sizes).max(axis=-1) >= log_bar
        low, high = np.where(is_out, middle, low), np.where(is_out, high, middle)
    return np.asarray(np.where(refuted, low, least))
