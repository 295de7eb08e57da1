"""E-processes and confidence sequences for means of bounded differences, by betting.

A gambler bets against "the mean is at most m": after every scene the capital is multiplied by 1 + bet (x - m). Under the hypothesis the
capital is a nonnegative supermartingale that starts at 1, so the chance that it ever reaches 1 / alpha is at most alpha (Ville's
inequality), at whatever scene one stops. All m that are not refuted make the confidence sequence (Waudby-Smith and Ramdas, Estimating
means of bounded random variables by betting, JRSS B 86, 2024). The capital is shared among bets of several sizes (`plan.MIXTURE`). A bet
depends on earlier scenes only. It is cut where it would risk more than its limit, so the capital never reaches 0.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.types import F64
from evaluators.sequential.draws import Draws
from evaluators.sequential.plan import AT_RISK, LOG_SHARES, MULTIPLES, Plan

PRIOR_SCENES, PRIOR_WIDTH = 10.0, 0.15  # the first bets assume so many scenes with this standard deviation, as a share of the range
HALVINGS = 32


def bet_sizes(draws: Draws, threshold: float, plan: Plan) -> F64:
    """Return the planned bet on every scene ``(..., n)``, from the scenes before it.

    The variance is the mean square about the threshold of the scenes so far, and of `PRIOR_SCENES` imagined ones with the standard
    deviation `PRIOR_WIDTH` times the range.
    """
    square = (draws.x - draws.offset - draws.slope * threshold) ** 2
    imagined = PRIOR_SCENES * (PRIOR_WIDTH * (draws.high[..., :1] - draws.low[..., :1])) ** 2
    before = imagined + np.cumsum(square, axis=-1) - square
    return plan.rate(before / (PRIOR_SCENES + np.arange(draws.n)))


def log_capital(draws: Draws, mean: F64 | float, sizes: F64) -> F64:
    """Return the log of the capital ``(..., n)`` after every scene of one who bets that the mean is above ``mean``.

    It falls with ``mean``, for every course of the values. A mean that is impossible, since all scenes left could not make up for it, has
    an infinite capital against it.

    Args:
        draws: The scenes.
        mean: ``(...)`` or one number: the hypothesis is that the mean is at most this.
        sizes: From `bet_sizes`.
    """
    centre = draws.offset + draws.slope * np.asarray(mean, dtype=np.float64)[..., None]
    room = centre - draws.low
    gain = draws.x - centre
    with np.errstate(divide="ignore", invalid="ignore"):
        most = np.where(room > 0.0, 1.0 / room, np.inf)
        bets = [np.minimum(multiple * sizes, risk * most) for multiple, risk in zip(MULTIPLES, AT_RISK, strict=True)]
        logs = [np.where(room < 0.0, np.inf, np.log1p(bet * gain)) for bet in bets]
    paths = np.cumsum(np.stack(logs), axis=-1)
    return np.asarray(np.logaddexp.reduce(paths + LOG_SHARES.reshape(-1, *[1] * draws.x.ndim), axis=0))


def lower_bound(draws: Draws, sizes: F64, log_bar: float, least: float, most: float) -> F64:
    """Return the greatest mean ``(...)`` that the scenes refute as too small, at any scene so far; ``least`` where none is.

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
