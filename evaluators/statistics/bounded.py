"""Bounds of a mean whose values have a least and a greatest possible one: they hold where a few
scenes go very wrong and none was drawn.

A t interval knows only the spread that it saw. If one of forty scenes goes wrong by 4 m, the mean
is 0.1 m worse, and of twenty scenes three in five draws show none of it. The bound of Gaffke takes
the worst value that is possible for a scene that was not drawn: it is the 97.5 % quantile of the
weighted mean of the values and of that one, with random weights that are uniform on the simplex. Of
0 and 1 it is the bound of Clopper and Pearson, of n values that are all alike it is the rule of
three, of many it is the normal one. That it is too low in 2.5 % of draws at most is proved for two
values; for others no exception is known, and docs/experiments/verdict-error.md found none.

Source: Gaffke, Three test statistics for a nonparametric one-sided hypothesis on the mean of a
    nonnegative variable, Mathematical Methods
of Statistics 14, 2005; Learned-Miller and Thomas, A new confidence interval for the mean of a
bounded random variable, arXiv:1905.06208.
"""

import math

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import F64, MetricInfo
from evaluators.statistics.intervals import (
    TAIL,
    Interval,
    mean_of,
    t_interval,
    within,
)

# The integral is taken over the logarithm of the frequency, in units of 1 / norm of the
# coefficients.
STEP = 0.05
FREQUENCIES = np.exp(np.arange(math.log(1e-5), math.log(1e3), STEP))
TOLERANCE = 1e-9  # of a bound, as a share of the range
BINS = 256
NO_BOUNDS = "nothing says how far a scene that was not driven can lie"


def chance_above(values: F64, counts: F64, mean: float) -> float:
    """Return the chance that the weighted mean of values ``(k,)`` with counts is at least ``mean``.

    With weights E_i / sum E of independent exponential E_i it is the chance that sum E_i (x_i -
    mean) is at least 0, which Gil-Pelaez' inversion of the characteristic function gives. It is a
    p-value against "the mean is at least ``mean``".

    Example:
        >>> round(chance_above(np.array([0.0, 1.0]), np.array([72.0, 1.0]), 0.05), 4)  # 0.95^72
        0.0249
    """
    parts = values - mean
    if parts[-1] <= 0.0 or parts[0] >= 0.0:
        return float(parts[0] >= 0.0)
    angles = FREQUENCIES[:, None] * (parts / math.sqrt(float(counts @ parts**2)))
    turned = np.arctan(angles) @ counts
    fading = 0.5 * (np.log1p(angles**2) @ counts)
    # The first term is what lies below the least frequency, where the integrand is linear.
    total = STEP * (
        float(np.sum(np.sin(turned) * np.exp(-fading))) + (1.0 / STEP - 0.5) * float(turned[0])
    )
    return min(max(0.5 + total / math.pi, 0.0), 1.0)


def upper_bound(values: F64, most: float) -> float:
    """Return the greatest mean that the values ``(n,)`` do not refute.

    Args:
        values: None above ``most``.
        most: The greatest possible value.

    Example:
        >>> round(upper_bound(np.zeros(10), 1.0), 4)  # Clopper-Pearson of 0 in 10
        0.3085
    """
    scale = _scale(values, most)
    if scale == 0.0:
        return most
    distinct, counts = _with_worst(values, most, scale)
    low = float(np.mean(np.asarray(values) / scale))
    if low >= distinct[-1]:
        return most
    root = scipy.optimize.brentq(
        lambda mean: chance_above(distinct, counts, mean) - TAIL, low, distinct[-1], xtol=TOLERANCE
    )
    return min(scale * float(root), most)


def chance_of_mean(values: F64, most: float, mean: float) -> float:
    """Return a p-value against "the mean is at least ``mean``"; at 2.5 % it agrees with
    `upper_bound`.

    Args:
        values: ``(n,)`` independent values, none above ``most``.
        most: The greatest possible value.
        mean: The hypothesis.

    Example:
        >>> round(chance_of_mean(np.zeros(36), 1.0, 0.1), 4)  # 0.9^36
        0.0225
    """
    scale = _scale(values, most)
    if scale == 0.0:
        return float(mean <= 0.0)
    return chance_above(*_with_worst(values, most, scale), mean / scale)


