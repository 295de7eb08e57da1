"""Intervals of a mean over rollouts, at 95 %.

`normal_half_width` is the paper's formula. It treats the seeds of one scene as independent, which makes it too short where scenes differ;
`clustered` takes the scene as the unit. A quantity that does not exist is None and comes with a reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from alpasim_plugin.types import F64, I64

Z95 = 1.96
LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A centre with bounds; bounds are None where they do not exist, and ``reason`` then says why. ``note`` qualifies bounds that exist."""

    centre: float
    low: float | None = None
    high: float | None = None
    reason: str = ""
    note: str = ""

    @property
    def bounds(self) -> list[float] | None:
        """Give [low, high] or None."""
        return None if self.low is None or self.high is None else [self.low, self.high]


def normal_half_width(values: npt.ArrayLike) -> tuple[float | None, str]:
    """Return 1.96 s / sqrt(N) with the sample standard deviation s of ``(N,)`` values (paper, appendix), and why it is missing.

    Example:
        >>> round(normal_half_width([0.0, 0.0, 1.0, 1.0])[0], 4)
        0.5658
        >>> normal_half_width([1.0])
        (None, 'one rollout has no spread')
    """
    x = np.asarray(values, dtype=np.float64)
    if len(x) < 2:
        return None, "one rollout has no spread"
    return Z95 * float(np.std(x, ddof=1)) / float(np.sqrt(len(x))), ""


def t_interval(values: npt.ArrayLike, what: str = "values") -> Interval:
    """Return mean and t interval of independent ``(n,)`` values.

    Example:
        >>> one = t_interval([1.0, 2.0, 3.0])
        >>> round(one.low, 4), round(one.high, 4)
        (-0.4841, 4.4841)
    """
    x = np.asarray(values, dtype=np.float64)
    centre = float(np.mean(x))
    if len(x) < 2:
        return Interval(centre, reason=f"needs at least two {what}, found {len(x)}")
    half = float(stats.t.ppf(0.5 + LEVEL / 2, len(x) - 1)) * float(np.std(x, ddof=1)) / float(np.sqrt(len(x)))
    note = f"all {len(x)} {what} are equal: the interval has no width" if half == 0.0 else ""
    return Interval(centre, centre - half, centre + half, note=note)


def cluster_means(values: npt.ArrayLike, clusters: Sequence[str]) -> tuple[F64, I64]:
    """Return the mean ``(G,)`` and size ``(G,)`` of each cluster, in the order of their names; the one partition every statistic uses."""
    _, group = np.unique(np.asarray(clusters), return_inverse=True)
    group = group.reshape(-1)
    size = np.bincount(group)
    return np.bincount(group, weights=np.asarray(values, dtype=np.float64)) / size, size


def clustered(values: npt.ArrayLike, clusters: Sequence[str], is_rate: bool = False) -> Interval:
    """Return the interval with scenes as clusters: a t interval on the scene means.

    Its centre is the mean of the scene means, which is the mean of the values where every scene has as many. For a rate that is 0 (or 1)
    in every scene the t interval has no width; the exact (Clopper-Pearson) bound for 0 of G (or G of G) scenes is given instead.

    Args:
        values: ``(N,)``.
        clusters: Scene of each value.
        is_rate: Values are 0 or 1, or averages of such.
    """
    means, _ = cluster_means(values, clusters)
    out = t_interval(means, "scenes")
    if is_rate and out.low is not None and bool(np.all(means == means[0])) and float(means[0]) in (0.0, 1.0):
        k = len(means) if means[0] == 1.0 else 0
        low, high = exact_rate(k, len(means))
        return Interval(out.centre, low, high, note=f"{k} of {len(means)} scenes: exact bounds, as equal scenes have no spread")
    return out


def exact_rate(k: int, n: int) -> tuple[float, float]:
    """Return the Clopper-Pearson bounds of k of n independent trials.

    Example:
        >>> [round(b, 4) for b in exact_rate(0, 10)]
        [0.0, 0.3085]
    """
    tail = (1 - LEVEL) / 2
    low = 0.0 if k == 0 else float(stats.beta.ppf(tail, k, n - k + 1))
    high = 1.0 if k == n else float(stats.beta.ppf(1 - tail, k + 1, n - k))
    return low, high


def wilson_rate(k: int, n: int) -> tuple[float, float]:
    """Return the Wilson score bounds of k of n independent trials.

    Example:
        >>> [round(b, 3) for b in wilson_rate(3, 10)]
        [0.108, 0.603]
    """
    p = k / n
    scale = 1 + Z95**2 / n
    centre = (p + Z95**2 / (2 * n)) / scale
    half = Z95 * float(np.sqrt(p * (1 - p) / n + Z95**2 / (4 * n * n))) / scale
    return max(0.0, centre - half), min(1.0, centre + half)
