"""Intervals of a mean over rollouts, at 95 %.

`normal_half_width` is the paper's formula. It treats the seeds of one scene as independent, which
makes it too short where scenes differ; `clustered` takes the scene as the unit. A quantity that
does not exist is None and comes with a reason. The measured coverage of each is in
docs/experiments/verdict-error.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy  # its submodules load on first use; scipy.stats would take a second

from alpasim_plugin.core.types import F64, I64, Bool

Z95 = 1.96
LEVEL = 0.95
TAIL = (1 - LEVEL) / 2
RATE_LEVEL = 0.95  # one-sided, of the largest rate that counts leave open
ROUNDING = 1e-12  # values that differ by no more than this, relative, are equal
TOO_LARGE = "the values are too large for their spread to be a number"
# the squares of larger values are no numbers, and those of their inverses lose their digits
LARGE = 1e150
NO_SPREAD = "all {} {} are equal: a sample without spread has no interval"
LEAST_SCENES = 6  # the fewest that can reach p < 0.05 in the two-sided sign test
FEW_SCENES = 10  # below, counts and exact methods come first


@dataclass(frozen=True)
class Interval:
    """A centre with bounds; bounds are None where they do not exist, and ``reason`` then says why.
    ``note`` qualifies bounds that exist.
    """

    centre: float
    low: float | None = None
    high: float | None = None
    reason: str = ""
    note: str = ""
    method: str = ""

    @property
    def bounds(self) -> list[float] | None:
        """Give [low, high] or None."""
        return None if self.low is None or self.high is None else [self.low, self.high]


def within(interval: Interval, low: float, high: float) -> Interval:
    """Cut an interval to the values that are possible; what it covers does not change, since
    nothing true lies outside.

    Example:
        >>> within(Interval(0.97, 0.66, 1.28), 0.0, 1.0).bounds
        [0.66, 1.0]
    """
    if interval.low is None or interval.high is None:
        return interval
    return replace(
        interval, low=min(max(interval.low, low), high), high=max(min(interval.high, high), low)
    )


def are_alike(values: F64) -> Bool:
    """Tell whether the values on the last axis of ``(..., n)`` are equal but for rounding."""
    return np.ptp(values, axis=-1) <= ROUNDING * np.max(np.abs(values), axis=-1)


def normal_half_width(values: npt.ArrayLike) -> tuple[float | None, str]:
    """Return 1.96 s / sqrt(N) with the sample standard deviation s of ``(N,)`` values (paper,
    appendix), and why it is missing.

    Example:
        >>> round(normal_half_width([0.0, 0.0, 1.0, 1.0])[0], 4)
        0.5658
        >>> normal_half_width([1.0])
        (None, 'one rollout has no spread')
    """
    x = np.asarray(values, dtype=np.float64)
    if len(x) < 2:
        return None, "one rollout has no spread"
    half = scaled(x)[1] * Z95 * float(np.std(scaled(x)[0], ddof=1)) / float(np.sqrt(len(x)))
    return (half, "") if np.isfinite(half) else (None, TOO_LARGE)


def scaled(values: F64) -> tuple[F64, float]:
    """Return values whose squares are finite and, of their spread, not lost; and what to multiply
    with: 1 but for extreme values.
    """
    most = float(np.max(np.abs(values), initial=0.0))
    scale = 1.0 if most == 0 or 1 / LARGE <= most <= LARGE else most
    return values / scale, scale


def mean_of(values: F64) -> float:
    """Return the mean of ``(n,)`` values, also where their sum is no number."""
    x, scale = scaled(values)
    return float(np.mean(x)) * scale


def t_interval(values: npt.ArrayLike, unit: str = "values") -> Interval:
    """Return mean and t interval of independent ``(n,)`` values.

    Example:
        >>> interval = t_interval([1.0, 2.0, 3.0])
        >>> round(interval.low, 4), round(interval.high, 4)
        (-0.4841, 4.4841)
    """
    x, scale = scaled(np.asarray(values, dtype=np.float64))
    centre = float(np.mean(x)) * scale
    if len(x) < 2:
        return Interval(centre, reason=f"needs at least two {unit}, found {len(x)}")
    if are_alike(x):
        return Interval(centre, reason=NO_SPREAD.format(len(x), unit))
    half = t_half_width(float(np.std(x, ddof=1)), len(x))
    low = centre - half * scale
    high = centre + half * scale
    if not np.isfinite([low, high]).all():
        return Interval(centre, reason=TOO_LARGE)
    return Interval(centre, low, high, method=f"t on {unit}")


def t_half_width(spread: float, n: int) -> float:
    """Return the half-width of Student's interval of ``n`` values with a standard deviation."""
    return float(scipy.special.stdtrit(n - 1, 1 - TAIL)) * spread / math.sqrt(n)


