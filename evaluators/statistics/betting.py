"""E-processes and confidence sequences for means of bounded differences, by betting.

A gambler bets against "the mean is at most m": after every scene the capital is multiplied by 1 +
bet (x - m). Under the hypothesis the capital is a nonnegative supermartingale that starts at 1, so
the probability that it ever reaches 1 / alpha is at most alpha (Ville's inequality), at whatever
scene one stops. All m that are not refuted make the confidence sequence.

The size of the bets decides how fast a decision falls, never whether it is right. They are those
of a test that stops where a Brownian motion W reaches the line ``height + slope * time`` before
the ceiling (time 1). The probability of that, given W now, is a martingale; divided by alpha it
begins at 1 and is 1 / alpha on the line, so it is an e-process that spends all of alpha before the
ceiling. A bet follows its derivative, as if scenes were normal, from the capital, the scenes left
and the variance so far; it never risks more than `AT_RISK` of the capital.

Sources: Waudby-Smith and Ramdas, Estimating means of bounded random variables by betting, JRSS B
    86, 2024; Siegmund, Sequential Analysis, 1985, equation 3.15
    (first passage of Brownian motion to a line).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.types import F64

# Half of the distance that is bet on, in standard deviations of the sum over all scenes up to the
# ceiling. A test with a ceiling that is just large enough for 80 % power has 1.4.
USUAL_SLOPE = 1.4
LEAST_SLOPE = 1.0
# The first bets assume so many scenes with this standard deviation, as a share of the range.
PRIOR_SCENES = 10.0
PRIOR_WIDTH = 0.15
AT_RISK = 0.95  # of the capital, on one scene
HALVINGS = 32
NEWTON_STEPS = 3  # leave an error of 1e-7
LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class Draws:
    """Differences of scenes in the order drawn.

    Attributes:
        x: ``(..., n)`` differences between ``-reach`` and ``reach``, positive is worse.
        reach: Greatest possible size of a difference.
    """

    x: F64
    reach: float

    @property
    def n(self) -> int:
        """Give the number of scenes."""
        return int(self.x.shape[-1])

    def mirrored(self) -> Draws:
        """Return the draws of the negated difference."""
        return Draws(-self.x, self.reach)


@dataclass(frozen=True)
class Plan:
    """How large bets are.

    Attributes:
        distance: Expected distance of the true mean from the threshold, in the metric's unit; None:
            such that ``horizon`` just suffices.
        horizon: Most scenes that can be driven.
        alpha: Evidence of 1 / alpha is aimed at: the probability of a wrong decision, divided by
            the number of answers that share it.
    """

    distance: float | None
    horizon: int
    alpha: float

    @property
    def log_bar(self) -> float:
        """Give the log of the e-value that is aimed at: 1 / alpha."""
        return -math.log(self.alpha)

    def slope(self, spread: F64) -> F64:
        """Return the slope of the line that is bet on, for standard deviations of any shape."""
        if self.distance is None:
            return np.full_like(spread, USUAL_SLOPE)
        slope = 0.5 * self.distance * math.sqrt(self.horizon) / spread
        return np.maximum(LEAST_SLOPE, slope)


def log_chance(gap: F64, slope: F64) -> F64:
    """Return the log of the probability that a motion with unit time left reaches the line.

    Args:
        gap: ``(...)`` line less motion, now; at least 0.
        slope: ``(...)`` of the line.

    Example:
        >>> round(float(np.exp(log_chance(np.array(1.0), np.array(0.0)))), 4)  # 2 Phi(-1)
        0.3173
    """
    below = scipy.special.log_ndtr(-(gap + slope))
    beyond = scipy.special.log_ndtr(slope - gap) - 2.0 * slope * gap
    return np.minimum(np.logaddexp(below, beyond), 0.0)


def relative_slope(log_p: F64, slope: F64) -> F64:
    """Return the derivative of `log_chance` by the motion, where its value is ``log_p``.

    With another time left, give ``slope * sqrt(left)`` and divide the result by ``sqrt(left)``.
    Past the line it is that of Wald's test. The gap is found by Newton's method: `log_chance` is
    concave in it, and both bounds where the steps begin lie beyond the root, so none overshoots.

    Args:
        log_p: ``(...)`` log of the probability now.
        slope: ``(...)`` of the line.
    """
    target = np.minimum(log_p, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        drift_only = np.where(slope > 0.0, -target / (2.0 * slope), np.inf)
        gap = np.minimum(-scipy.special.ndtri_exp(target - math.log(2.0)), drift_only)
    for _ in range(NEWTON_STEPS):
        value = log_chance(gap, slope)
        gap = np.maximum(gap + (value - target) / _steepness(gap, slope, value), 0.0)
    derivative = _steepness(gap, slope, log_chance(gap, slope))
    return np.where(log_p >= 0.0, 2.0 * slope, derivative)


def _steepness(gap: F64, slope: F64, log_p: F64) -> F64:
    """Return how fast `log_chance`, whose value is ``log_p``, falls with the gap."""
    at_line = math.log(2.0) - LOG_SQRT_2PI - 0.5 * (gap + slope) ** 2
    with np.errstate(divide="ignore"):
        drift = np.log(2.0 * slope) - 2.0 * slope * gap + scipy.special.log_ndtr(slope - gap)
    return np.exp(np.logaddexp(at_line, drift) - log_p)


def bet_sizes(draws: Draws, threshold: float, plan: Plan) -> F64:
    """Return the bet on every scene ``(..., n)``, from the scenes before it.

    The variance is the mean square about the threshold of the scenes so far, and of `PRIOR_SCENES`
    imagined ones with the standard deviation `PRIOR_WIDTH` times the range.
    """
    gain = draws.x - threshold
    square = gain**2
    scenes_before = np.arange(draws.n)
    imagined = PRIOR_SCENES * (2.0 * PRIOR_WIDTH * draws.reach) ** 2
    count = PRIOR_SCENES + scenes_before
    variance = (imagined + np.cumsum(square, axis=-1) - square) / count
    fourth_prior = imagined * draws.reach**2
    fourth = (fourth_prior + np.cumsum(square**2, axis=-1) - square**2) / count
    spread = np.sqrt(variance)
    root_left = np.sqrt(np.maximum(plan.horizon - scenes_before, 1) / plan.horizon)
    slope = plan.slope(spread) * root_left
    scale = spread * root_left * math.sqrt(plan.horizon)
    limit = _largest_bets(np.array(-draws.reach - threshold))
    capital = np.zeros(draws.x.shape[:-1])
    bets = np.empty_like(gain)
    for i in range(draws.n):
        wanted = relative_slope(capital - plan.log_bar, slope[..., i]) / scale[..., i]
        bet = np.minimum(growing(wanted, fourth[..., i] / variance[..., i]), limit)
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
        >>> round(float(growing(np.array(10.0), np.array(1.0))), 9)
        2.0
    """
    half = 0.5 * wanted / tail
    third = 1.0 / (3.0 * tail)
    root = np.sqrt(half**2 + third**3)
    return np.cbrt(half + root) - np.cbrt(root - half)