def _scale(values: F64, most: float) -> float:
    """Return the largest size of the values and of the greatest possible one."""
    return max(float(np.max(np.abs(values))), abs(most))


def _with_worst(values: F64, most: float, scale: float) -> tuple[F64, F64]:
    """Return the different values, divided by ``scale``, with the worst as one more, and their
    counts.

    Many are put into bins that keep their mean: one between two edges counts in shares for both,
    which widens the bounds and never narrows.
    """
    distinct, whole_counts = np.unique(
        np.append(np.asarray(values, dtype=np.float64) / scale, most / scale), return_counts=True
    )
    counts = whole_counts.astype(np.float64)
    if len(distinct) <= BINS:
        return distinct, counts
    edges = np.linspace(distinct[0], distinct[-2], BINS)
    place = (distinct[:-1] - edges[0]) / (edges[1] - edges[0])
    left = np.minimum(place.astype(np.int64), BINS - 2)
    share = place - left
    filled = np.bincount(left, (1.0 - share) * counts[:-1], BINS) + np.bincount(
        left + 1, share * counts[:-1], BINS
    )
    return np.append(edges, distinct[-1]), np.append(filled, counts[-1])


def mean_bounds(values: F64, least: float, most: float) -> tuple[float, float]:
    """Return the 95 % bounds of a mean from independent ``(n,)`` values that lie between ``least``
    and ``most``.

    Example:
        >>> [round(bound, 3) for bound in mean_bounds(np.array([0.0] * 57 + [1.0] * 3), -1.0, 1.0)]
        [-0.026, 0.139]
    """
    x = np.clip(np.asarray(values, dtype=np.float64), least, most)
    return -upper_bound(-x, -least), upper_bound(x, most)


def rate_interval(means: F64) -> Interval:
    """Return the interval of a rate from the rate of each scene ``(G,)``: `mean_bounds` within [0,
    1]; never without width.

    With one seed a scene it is that of Clopper and Pearson. With several it allows for scenes that
    always have the event and were not drawn, which the spread between scenes does not show.

    Raises:
        EvaluatorError: A value outside [0, 1].
    """
    n = len(means)
    p = float(np.mean(means))
    if means.min() < 0.0 or means.max() > 1.0:
        raise EvaluatorError(
            f"{n} scene means: values from {means.min():g} to {means.max():g}",
            "give rates as fractions in [0, 1]",
        )
    if n < 2:
        return Interval(p, reason=f"needs at least two scenes, found {n}")
    return Interval(p, *mean_bounds(means, 0.0, 1.0), method="mean of scenes from 0 to 1")


def mean_interval(means: F64, metric: MetricInfo) -> Interval:
    """Return the interval of a metric's mean from the mean of each scene ``(G,)``; never without
    width.

    Rates take `rate_interval`, other quantities with bounds `mean_bounds`. Where a metric counts up
    to a cap (`MetricInfo.cap`), what was not drawn may lie there: the interval holds the one of t
    and `mean_bounds` of the values cut to the cap. All others have none: Student's knows only the
    spread of the scenes that were drawn, and misses the mean where a few others lie far away.
    """
    n = len(means)
    centre = mean_of(means)
    least, most = metric.value_range
    if metric.is_flag:
        return rate_interval(means)
    reach = metric.cap if metric.cap is not None else most
    if n < 2:
        return Interval(centre, reason=f"needs at least two scenes, found {n}")
    if not math.isfinite(reach):
        return Interval(centre, reason=NO_BOUNDS)
    low, high = mean_bounds(means, least if math.isfinite(least) else -reach, reach)
    method = f"mean of scenes up to {reach:g} {metric.unit}".rstrip()
    if metric.cap is not None:
        not_cut = t_interval(means, "scenes").bounds or [centre]
        low = min(low, *not_cut)
        high = max(high, *not_cut)
    return within(Interval(centre, low, high, method=method), least, most)
