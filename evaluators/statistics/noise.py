"""What drives of a policy that is not repeatable show of a metric: the rules of a gate about them,
as functions of numbers.

A cell is a scene and a seed; its harm is the variant's value minus the baseline's, positive is
worse. Three things are told apart, each with an error of its own:

- **The cut mean.** Of a distance or of `progress` it is the mean of the harms of all cells, each cut
  at `CUT_MARGINS` margins. No sample bounds the mean of what is not cut: one drive in forty that
  leaves the road by four metres moves it by 0.1 m, and 14 drives show none of them in 70 % of runs.
- **Drives beyond the cut** are an event. One is red if the rest of the run is quiet: no other harm or
  gain is larger than an eighth of it. Otherwise the policy's own noise may be the
  cause; one that no gain answers then keeps the gate from being green, and the exact sign test of
  harms and gains beyond the cut makes it red. The rate that the drives leave open is printed.
- **Events** are compared by their exact test.

Sources: Gaffke (see `evaluators.statistics.bounded`); Tango, Statistics in Medicine 17, 1998, whose
score orders the outcomes; Sidik, Exact unconditional tests for testing non-inferiority in matched-pairs
design, Statistics in Medicine 22, 2003, which bounds its error.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.types import F64
from evaluators.statistics.bounded import chance_of_mean
from evaluators.statistics.intervals import TAIL, rate_at_most

CUT_MARGINS = 3.0  # at which the harm of a cell is cut
# A drive beyond the cut is no noise of a run whose other cells differ by so many times less: with the
# heavy tails of t(3) it happens in half a percent of runs.
APART = 8.0
OUTSIDE = 0.0005  # chance that the rate of gone events is none of them
NUISANCE = 200  # rates of gone events at which the error of the test of events is computed
HALVINGS = 40
MOST_SEEDS = 100  # that are asked for
MOST_CELLS = 20_000  # for which they are counted


def cut(harms: F64, margin: float) -> F64:
    """Cut harms ``(n,)`` at `CUT_MARGINS` margins to either side."""
    most = CUT_MARGINS * margin
    return np.clip(harms, -most, most)


def chance_at_margin(harms: F64, margin: float) -> float:
    """Return a p-value against "the cut mean is at least the margin", from ``(n,)`` harms of
    independent cells: a small one shows that the variant is within the margin.

    Example:
        >>> round(chance_at_margin(np.zeros(10), 0.1), 4)  # (2 / 3)^10
        0.0173
    """
    if not len(harms) or margin <= 0.0:
        return 1.0
    return chance_of_mean(cut(harms, margin), CUT_MARGINS * margin, margin)


def chance_within(harms: F64, margin: float) -> float:
    """Return a p-value against "the cut mean is at most the margin", from ``(n,)`` harms of
    independent cells: a small one shows that the variant is worse.

    Example:
        >>> round(chance_within(np.full(10, 1.0), 0.1), 4)  # all are cut to three margins: (2 / 3)^10
        0.0173
    """
    if not len(harms) or margin <= 0.0:
        return 1.0
    return chance_of_mean(-cut(harms, margin), CUT_MARGINS * margin, -margin)


@dataclass(frozen=True)
class Beyond:
    """Drives beyond the cut.

    Attributes:
        n_worse: Cells that are worse by more than `CUT_MARGINS` margins.
        n_better: Cells that are better by more.
        n: All cells.
        is_quiet: No other cell is worse or better by more than the worst one divided by `APART`.
    """

    n_worse: int
    n_better: int
    n: int
    is_quiet: bool

    @property
    def at_most(self) -> float:
        """Give the largest rate of worse ones that they leave open, at one-sided 95 %."""
        return rate_at_most(self.n_worse, self.n)

    @property
    def is_answered(self) -> bool:
        """Tell whether none is worse, or another is as much better, so that noise may be the cause."""
        return self.n_worse == 0 or self.n_better > 0

    def is_red(self, level: float) -> bool:
        """Tell whether they make a gate red, at a one-sided level where chance plays a part."""
        if self.n_worse > 0 and self.is_quiet:
            return True
        return chance_of_more(self.n_worse, self.n_better) <= level


def beyond(harms: F64, margin: float, rounding: float = 0.0) -> Beyond:
    """Count the drives beyond the cut among ``(n,)`` harms.

    Args:
        harms: Of the cells.
        margin: How much worse is accepted.
        rounding: By which a harm may pass the cut and not count.

    Example:
        >>> beyond(np.array([0.0, 0.31, 4.0, -1.0]), 0.1)
        Beyond(n_worse=2, n_better=1, n=4, is_quiet=False)
    """
    most = CUT_MARGINS * margin + rounding
    is_worse = harms > most
    others = np.abs(harms[~is_worse])
    largest = float(np.max(harms, initial=0.0)) / APART
    is_quiet = bool((others <= largest).all())
    return Beyond(int(np.sum(is_worse)), int(np.sum(harms < -most)), len(harms), is_quiet)


def chance_of_more(worse: int, better: int) -> float:
    """Return the chance of so many worse ones among all that changed if either is a fair coin.

    Example:
        >>> chance_of_more(6, 0)
        0.015625
    """
    return float(scipy.special.bdtr(better, worse + better, 0.5))


def tango_score(new: F64, gone: F64, n: int, margin: float) -> F64:
    """Return Tango's score of "the rate has risen by the margin"; negative where less is seen.

    Args:
        new, gone: ``(...)`` cells of ``n`` that have the event on one side only.
        n: Cells.
        margin: Rise of the rate, above 0 and below 1.
    """
    b = (2 * n - new + gone) * margin - new - gone
    c = -gone * margin * (1.0 - margin)
    share_gone = (np.sqrt(b * b - 8.0 * n * c) - b) / (4.0 * n)
    variance = n * (2.0 * share_gone + margin * (1.0 - margin))
    return np.asarray((new - gone - n * margin) / np.sqrt(variance), dtype=np.float64)


@lru_cache(maxsize=4096)
def chance_at_rate(new: int, gone: int, n: int, margin: float) -> float:
    """Return an exact p-value against "the rate of an event has risen by the margin or more": a
    small one shows that the variant is within the margin.

    The outcomes that speak at least as strongly against it are those with a Tango score that is no
    higher. Their probability is the largest over the rates of gone events that are possible, so that
    the error holds for every one of them (Berger and Boos, Journal of the American Statistical
    Association 89, 1994); Tango's normal quantile passes 2.5 % by a little (2.6 % at 30 % of events).

    Args:
        new, gone: Cells of ``n`` that have the event on one side only.
        n: Cells.
        margin: Rise of the rate.

    Example:
        >>> round(chance_at_rate(0, 0, 36, 0.1), 4)  # 0.9^36 = 0.0225 where nothing may be gone
        0.0241
    """
    if n == 0 or margin <= 0.0 or margin >= 1.0:
        return float(margin < 1.0)
    # The score rises with new events, so that for each number of gone ones the outcomes in question
    # are those up to some number of new ones; -1 where there is none.
    numbers = np.arange(n + 1, dtype=np.float64)
    bar = float(tango_score(np.array(float(new)), np.array(float(gone)), n, margin)) + 1e-9
    low = np.full(n + 1, -1.0)
    high = n - numbers
    for _ in range(HALVINGS):
        middle = np.ceil(0.5 * (low + high))
        is_in = tango_score(middle, numbers, n, margin) <= bar
        low = np.where(is_in, middle, low)
        high = np.where(is_in, high, np.maximum(middle - 1.0, low))
        if (low >= high).all():
            break
    # The rates of gone events that those seen leave open but for a chance of `OUTSIDE`, which is
    # added; closer together near 0, where the probability bends.
    most = 0.5 * (1.0 - margin)
    least_rate = 0.0
    if gone > 0:
        least_rate = float(scipy.special.betaincinv(gone, n - gone + 1, 0.5 * OUTSIDE))
    most_rate = min(rate_at_most(gone, n, 1.0 - 0.5 * OUTSIDE), most)
    roots = np.linspace(min(least_rate, most) ** 0.5, most_rate**0.5, NUISANCE)
    rates = roots[:, None] ** 2
    is_used = low >= 0.0
    gone_numbers = numbers[is_used]
    with np.errstate(divide="ignore"):
        log_choose = (
            scipy.special.gammaln(n + 1.0)
            - scipy.special.gammaln(gone_numbers + 1.0)
            - scipy.special.gammaln(n - gone_numbers + 1.0)
        )
        log_chance = (
            log_choose
            + scipy.special.xlogy(gone_numbers, rates)
            + scipy.special.xlog1py(n - gone_numbers, -rates)
        )
    share_new = np.minimum((rates + margin) / (1.0 - rates), 1.0)
    up_to = scipy.special.bdtr(low[is_used], (n - gone_numbers).astype(np.int64), share_new)
    return min(1.0, float(np.max(np.sum(np.exp(log_chance) * up_to, axis=1))) + OUTSIDE)


def seeds_for_mean(harms: F64, margin: float, n_scenes: int) -> int | None:
    """Return how many seeds a scene show that the cut mean is within its margin, if more of them
    show the same as ``(n,)`` harms did; None where that is more than `MOST_SEEDS`.

    Example:
        >>> seeds_for_mean(np.zeros(3), 0.1, 3)  # ten drives in three scenes
        4
    """
    return _fewest_seeds(
        n_scenes, lambda cells: chance_at_margin(_as_many(harms, cells), margin) <= TAIL
    )


def seeds_for_rate(new: int, gone: int, n: int, margin: float, n_scenes: int) -> int | None:
    """Return how many seeds a scene show that a rate is within its margin, if more of them show the
    same as ``n`` cells did; None where that is more than `MOST_SEEDS`.

    Example:
        >>> seeds_for_rate(0, 0, 14, 0.1, 14)  # 36 drives in 14 scenes
        3
    """

    def is_shown(cells: int) -> bool:
        counts = (round(cells * count / n) for count in (new, gone))
        return chance_at_rate(*counts, cells, margin) <= TAIL

    return _fewest_seeds(n_scenes, is_shown) if n else None


def _fewest_seeds(n_scenes: int, is_shown: Callable[[int], bool]) -> int | None:
    """Return the fewest seeds a scene whose cells show something that more cells show as well."""
    numbers = range(1, min(MOST_SEEDS, MOST_CELLS // max(n_scenes, 1)) + 1)
    fewest = bisect_left(numbers, True, key=lambda seeds: is_shown(seeds * n_scenes))
    return numbers[fewest] if fewest < len(numbers) else None


def _as_many(harms: F64, cells: int) -> F64:
    """Return the quantiles of harms ``(n,)`` at as many cells ``(cells,)``."""
    order = np.sort(harms)
    return order[
        np.minimum((np.arange(cells) + 0.5) / cells * len(order), len(order) - 1).astype(int)
    ]


def rejected_together(p_values: Sequence[float], level: float) -> list[bool]:
    """Tell which of several p-values reject at one level together (Holm's method)."""
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    is_rejected = [False] * len(p_values)
    for rank, i in enumerate(order):
        if p_values[i] > level / (len(p_values) - rank):
            break
        is_rejected[i] = True
    return is_rejected