def median_rank(n: int) -> int:
    """Return the order statistic, from either end, at which an interval of the median of ``n`` values
    ends; 0 where there are too few.

    The r-th lowest and highest of ``n`` independent values enclose the median, whatever their
    distribution, unless fewer than r lie on one side of it, which is binomial with a half (David and
    Nagaraja, Order Statistics, 2003, section 7.1).

    Example:
        >>> [median_rank(n) for n in (5, 6, 30)]
        [0, 1, 10]
    """
    outside = 2.0 * scipy.special.bdtr(np.arange(n), n, 0.5)
    return int(np.sum(outside <= 1.0 - LEVEL))


def least_for_median() -> int:
    """Return how many values give an interval of their median.

    Example:
        >>> least_for_median()
        6
    """
    return next(number for number in range(1, 100) if median_rank(number) > 0)


def median_interval(values: npt.ArrayLike, unit: str = "values") -> Interval:
    """Return the median of independent ``(n,)`` values and an interval of it that holds whatever their
    distribution: its ends are order statistics (`median_rank`).

    Example:
        >>> median_interval([3.0, 1.0, 2.0, 9.0, 4.0, 5.0]).bounds
        [1.0, 9.0]
    """
    order = np.sort(np.asarray(values, dtype=np.float64))
    centre = float(np.median(order))
    rank = median_rank(len(order))
    if rank == 0:
        reason = f"needs at least {least_for_median()} {unit}, found {len(order)}"
        return Interval(centre, reason=reason)
    method = f"order statistics of {unit}"
    return Interval(centre, float(order[rank - 1]), float(order[-rank]), method=method)


def cluster_means(values: npt.ArrayLike, clusters: Sequence[str] | I64) -> tuple[F64, I64]:
    """Return the mean ``(G,)`` and size ``(G,)`` of each cluster; the one partition every statistic
    uses.

    Args:
        values: ``(N,)``.
        clusters: Name of each value's cluster, or its number from 0 up; the result is in their
            order, without numbers that no value has.
    """
    group = np.asarray(clusters)
    x, scale = scaled(np.asarray(values, dtype=np.float64))
    # Names become numbers; numbers are not sorted, as a run may have millions of cells.
    if not np.issubdtype(group.dtype, np.integer):
        group = np.unique(group, return_inverse=True)[1].reshape(-1)
    size = np.bincount(group)
    is_used = size > 0
    total = np.bincount(group, weights=x)
    return total[is_used] / size[is_used] * scale, size[is_used]


def n_clusters(clusters: I64) -> int:
    """Return how many different clusters there are among the numbers ``(N,)`` of the values'
    clusters, from 0 up.
    """
    return int(np.count_nonzero(np.bincount(clusters)))


def exact_rate(k: float, n: int) -> tuple[float, float]:
    """Return the Clopper-Pearson bounds of k of n independent trials.

    Example:
        >>> [round(b, 4) for b in exact_rate(0, 10)]
        [0.0, 0.3085]
    """
    low = float(scipy.special.betaincinv(k, n - k + 1, TAIL)) if k > 0 else 0.0
    return low, float(scipy.special.betaincinv(k + 1, n - k, 1 - TAIL)) if k < n else 1.0


def rate_at_most(count: int, n: int, level: float = RATE_LEVEL) -> float:
    """Return the exact one-sided upper bound of a rate (Clopper and Pearson).

    Example:
        >>> round(rate_at_most(0, 14), 3)
        0.193
    """
    if count >= n:
        return 1.0
    return float(scipy.special.betaincinv(count + 1, n - count, level))


def paired_rate(gained: float, lost: float, n: int) -> tuple[float, float]:
    """Return Tango's score bounds of a difference of rates from ``n`` pairs, of which some gained
    and some lost the event.

    Source: Tango, Equivalence test and confidence interval for the difference in proportions for
        the paired-sample design, Statistics in Medicine 17, 1998.

    Example:
        >>> [round(b, 3) for b in paired_rate(1, 0, 3)]
        [-0.415, 0.792]
    """

    def score(difference: float) -> float:
        b = (2 * n - gained + lost) * difference - gained - lost
        c = -lost * difference * (1 - difference)
        # The share of pairs that lose it where the likelihood is greatest, given the difference.
        share = (math.sqrt(b * b - 8 * n * c) - b) / (4 * n)
        variance = n * (2 * share + difference * (1 - difference))
        return (gained - lost - n * difference) / math.sqrt(max(variance, 1e-12))

    observed = (gained - lost) / n
    low = -1.0
    high = 1.0
    if score(-1 + 1e-9) > Z95:
        low = scipy.optimize.brentq(lambda d: score(d) - Z95, -1 + 1e-9, observed)
    if score(1 - 1e-9) < -Z95:
        high = scipy.optimize.brentq(lambda d: score(d) + Z95, observed, 1 - 1e-9)
    return float(low), float(high)
