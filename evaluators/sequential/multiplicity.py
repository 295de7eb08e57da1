"""Several metrics at once: closed testing with averages of e-values.

The average of e-processes is an e-process however they depend on each other, so the hypothesis that none of a set of metrics is worse is
refuted where the average over the set reaches 1 / alpha. Metric i is worse if every set that holds it is refuted (closed testing; Vovk and
Wang, E-values: calibration, combination and applications, Annals of Statistics 49, 2021). This refutes whatever Bonferroni does.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from alpasim_plugin.core.types import F64


def closed(log_e: F64) -> F64:
    """Return the log of the adjusted e-values ``(k, ...)``: for each metric the least average over all sets that hold it.

    The least average of i and any others takes the smallest others, so prefixes of the sorted values are enough.

    Args:
        log_e: ``(k, ...)`` log e-values of k metrics.

    Example:
        >>> [round(float(e), 3) for e in np.exp(closed(np.log([60.0, 1.0])))]
        [30.5, 1.0]
    """
    k = len(log_e)
    top = np.maximum(np.max(log_e, axis=0), 0.0)
    finite = np.where(np.isfinite(top), top, 0.0)
    e = np.exp(np.minimum(log_e - finite, 700.0))  # scaled by the largest; what is infinite stays far above any bar
    order = np.sort(e, axis=0)
    sums = np.cumsum(order, axis=0)
    least = e.copy()
    for size in range(2, k + 1):
        # i with the size - 1 smallest others: if i is among the smallest, the size smallest of all.
        rank_in = e <= order[size - 2]
        with_others = np.where(rank_in, sums[size - 1], e + sums[size - 2])
        least = np.minimum(least, with_others / size)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(least) + finite)


def closed_by_sets(e: F64) -> F64:
    """Return the adjusted e-values ``(k,)`` by going through every set: the reference of `closed`."""
    k = len(e)
    sets = [s for size in range(1, k + 1) for s in combinations(range(k), size)]
    return np.array([min(float(np.mean(e[list(s)])) for s in sets if i in s) for i in range(k)])