def log_capital(draws: Draws, mean: F64 | float, sizes: F64) -> F64:
    """Return the log of the capital ``(..., n)`` of one who bets that the mean is above ``mean``.

    It falls with ``mean``, for every course of the values. Below ``-reach``, which no mean can be,
    it is infinite.

    Args:
        draws: The scenes.
        mean: ``(...)`` or one number: the hypothesis is that the mean is at most this.
        sizes: From `bet_sizes`.
    """
    center = np.asarray(mean, dtype=np.float64)[..., None]
    least_gain = -draws.reach - center
    with np.errstate(divide="ignore", invalid="ignore"):
        growth = np.log1p(np.minimum(sizes, _largest_bets(least_gain)) * (draws.x - center))
    return np.cumsum(np.where(least_gain > 0.0, np.inf, growth), axis=-1)


def _largest_bets(least_gain: F64) -> F64:
    """Return the largest bets, from the least possible gain of one unit."""
    with np.errstate(divide="ignore"):
        return np.where(least_gain < 0.0, AT_RISK / np.abs(least_gain), np.inf)


def lower_bound(draws: Draws, sizes: F64, log_bar: float) -> F64:
    """Return the greatest mean ``(...)`` that the scenes refute as too small, at any scene so far;
    ``-reach`` where none is.

    Args:
        draws: The scenes.
        sizes: From `bet_sizes`.
        log_bar: Log of the capital that refutes.
    """
    low = np.full(draws.x.shape[:-1], -draws.reach)
    high = -low
    is_any_refuted = log_capital(draws, low, sizes).max(axis=-1) >= log_bar
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        is_refuted = log_capital(draws, middle, sizes).max(axis=-1) >= log_bar
        low = np.where(is_refuted, middle, low)
        high = np.where(is_refuted, high, middle)
    return np.where(is_any_refuted, low, -draws.reach)
